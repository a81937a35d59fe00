"""
What the recorder keeps up with, and how fast a bag is read; `python bench/recording.py`.

Recording: a replay publishes the six topics of the loop at a steady rate, the recorder writes
them; told are the rate reached, what was lost, and the processor time of the recorder. Reading: a
bag of 20 s of the loop, by `read_bag` and by rosbags message by message.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from asi_analysis.bag import read_bag, write_bag
from asi_analysis.bag_file import read_contents
from asi_analysis.run import Run

TICKS = 20_000
RATES_HZ = (1000, 2000, 3000, 4000)
ENVIRONMENT = os.environ | {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}


def a_run(ticks: int) -> Run:
    rng = np.random.default_rng(0)
    columns = {field: rng.normal(size=ticks) for field in (
        'reference_n', 'command_n', 'force_n', 'valve_position_m', 'position_m', 'velocity_m_s')}
    return Run(np.arange(ticks) / 5000.0, **columns)


def node(module: str, **parameters: object) -> subprocess.Popen:
    given = [part for name, value in parameters.items() for part in ('-p', f'{name}:={value}')]
    return subprocess.Popen([sys.executable, '-m', module, '--ros-args', *given],
                            env=ENVIRONMENT, stderr=subprocess.DEVNULL)


def processor_s(pid: int) -> float:
    """Return the processor time of a process so far (Linux)."""
    after_name = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()
    return (int(after_name[11]) + int(after_name[12])) / os.sysconf('SC_CLK_TCK')


def record(folder: Path, played: Path, rate_hz: float) -> None:
    """Record a replay of `played` at a rate of ticks, and print how it went."""
    bag = folder / f'at_{rate_hz}'
    recorder = node('asi_analysis.recorder_node', output=bag)
    # The replay needs this long to start and to read the bag, and then waits for the recorder.
    replay = node('asi_analysis.replay_node', bag=played, rate=rate_hz / 5000.0, delay=5.0,
                  await_recorder='true')
    time.sleep(7.0)
    begin, used = time.perf_counter(), processor_s(recorder.pid)
    replay.wait()
    seconds = time.perf_counter() - begin
    used = processor_s(recorder.pid) - used
    recorder.terminate()
    recorder.wait()
    counts = {name: len(topic.data) for name, topic in read_contents(bag, lambda _: True)
              .topics.items()}
    lost = sum(TICKS - count for count in counts.values())
    print(f'{rate_hz:>6} {TICKS / seconds:>10.0f} {lost:>6} {100.0 * used / seconds:>8.0f} %')


def read(folder: Path) -> None:
    """Print how long it takes to read a bag of 20 s, in processor time: others may be busy."""
    write_bag(a_run(100_000), folder / 'long')
    begin = time.process_time()
    run = read_bag(folder / 'long')
    ours = time.process_time() - begin
    begin = time.process_time()
    with AnyReader([folder / 'long'],
                   default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        count = 0
        for connection, _, data in reader.messages():
            reader.deserialize(data, connection.msgtype)
            count += 1
    theirs = time.process_time() - begin
    print(f'reading {count} messages: {ours:.2f} s into a run of {len(run)} samples, '
          f'{theirs:.2f} s by rosbags ({theirs / ours:.1f} times as long)')


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        read(folder)
        write_bag(a_run(TICKS), folder / 'played')
        print(f'{"asked":>6} {"ticks/s":>10} {"lost":>6} {"processor":>10}   (six topics)')
        for rate_hz in RATES_HZ:
            record(folder, folder / 'played', rate_hz)


if __name__ == '__main__':
    main()
