"""
Damaged files and samples: every reader answers or refuses in one line.

A traceback is a failure; and so is a figure that differs from that of the undamaged file when
nothing says that anything is wrong. `make test` tries a few hundred, `make torture` ten thousand.
"""

import contextlib
import functools
import gzip
import json
import math
import os
import shutil
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
from pyarrow.parquet import write_table
from rosbags import rosbag1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy import ndimage
from scipy.io import savemat

from asi_analysis.arrays import Array
from asi_analysis.bags.bag import read_bag, write_bag
from asi_analysis.bags.bag_writer import typestore
from asi_analysis.bags.exchange.exporting import export
from asi_analysis.bags.exchange.importing import import_recording
from asi_analysis.bags.exchange.preview import preview
from asi_analysis.bags.run import SIGNALS, Run
from asi_analysis.errors import InputError
from asi_analysis.experiments.experiment import read_parameters
from asi_analysis.gap.answer.command import diagnose
from asi_analysis.limit_cycle.detection.answer import detect_limit_cycles
from asi_analysis.loop.in_process import simulate
from asi_analysis.measures.analysis import analyze
from asi_common.parameter import ParameterError
from torture.rig import ROOT, Rig, Tally

FILES: Final = 10_000
# Damaged inputs of each kind, most of which once ended in a traceback or a wrong figure.
KEPT: Final = ROOT / 'test/analysis/bags/corpus'
SAMPLES: Final = 1500
MAP: Final = ['time=time_s', 'force=force_n', 'reference=reference_n']
DATASET_MAP: Final = ['time=timestamp', 'force=observation.state.force[N]',
                      'reference=action.force[N]']
ROS_1_MAP: Final = ['force=/force_n/data', 'reference=/reference_n/data']
# What a text file may contain instead of a number.
WORDS: Final = (b'', b'nan', b'1e400', b'-', b'"', b'1,5', b'-19m', b'12:00 PM', b'\xff', b'\x00',
                b'[1, 2]', b'!!python/object:os.system', b'*a', b'2001-13-45', b'1' * 400, b'\n',
                b'{', b'~', b'0x1F', b'1:99', b'<<: *x')
# Figures of a step, and how far each may differ from that of the undamaged recording, beside 3 %.
FIGURES: Final = {'rise_time_s': 5e-4, 'overshoot_percent': 0.6, 'settling_time_2_s': 2e-3,
                  'steady_state_error_n': 0.3, 'bandwidth_hz': 0.7}
OF_CYCLES: Final = {'frequency_hz': 0.3, 'amplitude_n': 0.5}


class Answer(NamedTuple):
    """Figures and verdicts of an analysis, which of them it calls reliable, and its notes."""

    figures: dict[str, float | str | None]
    reliable: dict[str, bool]
    said: bool


def recording() -> Run:
    """Return a step response of n samples with noise, as an engineer's log would hold it."""
    time_s = np.arange(SAMPLES) / 1000.0
    t = np.maximum(time_s - 0.5, 0.0)
    force = 100.0 * (1.0 - np.exp(-50.0 * t) * (np.cos(120.0 * t) + 0.4 * np.sin(120.0 * t)))
    force += 0.05 * np.random.default_rng(1).normal(size=SAMPLES)
    return Run(time_s, np.where(time_s < 0.5, 0.0, 100.0), None, force)


def cycle() -> Run:
    """Return a loop that a step of n samples leaves in a limit cycle of 80 Hz, with noise."""
    time_s = np.arange(SAMPLES) / 1000.0
    t = np.maximum(time_s - 0.3, 0.0)
    swing = 40.0 * (1.0 - np.exp(-12.0 * t))
    phase = 2.0 * np.pi * 80.0 * t
    force = np.where(t > 0.0, 100.0, 0.0) + swing * (np.sin(phase) + 0.1 * np.sin(3.0 * phase))
    force += 0.2 * np.random.default_rng(2).normal(size=SAMPLES)
    return Run(time_s, np.where(t > 0.0, 100.0, 0.0), None, force)


def with_a_gap() -> Run:
    """Return the simulator's run with twice the mass that `of_gap` expects."""
    return simulate({'load.type': 'spring', 'load.mass': 0.6}, {
        'compensator': 'lead_lag', 'reference.shape': 'multisine',
        'reference.amplitude': 150.0}, 1.5, 1000.0)


def with_command() -> Run:
    """Return a run of the simulator that holds its command and controller, as `asi run` writes."""
    return simulate({'load.type': 'spring', 'force_sensor.noise': 0.3}, {
        'compensator': 'lead4', 'reference.shape': 'step', 'reference.amplitude': 100.0,
        'gain_schedule.velocity': 0.5}, 0.6, 1000.0)


def saturated() -> Run:
    """Return a run of the simulator whose command is saturated for long, with its controller."""
    return simulate({'load.type': 'spring', 'force_sensor.noise': 0.3}, {
        'compensator': 'lead4', 'reference.shape': 'step', 'reference.amplitude': 100.0,
        'saturation': 110.0}, 0.6, 1000.0)


def without_command() -> Run:
    """Return the run of `with_command` with its reference and force alone."""
    return replace(with_command(), command_n=None, valve_position_m=None, position_m=None,
                   velocity_m_s=None)


def corpus(folder: Path) -> list[Path]:
    """Write one good file of each kind; return them."""
    run = recording()
    columns = {'time_s': run.time_s, 'reference_n': run.reference_n, 'force_n': run.force_n}
    export(run, folder / 'good.csv')
    export(run, folder / 'good.parquet')
    text = (folder / 'good.csv').read_text()
    (folder / 'comma.txt').write_text(text.replace(',', ';').replace('.', ','))
    (folder / 'blank.dat').write_text('# a remark\n# ' + text.replace(',', ' '))
    (folder / 'good.csv.gz').write_bytes(gzip.compress(text.encode()))
    (folder / 'good.json').write_text(json.dumps({name: values.tolist() for name, values
                                                  in columns.items()}))
    (folder / 'good.jsonl').write_text(''.join(
        json.dumps(dict(zip(columns, row, strict=True))) + '\n'
        for row in zip(*(values.tolist() for values in columns.values()), strict=True)))
    dataset = _as_dataset(run, folder / 'dataset')
    np.savez_compressed(folder / 'good.npz', **columns)  # type: ignore[arg-type]
    write_bag(run, folder / 'bag')
    as_sqlite(folder / 'bag', folder / 'sqlite')
    shutil.move(next((folder / 'sqlite').glob('*.db3')), folder / 'good.db3')
    _as_ros_1(run, folder / 'good.bag')
    savemat(folder / 'good.mat', columns, do_compression=True)
    (folder / 'good.yaml').write_text(
        'asi_actuator:\n  ros__parameters:\n    load:\n      type: spring\n      mass: 5e-1\n')
    return [path for path in sorted(folder.iterdir()) if path.is_file() and path.suffix != '.mat'
            ] + [next((folder / 'bag').glob('*.mcap')), folder / 'bag/metadata.yaml',
                 *dataset, folder / 'good.mat']


def kept() -> list[Path]:
    """Return what `read` takes of each damaged input that is kept in the repository."""
    return sorted(path for path in KEPT.rglob('*') if path.is_file() and (
        path.parent == KEPT or path.name in ('metadata.yaml', 'info.json')))


def as_sqlite(bag: Path, out: Path, mode: CompressionMode = CompressionMode.NONE
              ) -> None:
    """Write a bag again, as one of sqlite3 that may be compressed."""
    store = typestore()
    with Reader(bag) as reader:
        writer = Writer(out, version=9, storage_plugin=StoragePlugin.SQLITE3)
        writer.set_compression(mode, CompressionFormat.ZSTD)
        with writer:
            to = {each.topic: writer.add_connection(each.topic, each.msgtype, typestore=store)
                  for each in reader.connections}
            for connection, time_ns, data in reader.messages():
                writer.write(to[connection.topic], time_ns, data)


def _as_dataset(run: Run, out: Path) -> list[Path]:
    """Write reference and force as a LeRobot dataset (v3); return the files to damage."""
    info, data = out / 'meta/info.json', out / 'data/chunk-000/file-000.parquet'
    info.parent.mkdir(parents=True)
    data.parent.mkdir(parents=True)
    of_force = {'dtype': 'float32', 'shape': [1], 'names': ['force']}
    of_place = {'dtype': 'int64', 'shape': [1], 'names': None}
    info.write_text(json.dumps({
        'codebase_version': 'v3.0', 'fps': 1000, 'total_episodes': 1, 'chunks_size': 1000,
        'data_path': 'data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet', 'features': {
            'observation.state': of_force | {'shape': [2], 'names': ['force', 'same']},
            'action': of_force | {'shape': [2], 'names': ['force', 'same']},
            'timestamp': of_force | {'names': None}, 'episode_index': of_place}}))
    write_table(pa.table({
        **{name: pa.array(np.column_stack(2 * [run.signal(signal)]).tolist(),
                          pa.list_(pa.float32()))
           for name, signal in (('observation.state', 'force'), ('action', 'reference'))},
        'timestamp': pa.array(run.time_s, pa.float32()),
        'episode_index': pa.array(np.zeros(len(run), int))}), data, write_page_checksum=True)
    return [info, data]


def dataset_of(path: Path) -> Path | None:
    """Return the dataset that a file is part of."""
    return next((each for each in path.parents if each.name == 'dataset'), None)


def _as_ros_1(run: Run, out: Path) -> None:
    """Write reference and force of a run as a bag of ROS 1."""
    store, kind = get_typestore(Stores.ROS1_NOETIC), 'std_msgs/msg/Float64'
    with rosbag1.Writer(out) as writer:
        for name in ('reference', 'force'):
            topic = writer.add_connection(f'/{name}_n', kind, typestore=store)
            for time_s, value in zip(run.time_s, run.signal(name), strict=True):
                writer.write(topic, round((100.0 + time_s) * 1e9),
                             store.serialize_ros1(store.types[kind](value), kind))


def damaged(data: bytes, random: Random) -> bytes:
    """Return a file with one to three kinds of damage."""
    for _ in range(random.randint(1, 3)):
        size = len(data)
        place = random.randrange(size + 1)
        kind = random.randrange(6)
        if kind == 0:
            data = data[:place]
        elif kind == 1 and size:
            bits = bytearray(data)
            for _ in range(random.choice((1, 1, 1, 10, 100))):
                bits[random.randrange(size)] ^= 1 << random.randrange(8)
            data = bytes(bits)
        elif kind == 2:
            data = data[:place] + random.choice(WORDS) + data[place:]
        elif kind == 3:     # a cell, a name, a number
            end = min([at for mark in (b',', b'\n', b' ') if (at := data.find(mark, place)) > 0],
                      default=place)
            data = data[:place] + random.choice(WORDS) + data[end:]
        elif kind == 4:
            data = data[:place] + bytes(min(512, size - place)) + data[place + 512:]
        else:
            data = data[:place] + data[place // 2:]
    return data


def by_radamsa(data: bytes, random: Random) -> bytes:
    """Return a file, damaged by radamsa, which knows nothing of these formats."""
    import pyradamsa
    return bytes(pyradamsa.Radamsa().fuzz(data, seed=random.getrandbits(32)))


def read(path: Path) -> Answer | None:
    """
    Preview and read a file as its name says; return its analysis, None if it is no recording.

    Raises what a user would see.
    """
    if path.suffix == '.yaml' and path.name != 'metadata.yaml':
        read_parameters(path, 'actuator')
        return None
    dataset = dataset_of(path)
    if dataset is not None:
        path = dataset
    if path.suffix not in ('.mcap', '.db3', '.yaml'):
        with contextlib.suppress(InputError):
            str(preview(path))
    run = (read_bag(path.parent if path.name == 'metadata.yaml' else path)
           if path.suffix in ('.mcap', '.db3') or path.name == 'metadata.yaml'
           else import_recording(path, DATASET_MAP if dataset else
                                 ROS_1_MAP if path.suffix == '.bag' else MAP))
    return of_step(run) if len(run) > 1 else None


def file_problem(good: Path, folder: Path, random: Random) -> str:
    """Damage a file of the corpus and read it; return what is wrong with that, '' if nothing."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    if good.name == 'metadata.yaml':
        shutil.copy(next(good.parent.glob('*.mcap')), folder)
    path, dataset = folder / good.name, dataset_of(good)
    if dataset is not None:
        shutil.copytree(dataset, folder / dataset.name)
        path = folder / good.relative_to(dataset.parent)
    damage = {'own': damaged, 'radamsa': by_radamsa}[os.environ.get('TORTURE_FUZZER', 'own')]
    path.write_bytes(damage(good.read_bytes(), random))
    try:
        with warnings.catch_warnings(record=True) as noted:
            warnings.simplefilter('always')
            found = read(path)
            right = _undamaged(good)
    except (InputError, ParameterError, OSError) as error:
        return f'the refusal has several lines: {error}' if '\n' in str(error) else ''
    except Exception as error:  # noqa: B902 - whatever it is, a user would see it
        return f'{type(error).__name__}: {error}'
    return difference(found, right) if found and right and not noted else ''


@functools.cache
def _undamaged(good: Path) -> Answer | None:
    return read(good)


def spoilt(run: Run, random: Random) -> tuple[str, Run]:
    """Return what was done to the samples of a recording, and the recording."""
    force, time_s, reference = (values.copy() for values in (
        run.signal('force'), run.time_s, run.signal('reference')))
    kept = np.ones(len(run), bool)
    place, length = random.randrange(50, len(run) - 150), random.randint(1, 100)
    part = slice(place, place + length)
    kind = random.choice(('rows lost', 'cells empty', 'every nth empty', 'clipped', 'spike',
                          'early', 'unit', 'rows twice', 'clock set', 'quantised', 'sign',
                          'sign of a part', 'unit from there', 'frozen', 'cell cut',
                          'spike of the reference', 'copied', 'time rounded',
                          *(OF_COMMAND if run.information else ())))
    if kind == 'rows lost':
        kept[part] = False
    elif kind == 'cells empty':
        force[part] = np.nan
    elif kind == 'every nth empty':
        force[::random.randint(2, 5)] = np.nan
    elif kind == 'clipped':
        force = np.minimum(force, force.min() + random.uniform(0.6, 0.95) * np.ptp(force))
    elif kind == 'spike':
        force[place] = random.choice((-1.0, 1.0)) * 10.0**random.uniform(2.5, 9.0)
    elif kind == 'early':
        force = np.append(force[50:], force[-50:])
    elif kind == 'unit':
        force *= random.choice((1e-3, 1e3))
    elif kind == 'rows twice':
        time_s[part] = time_s[place]
    elif kind == 'clock set':
        time_s[place:] += random.choice((60.0, 3600.0))
    elif kind == 'quantised':
        force = np.round(force / 10.0) * 10.0
    elif kind == 'sign':
        force = -force
    elif kind == 'sign of a part':
        force[part] *= -1.0
    elif kind == 'unit from there':
        force[place:] *= 1000.0
    elif kind == 'frozen':
        force[part] = force[place]
    elif kind in OF_COMMAND:
        force, reference = OF_COMMAND[kind](force, reference, random)
    elif kind == 'copied':
        force = reference.copy()
    elif kind == 'time rounded':
        to_s = random.uniform(0.1, 3.0) * run.period_s
        time_s = to_s * np.round(time_s / to_s)
    elif kind == 'cell cut':
        force[-1] = force[-1] // 10.0
    else:
        reference[place] = random.choice((-1e4, 500.0, 1e9))
    signals: dict[str, Any] = {signal.field: getattr(run, signal.field) for signal in SIGNALS}
    signals |= {'force_n': force, 'reference_n': reference}
    return kind, Run(time_s[kept], information=run.information, **{
        name: values if values is None else values[kept] for name, values in signals.items()})


def _without_a_bit(force: Array, random: Random) -> Array:
    span = float(np.ptp(force))
    counts = np.round(4095.0 * (force - force.min()) / span).astype(int)
    return np.asarray(force.min() + (counts & ~(1 << random.randint(5, 9))) * span / 4095.0)


def _reversed_from(place: int, force: Array, reference: Array) -> tuple[Array, Array]:
    return (np.append(force[:place], force[place:][::-1]),
            np.append(reference[:place], reference[place:][::-1]))


def _noise(force: Array, random: Random, size: float) -> Array:
    return np.random.default_rng(random.getrandbits(32)).normal(0.0, size, len(force))


# Changes of force and reference that only the command shows.
OF_COMMAND: Final[dict[str, Callable[[Array, Array, Random], tuple[Array, Array]]]] = {
    'scale of the reference': lambda force, reference, random: (
        force, random.choice((0.5, 2.0, 3.0)) * reference),
    'scale of the force': lambda force, reference, random: (
        random.uniform(1.05, 1.5) * force, reference),
    'offset': lambda force, reference, random: (force + random.uniform(1.0, 50.0), reference),
    'low pass': lambda force, reference, random: (
        ndimage.gaussian_filter1d(force, random.uniform(1.0, 10.0)), reference),
    'drifting clock': lambda force, reference, random: (
        np.interp(np.arange(len(force)) * random.choice((0.97, 0.99)), np.arange(len(force)),
                  force), reference),
    'saturated converter': lambda force, reference, random: (
        np.minimum(force, 0.8 * force.max()) + _noise(force, random, 0.2), reference),
    'missing bit': lambda force, reference, random: (_without_a_bit(force, random), reference),
    'held': lambda force, reference, random: (
        np.repeat(force[::2], 2)[:len(force)], reference),
    'sign lost': lambda force, reference, random: (np.abs(force), reference),
    'reversed from there': lambda force, reference, random: _reversed_from(
        random.randrange(len(force)), force, reference),
    'another run': lambda force, reference, random: (
        force + _noise(force, random, 0.5), reference),
}


def of_step(run: Run) -> Answer:
    """Return the answer of `asi analyze`."""
    found = analyze(run)
    return Answer({name: found[name] for name in FIGURES}, found['reliable'],
                  bool(found['quality']))


def of_cycle(run: Run) -> Answer:
    """Return the answer of `asi limit-cycle` for the last segment."""
    found = detect_limit_cycles(run)
    last = found['segments'][-1]
    figures = {name: last[name] for name in ('verdict', 'frequency_hz', 'amplitude_n')}
    return Answer(figures, dict.fromkeys(figures, last['reliable']), bool(found['quality']))


def of_gap(run: Run) -> Answer:
    """Return the answer of `asi gap`."""
    found = diagnose([run], {'load.type': 'spring', 'load.mass': 0.3})
    figures = {'verdict': found['verdict'],
               **{name: value for row in found['which'] if row['probability'] > 0.5
                  for name, value in row['parameters'].items()}}
    return Answer(figures, dict.fromkeys(figures, found['reliable']), bool(found['quality']))


def figure_problem(run: Run, random: Random, analysis: Callable[[Run], Answer] = of_step,
                   right: Answer | None = None) -> str:
    """
    Return which figure of a spoilt recording differs though nothing is said, '' if none.

    right: the answer for the undamaged one, if it is known.
    """
    kind, worse = spoilt(run, random)
    right = right or analysis(run)
    try:
        found = analysis(worse)
    except InputError:
        return ''
    silent = difference(found, right)
    return silent and f'{kind}: {silent}'


def difference(found: Answer, right: Answer) -> str:
    """Return which figure differs silently, or is called reliable; '' if none."""
    for name, value in found.figures.items():
        if not found.said and _differ(name, value, right.figures.get(name), 0.03):
            return f'{name} is {value} for {right.figures}, without a note'
        if found.reliable.get(name) and _differ(name, value, right.figures.get(name), 0.1):
            return f'{name} is {value} for {right.figures}, and is called reliable'
    return ''


def _differ(name: str, value: float | str | None, right: float | str | None, share: float
            ) -> bool:
    if value is None:
        return False
    if isinstance(value, float) and isinstance(right, float):
        least = (FIGURES | OF_CYCLES).get(name, 0.0)
        return not math.isclose(value, right, rel_tol=share, abs_tol=least)
    return value != right


def inputs(rig: Rig, tally: Tally, end: float) -> None:
    """Damage files and samples: ten thousand files, or until the time is over."""
    folder = rig.folder / 'corpus'
    folder.mkdir()
    files = corpus(folder)
    # Samples of a recording after so many files: a limit cycle and a gap take longer.
    analyses = ((4, recording(), of_step), (5, with_command(), of_step),
                (7, saturated(), of_step), (9, without_command(), of_step),
                (100, cycle(), of_cycle), (500, with_a_gap(), of_gap))
    rights: dict[int, Answer] = {}
    for number in range(FILES):
        if time.monotonic() > end:
            return
        tally.notes['files damaged'] = number + 1
        good = files[number % len(files)]
        tally.count(f'{good.name} damaged', file_problem(good, rig.folder / 'bad', rig.random))
        for every, run, analysis in analyses:
            if number % every == every - 1:
                right = rights.setdefault(every, rights.get(every) or analysis(run))
                tally.count(f'samples spoilt, {analysis.__name__}',
                            figure_problem(run, rig.random, analysis, right))
