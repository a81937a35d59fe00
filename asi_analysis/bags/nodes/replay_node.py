"""
The node `asi_replay`: publishes a bag with its timing, where `ros2 bag play` is not installed.

Messages are published as recorded, with the recorded QoS. It ends with the bag, unless it loops.
"""

import sys
import time
from pathlib import Path
from typing import Final, NamedTuple

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.publisher import Publisher
from rosgraph_msgs.msg import Clock as ClockMessage
from std_srvs.srv import SetBool

from asi_analysis.bags.bag_file import read_contents
from asi_analysis.bags.qos import as_profile
from asi_analysis.bags.topic_messages import Topic
from asi_analysis.errors import InputError
from asi_common.node.discovery import AwaitedRecorder
from asi_common.node.executor import RunFinished, run_node
from asi_common.node.ros_parameters import RosParameters
from asi_common.node.topics import STREAM_QOS, message_class, set_time
from asi_common.parameter import Parameter, ParameterError

REPLAY_PARAMETERS: tuple[Parameter, ...] = (
    Parameter('bag', '', '', 'The bag to publish: rosbag2 directory, .mcap or .db3 file',
              read_only=True),
    Parameter('rate', 1.0, '', 'How many times faster than it was recorded', 1e-3, 1e3),
    Parameter('loop', False, '', 'Begin again at the end'),
    Parameter('start_paused', False, '', 'Wait for ~/pause with false', read_only=True),
    Parameter('delay', 1.0, 's', 'Wait so long first, so that subscribers find the topics',
              0.0, 3600.0, read_only=True),
    Parameter('await_recorder', False, '', 'Begin when a recorder has every topic',
              read_only=True),
    Parameter('clock', False, '', 'Publish the time of the bag as /clock, instead of the '
              'recorded /clock', read_only=True),
)
PERIOD_S: Final = 0.001
PROGRESS_PERIOD_S: Final = 5.0


class _Entry(NamedTuple):
    log_ns: int
    publisher: Publisher
    data: bytes


class Replay(Node):
    """The node. Raises InputError if the bag cannot be read."""

    def __init__(self) -> None:
        super().__init__('asi_replay', automatically_declare_parameters_from_overrides=True)
        self.parameters = RosParameters(self, REPLAY_PARAMETERS)
        values = self.parameters.values
        self._clock_topic = (self.create_publisher(ClockMessage, '/clock', STREAM_QOS)
                       if values['clock'] else None)
        self._entries = self._load(Path(str(values['bag'])))
        self._publishing = [*{entry.publisher for entry in self._entries},
                        *([self._clock_topic] if self._clock_topic else [])]
        self._recorder = AwaitedRecorder(self, bool(values['await_recorder']))
        self._subscribed = not values['await_recorder']
        self._start_ns = self._entries[0].log_ns
        self._duration_ns = self._entries[-1].log_ns - self._start_ns
        self._next = 0
        self._position_ns = 0.0
        self._paused = bool(values['start_paused'])
        self._last_s = time.monotonic() + float(values['delay'])
        self._progress_s = self._last_s
        self.create_service(SetBool, '~/pause', self._pause)
        self.create_timer(PERIOD_S, self._step, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self.get_logger().info(f'{values["bag"]}: {len(self._entries)} messages, '
                               f'{self._duration_ns * 1e-9:.3f} s'
                               + (', paused' if self._paused else ''))

    def _load(self, bag: Path) -> list[_Entry]:
        """Return the messages by time, each with its publisher."""
        contents = read_contents(bag, lambda name: self._clock_topic is None or name != '/clock')
        for problem in contents.problems:
            self.get_logger().warning(problem)
        entries: list[_Entry] = []
        for topic in contents.topics.values():
            publisher = self._publisher(topic)
            if publisher is not None:
                entries += [_Entry(time_ns, publisher, data)
                            for time_ns, data in zip(topic.log_ns, topic.data, strict=True)]
        if not entries:
            why = f' ({contents.problems[0]})' if contents.problems else ''
            raise InputError(f'{bag} holds no message that can be published{why}')
        return sorted(entries, key=lambda entry: entry.log_ns)

    def _publisher(self, topic: Topic) -> Publisher | None:
        try:
            message = message_class(topic.type)
        except (ImportError, AttributeError, ValueError):
            self.get_logger().warning(f'{topic.name} is left out: its type {topic.type} is not '
                                      'installed')
            return None
        profile = as_profile(topic.offered[0]) if topic.offered else STREAM_QOS
        return self.create_publisher(message, topic.name, profile)

    def _step(self) -> None:
        """Publish the messages that are due."""
        now_s = time.monotonic()
        if now_s < self._last_s:
            return
        if self._paused or not self._subscribed:
            self._subscribed = self._subscribed or not self._recorder.missing(self._publishing)
            self._last_s = now_s
            return
        self._position_ns += (now_s - self._last_s) * 1e9 * float(self.parameters.values['rate'])
        self._last_s = now_s
        due_ns = self._start_ns + self._position_ns
        while self._next < len(self._entries) and self._entries[self._next].log_ns <= due_ns:
            entry = self._entries[self._next]
            entry.publisher.publish(entry.data)
            self._next += 1
        if self._clock_topic is not None:
            message = ClockMessage()
            set_time(message.clock, self._start_ns + int(min(self._position_ns,
                                                             self._duration_ns)))
            self._clock_topic.publish(message)
        if now_s - self._progress_s > PROGRESS_PERIOD_S:
            self._progress_s = now_s
            self._log_progress()
        if self._next == len(self._entries):
            self._end()

    def _log_progress(self) -> None:
        self.get_logger().info(f'{min(self._position_ns, self._duration_ns) * 1e-9:.1f} of '
                               f'{self._duration_ns * 1e-9:.1f} s'
                               + (', paused' if self._paused else ''))

    def _end(self) -> None:
        if not self.parameters.values['loop']:
            self.get_logger().info(f'published all {len(self._entries)} messages')
            raise RunFinished
        self._next, self._position_ns = 0, 0.0

    def _pause(self, request: SetBool.Request, answer: SetBool.Response) -> SetBool.Response:
        if self._paused:  # the time since the last step does not count either
            self._last_s = max(self._last_s, time.monotonic())
        self._paused = request.data
        answer.success, answer.message = True, 'paused' if self._paused else 'running'
        self._log_progress()
        return answer


def main() -> int:
    """Run the node; return the exit status."""
    def make() -> Replay:
        try:
            return Replay()
        except InputError as error:
            raise ParameterError(str(error)) from None

    return run_node(make)


if __name__ == '__main__':
    sys.exit(main())
