"""
Write blind cases as bags, and the answers to one sealed file.

A directory of cases: `nominal_WORLD_LOAD.yaml` (the user's model file; `nominal_K.yaml` for each
case of the foreign and own worlds), `case_K/` (bags whose names and metadata do not depend on the
answer), `case_K_2/` and so on (more recordings of the same machine, to be diagnosed together),
`fresh_K/` (another one, for validation; neither for a joint), `cases.json` (the bags and model of
each case), `examiner.json` (the arguments of the call) and `answers.sealed` (compressed, so that a
text search does not find an answer).
"""

import base64
import json
import shutil
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from asi_analysis.bags.bag import write_bag
from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError
from asi_analysis.parallel import each
from asi_common.files import write_text
from asi_common.parameter_file import write_parameters
from asi_examiner.cases import EFFECTS, Case, draw, excite
from asi_examiner.joint import draw_joint
from asi_examiner.own import SMALLER, draw_own, truth
from asi_examiner.plant import PERIOD_S, simulate
from asi_examiner.static import answer_of, draw_static

# The signals that a bag omits, by the value of --signals.
OMITTED = {'all': (), 'no_valve': ('valve_position_m',), 'no_velocity': ('velocity_m_s',),
           'no_position': ('position_m',),
           'force_only': ('valve_position_m', 'velocity_m_s', 'position_m')}

JOINTS = ('joint', 'mixed')   # worlds of joints


class Answer(NamedTuple):
    """The sealed answer of a case."""

    kind: str               # effect, pair, none, small, outside or mixed
    effects: list[str]
    blocks: list[str]
    excitation: str
    world: str
    load: str
    signals: str
    visibility: float       # in multiples of the noise
    sizes: dict[str, float]   # of effects that the diagnosis estimates, by its names and units
    rate_hz: float = 1000.0
    also: tuple[str, ...] = ()   # small effects, parameters: naming one besides is not wrong


# Parameters of the plant with the same meaning in the diagnosis, and their names there.
SHARED_PARAMETERS = {
    'extra_delay': 'command_delay', 'bias': 'command_bias', 'deadband': 'command_deadband',
    'quantum': 'command_quantum', 'force_limit': 'force_limit', 'supply_drop': 'supply_drop',
    'friction': 'friction_level', 'asymmetry': 'friction_asymmetry', 'viscous': 'viscous',
    'gap': 'backlash', 'push_constant': 'disturbance', 'push_burst': 'disturbance_pulse',
    'sensor_offset': 'sensor_offset', 'sensor_scale': 'sensor_gain_error'}


def as_run(recording: np.ndarray, omitted: tuple[str, ...] = ()) -> Run:
    """Return a recording (5 x n, `plant.simulate`) as a run, without the omitted signals."""
    time = (1.0 + np.arange(recording.shape[1], dtype=np.float64)) * PERIOD_S
    fields = {'command_n': recording[0], 'force_n': recording[1],
              'valve_position_m': recording[2], 'position_m': recording[3],
              'velocity_m_s': recording[4]}
    return Run(time, **{name: values for name, values in fields.items() if name not in omitted})


def fresh_recording(case: Case, number: int = 1) -> np.ndarray:
    """
    Return another recording of the same machine, with other noise and another excitation.

    number: from 2 on, the excitation is smaller, and a disturbance comes at another time.
    """
    rng = np.random.default_rng([case.seed, 10 + number])
    peak, machine = float(np.abs(case.reference).max()), case.plant.copy()
    if number > 1:
        peak *= rng.uniform(*SMALLER)
        machine['push_phase'] = rng.uniform(0.0, 2.0 * np.pi)
        later = rng.uniform(-1.0, 1.0)
        machine['burst_start'], machine['burst_end'] = (
            machine[name] + later for name in ('burst_start', 'burst_end'))
    reference = excite(case.excitation, rng, peak)
    return simulate(machine, reference, case.bench, case.seed + number * 1_000_000)


def model_name(world: str, load: str, number: int) -> str:
    """Return the name of a case's model file; only foreign and own cases have one each."""
    return f'nominal_{number:04d}.yaml' if world in ('foreign', 'own') else (
        f'nominal_{world}_{load}.yaml')


def _names(number: int, recordings: int) -> list[str]:
    """Return the names of a case's bags, the fresh one last."""
    first = f'case_{number:04d}'
    return [first, *(f'{first}_{n}' for n in range(2, recordings + 1)), f'fresh_{number:04d}']


class _Made(NamedTuple):
    """A case to be written: its answer, its recordings, the fresh one last, and its model."""

    answer: Answer
    runs: Sequence[Run]
    nominal: Mapping[str, Any] | None = None


def _made(case: Case, signals: str, recordings: int) -> _Made:
    made = [case.recording, *(fresh_recording(case, n) for n in range(2, recordings + 1)),
            fresh_recording(case)]
    return _Made(Answer(
        case.kind, list(case.effects),
        [EFFECTS[name] for name in case.effects if name in EFFECTS], case.excitation,
        case.world, case.load, signals, case.visibility,
        {name: float(case.plant[key]) for key, name in SHARED_PARAMETERS.items()
         if case.plant[key] != case.without[key]}, also=case.small),
        [as_run(recording, OMITTED[signals]) for recording in made],
        dict(sorted(case.nominal.items())))


def _own(seed: int, recordings: int) -> _Made:
    case = draw_own(seed, recordings)
    return _Made(Answer(
        *truth(case), case.excitation, 'own', str(case.nominal['load.type']), 'all',
        case.visibility, case.sizes, case.rate_hz),
        # Without what they hold of their simulation.
        [replace(run, information={}) for run in (case.run, *case.more, case.fresh)],
        case.nominal)


def _joint(seed: int, recordings: int, world: str) -> _Made:
    """Return a joint, which has no model and no fresh recording."""
    case = draw_joint(seed, recordings, world == 'mixed')
    return _Made(Answer(case.kind, list(case.effects), list(case.blocks), case.excitation, world,
                        '', 'all', case.visibility, {}, case.rate_hz, case.also), case.runs)


def _static(seed: int) -> _Made:
    case = draw_static(seed)
    units = {'signals': {'command': 'A', 'pressure': 'Pa'}}
    return _Made(Answer(**answer_of(case), world='static', load='', signals='all',
                        visibility=case.visibility, sizes={}),
                 [Run(made.time_s, command_n=made.given, pressure_pa=made.got, information=units)
                  for made in (*case.recordings, case.fresh)])


def _write(out: Path, number: int, seed: int, world: str, load: str, signals: str,
           recordings: int, beyond: float | None) -> Answer:
    """Write a case, in place of an incomplete one of a call that was stopped."""
    made = (_own(seed, recordings) if world == 'own' else
            _joint(seed, recordings, world) if world in JOINTS else
            _static(seed) if world == 'static' else
            _made(draw(seed, world, load, beyond=beyond), signals, recordings))
    count = len(made.runs) - (world not in JOINTS)
    for name, run in zip(_names(number, count), made.runs, strict=False):
        shutil.rmtree(out / name, ignore_errors=True)
        write_bag(run, out / name)
    if made.nominal is not None:
        write_parameters(out / model_name(world, load, number), '/**/asi_actuator', made.nominal)
    return made.answer


def write_cases(out: Path, count: int, seed: int, world: str = 'textbook', load: str = 'spring',
                signals: str = 'all', recordings: int = 1, beyond: float | None = None
                ) -> Iterator[int]:
    """
    Write `count` cases with seeds from `seed` on into a directory; yields the number written.

    An incomplete directory of the same call is completed; raises InputError for any other.
    """
    arguments = {'count': count, 'seed': seed, 'world': world, 'load': load,
                 'signals': signals, 'recordings': recordings, 'beyond': beyond}
    call, index, sealed = out / 'examiner.json', out / 'cases.json', out / 'answers.sealed'
    if not out.exists():
        out.mkdir(parents=True)
        write_text(call, json.dumps(arguments))
    elif not call.exists() or json.loads(call.read_text()) != arguments:
        raise InputError(f'{out} exists already: give another --out, or that directory as an '
                         'argument to check it again')
    answers = (json.loads(zlib.decompress(base64.b85decode(sealed.read_bytes())))
               if sealed.exists() else {})
    first = len(answers)
    written = each(_write, ((out, number, seed + number, world, load, signals, recordings,
                                     beyond)
                            for number in range(first, count)))
    for number, answer in enumerate(written, first):
        answers[f'case_{number:04d}'] = answer._asdict()
        seal(answers, sealed)
        write_text(index, json.dumps([_entry(out, done, world, load, recordings)
                                      for done in range(number + 1)], indent=1))
        yield number + 1


def _entry(out: Path, number: int, world: str, load: str, recordings: int) -> dict[str, Any]:
    """Return the bags and the model of a case, as cases.json lists them."""
    if world in JOINTS:   # neither a model nor a fresh bag
        first, *more, _ = _names(number, recordings)
        return {'bag': first, 'more': more, 'plant': 'joint'}
    if world == 'static':   # one or two recordings, and no model
        names = [name for name in _names(number, 2) if (out / name).exists()]
        rest: dict[str, Any] = {'model': None, 'plant': 'static'}
    else:
        names, rest = _names(number, recordings), {'model': model_name(world, load, number)}
    return {'bag': names[0], 'more': names[1:-1], 'fresh': names[-1], **rest}


def seal(answers: Mapping[str, Any], path: Path) -> None:
    """Write answers compressed, so that they are not read by accident."""
    write_text(path, base64.b85encode(zlib.compress(json.dumps(answers).encode())).decode())
