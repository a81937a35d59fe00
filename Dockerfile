# The asi command and the nodes, on the wheels of rclpy, without a ROS installation:
#   docker build -t asi_actuator . && docker run --rm -v "$PWD/runs:/work/runs" asi_actuator demo
# Nodes: docker run --rm --network host --entrypoint actuator asi_actuator
FROM python:3.12-slim-bookworm

WORKDIR /opt/asi_actuator
COPY requirements.lock .
RUN pip install --no-cache-dir --require-hashes -r requirements.lock
COPY . .
RUN pip install --no-cache-dir --no-deps --no-build-isolation . \
    && useradd --create-home --uid 1000 asi \
    && install -d -o asi /work/runs

USER 1000
WORKDIR /work
ENV ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST
ENTRYPOINT ["asi"]
CMD ["--help"]
