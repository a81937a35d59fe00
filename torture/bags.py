"""Bags damaged on disk: a recovered part or a clear refusal, never a wrong number."""

import shutil
import struct
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from random import Random
from typing import Final

import numpy as np

from asi_analysis.bags.bag import read_bag, write_bag
from asi_analysis.bags.bag_writer import BagWriter, typestore
from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError
from torture.rig import Rig, Tally

SAMPLES: Final = 3000
RECORD: Final = struct.Struct('<BQ')
MAGIC_BYTES: Final = 8


def _original() -> Run:
    """Return a run in which every number is unique."""
    numbers = np.random.default_rng(1).normal(0.0, 100.0, (5, SAMPLES))
    time_s = np.arange(SAMPLES) / 1000.0
    return Run(time_s, numbers[0], numbers[1], numbers[2], numbers[3] * 1e-6,
               numbers[4] * 1e-6, None, 'torture', {})


def bags(rig: Rig, tally: Tally, end: float) -> None:
    """Truncate everywhere, flip bytes, swap, empty and replace files."""
    run = _original()
    good = rig.folder / 'good'
    write_bag(run, good)
    data = next(good.glob('*.mcap')).read_bytes()
    bad = rig.folder / 'bad'
    first = True
    while first or time.monotonic() < end:
        for what, content in _damaged(data, rig.random, every_boundary=first):
            shutil.rmtree(bad, ignore_errors=True)
            shutil.copytree(good, bad)
            _put(bad, what, content)
            tally.count(what, _problem(run, bad, tally))
            if time.monotonic() > end and tally.tried > 50:
                return
        first = False


def _boundaries(data: bytes) -> list[int]:
    """Return the offsets of the records of an MCAP file."""
    places, place = [], MAGIC_BYTES
    while place + RECORD.size <= len(data) - MAGIC_BYTES:
        places.append(place)
        place += RECORD.size + RECORD.unpack_from(data, place)[1]
    return places


def _damaged(data: bytes, random: Random, every_boundary: bool) -> Iterator[tuple[str, bytes]]:
    """Yield a description of the damage, and the damaged file."""
    boundaries = _boundaries(data)
    for place in boundaries if every_boundary else random.sample(boundaries, 3):
        yield 'cut at a record', data[:place]
    for _ in range(10):
        yield 'cut anywhere', data[:random.randrange(len(data))]
    for count in (1, 1, 1, 1, 1, 1, 10, 100):
        flipped = bytearray(data)
        for _ in range(count):
            flipped[random.randrange(len(data))] ^= 1 << random.randrange(8)
        yield 'bits flipped', bytes(flipped)
    # In the records between the chunks, which no checksum covers.
    for _ in range(10):
        flipped = bytearray(data)
        place = random.choice(boundaries) + random.randrange(40)
        flipped[min(place, len(data) - 1)] ^= 1 << random.randrange(8)
        yield 'bit flipped at a record', bytes(flipped)
    hole = random.randrange(len(data))
    yield 'zeros in the middle', data[:hole] + bytes(min(4096, len(data) - hole)) + data[
        hole + 4096:]
    yield 'a piece twice', data[:hole] + data[hole // 2:]
    yield 'no metadata', data
    yield 'metadata of nothing', data
    yield 'metadata cut', data
    yield 'metadata of another bag', data
    yield 'messages of others', data
    yield 'empty', b''
    yield 'noise', random.randbytes(5000)
    yield 'metadata as bag', (b'rosbag2_bagfile_information:\n  version: 9\n')


def _put(bag: Path, what: str, content: bytes) -> None:
    next(bag.glob('*.mcap')).write_bytes(content)
    metadata = bag / 'metadata.yaml'
    if what == 'no metadata':
        metadata.unlink()
    elif what == 'metadata of nothing':
        metadata.write_text('[]')
    elif what == 'metadata cut':
        metadata.write_bytes(metadata.read_bytes()[:150])
    elif what == 'metadata of another bag':
        metadata.write_text(metadata.read_text().replace('joint_states', 'chatter')
                            .replace(str(SAMPLES), '7'))
    elif what == 'messages of others':
        shutil.rmtree(bag)
        writer = BagWriter(bag)
        channel = writer.add_topic('/chatter', 'std_msgs/msg/String', [])
        text = typestore().serialize_cdr(typestore().types['std_msgs/msg/String']('hello'),
                                         'std_msgs/msg/String')
        for k in range(100):
            writer.write(channel, k, k, k, bytes(text))
        writer.close()


def _problem(run: Run, bag: Path, tally: Tally) -> str:
    """Return what is wrong with the data read from a damaged bag, '' for nothing."""
    try:
        with warnings.catch_warnings(record=True) as noted:
            warnings.simplefilter('always')
            read = read_bag(bag)
    except InputError as error:
        tally.notes['refused'] = tally.notes.get('refused', 0) + 1
        return 'the refusal has several lines' if '\n' in str(error) else ''
    except Exception as error:  # noqa: B902 - whatever it is, a user would see it
        return f'{type(error).__name__}: {error}'
    tally.notes['recovered, at least in part'] = tally.notes.get(
        'recovered, at least in part', 0) + 1
    if read.time_s.size < SAMPLES and not noted:
        return f'{SAMPLES - read.time_s.size} samples are missing and nothing says so'
    return _wrong(run, read)


def _wrong(run: Run, read: Run) -> str:
    """Return the first number that was not written, or not at that time."""
    assert run.force_n is not None
    if read.force_n is None:
        return ''
    there = ~np.isnan(read.force_n)
    place = {force: k for k, force in enumerate(run.force_n)}
    if unknown := set(read.force_n[there]) - set(place):
        return f'forces that were never written: {sorted(unknown)[:3]}'
    found = np.array([place[force] for force in read.force_n[there]], int)
    if found.size == 0:
        return ''
    shift = read.time_s[there] - run.time_s[found]
    if np.ptp(shift) > 1e-6:
        return f'times are wrong by up to {np.ptp(shift):.3g} s'
    for name in ('command_n', 'reference_n', 'valve_position_m', 'position_m'):
        written, signal = getattr(run, name), getattr(read, name)
        if signal is None:
            continue
        signal = signal[there]
        differs = ~np.isnan(signal) & (signal != written[found])
        # A missing command or reference is held: that is allowed with a warning.
        held = np.isin(signal, written) if name in ('command_n', 'reference_n') else False
        if np.any(differs & ~held):
            k = int(np.argmax(differs & ~held))
            return f'{name} is {signal[k]!r} where {written[found][k]!r} was written'
    return ''
