"""
Bags: rate without loss, processor time, time to read, and speed without ROS.

Recording: a replay publishes the six topics of the loop at a constant rate and the recorder writes
them. Reading: a cached bag into a `Run`, compared with deserialising each message by rosbags and
by mcap.
"""

import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from asi_analysis.bags.bag import read_bag, write_bag
from asi_analysis.bags.bag_file import read_contents
from asi_analysis.bags.run import Run
from asi_analysis.bags.topic_messages import Topic
from asi_analysis.experiments.experiment import planned
from asi_analysis.loop.closed_loop import simulate_loop
from asi_analysis.loop.in_process import run_in_process
from bench.result import Result, ratios

ROOT: Final = Path(__file__).parents[1]
TICKS: Final = 20_000
RATES_HZ: Final = (1000, 2000, 3000, 4000, 5000)
TOPICS: Final = 6


def a_run(ticks: int) -> Run:
    """Return a run of noise at 1 kHz."""
    rng = np.random.default_rng(0)
    columns = {field: rng.normal(size=ticks) for field in (
        'reference_n', 'command_n', 'force_n', 'valve_position_m', 'position_m', 'velocity_m_s')}
    return Run(np.arange(ticks) / 1000.0, **columns)


def node(module: str, **parameters: object) -> subprocess.Popen:
    """Start a node."""
    given = [part for name, value in parameters.items() for part in ('-p', f'{name}:={value}')]
    environment = os.environ | {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
    environment['PYTHONPATH'] = os.pathsep.join([str(ROOT), environment.get('PYTHONPATH', '')])
    return subprocess.Popen([sys.executable, '-m', module, '--ros-args', *given],
                            env=environment, stderr=subprocess.DEVNULL)


def processor_s(pid: int) -> float:
    """Return the processor time of a process so far (Linux)."""
    after_name = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()
    return (int(after_name[11]) + int(after_name[12])) / os.sysconf('SC_CLK_TCK')


def record(folder: Path, played: Path, rate_hz: float) -> tuple[float, int, float, Path]:
    """Record a replay; return ticks a second, messages lost, processor share and the bag."""
    bag = folder / f'at_{rate_hz}'
    recorder = node('asi_analysis.bags.nodes.recorder_node', output=bag)
    # The replay needs this long to start and to read the bag, and then waits for the recorder.
    replay = node('asi_analysis.bags.nodes.replay_node', bag=played, rate=rate_hz / 1000.0,
                  delay=5.0, await_recorder='true')
    time.sleep(7.0)
    begin, used = time.perf_counter(), processor_s(recorder.pid)
    replay.wait()
    seconds = time.perf_counter() - begin
    used = processor_s(recorder.pid) - used
    recorder.terminate()
    recorder.wait()
    topics = read_contents(bag, lambda _: True).topics.values()
    return TICKS / seconds, TOPICS * TICKS - sum(map(len, topics)), used / seconds, bag


def payload_bytes(topics: list[Topic]) -> int:
    """Return the bytes of all messages."""
    return sum(len(data) for topic in topics for data in topic.data)


def recording(rates_hz: tuple[int, ...]) -> list[Result]:
    """Return losses and processor time by rate, and the size on disk."""
    results = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_bag(a_run(TICKS), folder / 'played')
        for asked_hz in rates_hz:
            rate_hz, lost, share, bag = record(folder, folder / 'played', asked_hz)
            results += [
                Result(f'recording.lost.{asked_hz}', f'messages of {TOPICS * TICKS} lost at '
                       f'{rate_hz:.0f} ticks/s ({TOPICS} topics)', lost, '', target='<= 0'),
                Result(f'recording.processor.{asked_hz}', f'the recorder, of a core, at '
                       f'{rate_hz:.0f} ticks/s', 100.0 * share, '%')]
        payload = payload_bytes(list(read_contents(bag, lambda _: True).topics.values()))
        size = sum(file.stat().st_size for file in bag.iterdir())
        results.append(Result(
            'recording.size', f'bytes on disk at {rate_hz:.0f} ticks/s; ratio: to the payload',
            size * rate_hz / TICKS, 'B/s', rival=f'payload, {payload * rate_hz / TICKS:.0f} B/s',
            ratio=size / payload))
    return results


def by_rosbags(bag: Path) -> None:
    """Deserialise every message with rosbags."""
    with AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        for connection, _, data in reader.messages():
            reader.deserialize(data, connection.msgtype)


def by_mcap(bag: Path) -> None:
    """Deserialise every message with mcap and mcap-ros2-support."""
    with next(bag.glob('*.mcap')).open('rb') as stream:
        for _ in make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            pass


def timed(read: Callable[[Path], object], bag: Path) -> tuple[float, float]:
    """Return wall and processor time of reading a bag, s."""
    wall, processor = time.perf_counter(), time.process_time()
    read(bag)
    return time.perf_counter() - wall, time.process_time() - processor


def reading(seconds: int, rounds: int) -> list[Result]:
    """Return the time to read a bag of so many seconds at 1 kHz, beside both rivals."""
    readers: dict[str, Callable[[Path], object]] = {
        'ours': read_bag, 'rosbags': by_rosbags, 'mcap': by_mcap}
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in readers}
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / 'long'
        write_bag(a_run(1000 * seconds), bag)
        names = list(readers)
        for _ in range(rounds):
            for name in names:
                times[name].append(timed(readers[name], bag))
            names.reverse()
    results = []
    for i, kind in enumerate(('wall', 'processor')):
        ours = [both[i] for both in times['ours']]
        for rival in ('rosbags', 'mcap'):
            theirs = [both[i] for both in times[rival]]
            ratio, spread = ratios(theirs, ours)
            results.append(Result(
                f'recording.read.{kind}.{rival}.{seconds}',
                f'reading {seconds} s of six topics at 1 kHz, {kind} time; ratio: rival / ours',
                statistics.median(ours), 's', spread,
                f'{rival}, {statistics.median(theirs):.1f} s', ratio, '>= 10'))
    return results


def in_process(seconds: float, rounds: int) -> list[Result]:
    """Return how fast `asi run --in-process` computes and writes, and its part for the model."""
    experiment = planned({}, {'compensator': 'lead4'}, seconds, 'lockstep', 5000.0)
    rates: dict[str, list[float]] = {'bag': [], 'model': []}
    with tempfile.TemporaryDirectory() as folder:
        for number in range(rounds):
            begin = time.perf_counter()
            run_in_process(experiment, Path(folder) / str(number))
            middle = time.perf_counter()
            simulate_loop(experiment.actuator, experiment.controller, seconds)
            rates['bag'].append(seconds / (middle - begin))
            rates['model'].append(seconds / (time.perf_counter() - middle))
    ratio, spread = ratios(rates['bag'], rates['model'])
    return [Result('recording.in_process', f'asi run --in-process, {seconds:g} s at 5 kHz and its '
                   'bag, simulated seconds a second; ratio: to the loop without the bag',
                   statistics.median(rates['bag']), 's/s', spread,
                   f'loop alone, {statistics.median(rates["model"]):.0f} s/s', ratio)]


def measure(quick: bool = False) -> list[Result]:
    """Return the results of recording and reading."""
    if quick:
        return recording(RATES_HZ[:1]) + reading(10, 1) + in_process(1.0, 1)
    return recording(RATES_HZ) + reading(60, 3) + reading(600, 1) + in_process(60.0, 5)
