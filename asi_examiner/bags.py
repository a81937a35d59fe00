"""
Write blind cases as bags without hints, and the answers in one sealed file beside them.

A directory of cases: `nominal_WORLD_LOAD.yaml` (the model file that a user would have; of foreign
worlds one for each case, `nominal_K.yaml`), `case_K/` (bags whose name and metadata tell nothing),
`fresh_K/` (another recording of the same machine), `cases.json` (which bags and model belong
together), `examiner.json` (what was asked for) and `answers.sealed` (compressed, so that no search
in the files finds a hint).
"""

import base64
import json
import shutil
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from asi_analysis.bags.bag import write_bag
from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError
from asi_analysis.parallel import each
from asi_common.parameter_file import write_parameters
from asi_examiner.cases import EFFECTS, Case, draw, excite
from asi_examiner.own import draw_own, truth
from asi_examiner.plant import PERIOD_S, simulate

HIDDEN = {'all': (), 'no_valve': ('valve_position_m',), 'no_velocity': ('velocity_m_s',),
          'no_position': ('position_m',),
          'force_only': ('valve_position_m', 'velocity_m_s', 'position_m')}


class Answer(NamedTuple):
    """The sealed answer of a case."""

    kind: str               # effect, pair, none, small or outside
    effects: list[str]
    blocks: list[str]
    excitation: str
    world: str
    load: str
    signals: str
    visibility: float       # in multiples of the noise
    sizes: dict[str, float]   # of the effects, those in the diagnosis' units, by its names
    rate_hz: float = 1000.0


# Parameters of an effect that mean the same here and there, and their names there.
SAME = {'extra_delay': 'command_delay', 'bias': 'command_bias', 'deadband': 'command_deadband',
        'quantum': 'command_quantum', 'force_limit': 'force_limit', 'supply_drop': 'supply_drop',
        'friction': 'friction_level', 'asymmetry': 'friction_asymmetry', 'viscous': 'viscous',
        'gap': 'backlash', 'push_constant': 'disturbance', 'push_burst': 'disturbance_pulse',
        'sensor_offset': 'sensor_offset', 'sensor_scale': 'sensor_gain_error'}


def as_run(recording: np.ndarray, hidden: tuple[str, ...] = ()) -> Run:
    """Return a recording (5 x n) as a run; without the hidden signals."""
    time = (1.0 + np.arange(recording.shape[1], dtype=np.float64)) * PERIOD_S
    fields = {'command_n': recording[0], 'force_n': recording[1],
              'valve_position_m': recording[2], 'position_m': recording[3],
              'velocity_m_s': recording[4]}
    return Run(time, **{name: values for name, values in fields.items() if name not in hidden})


def fresh(case: Case) -> np.ndarray:
    """Return another recording of the same machine: other noise, another course."""
    rng = np.random.default_rng([case.seed, 11])
    reference = excite(case.excitation, rng, float(np.abs(case.reference).max()))
    return simulate(case.plant, reference, case.bench, case.seed + 1_000_000)


def model_name(world: str, load: str, number: int) -> str:
    """Return the model file of a case: one for all, but of the foreign and the own world."""
    return f'nominal_{number:04d}.yaml' if world in ('foreign', 'own') else (
        f'nominal_{world}_{load}.yaml')


def write_case(case: Case, out: Path, number: int, signals: str = 'all') -> Answer:
    """Write one case's bag, its fresh bag and its model; return the answer."""
    for torn in (f'case_{number:04d}', f'fresh_{number:04d}'):   # of a call that was stopped
        shutil.rmtree(out / torn, ignore_errors=True)
    write_bag(as_run(case.recording, HIDDEN[signals]), out / f'case_{number:04d}', {})
    write_bag(as_run(fresh(case), HIDDEN[signals]), out / f'fresh_{number:04d}', {})
    write_parameters(out / model_name(case.world, case.load, number), '/**/asi_actuator',
                     dict(sorted(case.nominal.items())))
    return Answer(case.kind, list(case.effects),
                  [EFFECTS[name] for name in case.effects if name in EFFECTS], case.excitation,
                  case.world, case.load, signals, case.visibility,
                  {there: float(case.plant[here]) for here, there in SAME.items()
                   if case.plant[here] != case.without[here]})


def write_own(seed: int, out: Path, number: int) -> Answer:
    """Write one case of the simulator itself, its fresh bag and its model; return the answer."""
    case = draw_own(seed)
    for name, run in (('case', case.run), ('fresh', case.fresh)):
        shutil.rmtree(out / f'{name}_{number:04d}', ignore_errors=True)
        write_bag(run, out / f'{name}_{number:04d}', {})
    write_parameters(out / model_name('own', '', number), '/**/asi_actuator', case.nominal)
    kind, effects, blocks = truth(case)
    return Answer(kind, effects, blocks, case.excitation, 'own', str(case.nominal['load.type']),
                  'all', case.visibility, {}, case.rate_hz)


def _write(out: Path, number: int, seed: int, world: str, load: str, signals: str) -> Answer:
    if world == 'own':
        return write_own(seed, out, number)
    return write_case(draw(seed, world, load), out, number, signals)


def write_cases(out: Path, count: int, seed: int, world: str = 'textbook', load: str = 'spring',
                signals: str = 'all') -> Iterator[int]:
    """
    Write `count` cases of seeds from `seed` on into a directory; yields how many are done.

    A directory that the same call left undone is gone on with; raises InputError for any other.
    """
    asked = {'count': count, 'seed': seed, 'world': world, 'load': load, 'signals': signals}
    call, index, sealed = out / 'examiner.json', out / 'cases.json', out / 'answers.sealed'
    if not out.exists():
        out.mkdir(parents=True)
        call.write_text(json.dumps(asked))
    elif not call.exists() or json.loads(call.read_text()) != asked:
        raise InputError(f'{out} exists already: give another --out, or that directory as an '
                         'argument to check it again')
    answers = _opened(sealed) if sealed.exists() else {}
    first = len(answers)
    written = each(_write, ((out, number, seed + number, world, load, signals)
                            for number in range(first, count)))
    for number, answer in enumerate(written, first):
        answers[f'case_{number:04d}'] = answer._asdict()
        seal(answers, sealed)
        _replace(index, json.dumps(
            [{'bag': f'case_{done:04d}', 'fresh': f'fresh_{done:04d}',
              'model': model_name(world, load, done)} for done in range(number + 1)],
            indent=1).encode())
        yield number + 1


def seal(answers: Mapping[str, Any], path: Path) -> None:
    """Write answers so that they cannot be read by chance."""
    _replace(path, base64.b85encode(zlib.compress(json.dumps(answers).encode())))


def _opened(path: Path) -> dict[str, Any]:
    return json.loads(zlib.decompress(base64.b85decode(path.read_bytes())))


def _replace(path: Path, content: bytes) -> None:
    """Write a file whole or not at all."""
    part = path.with_suffix('.part')
    part.write_bytes(content)
    part.replace(path)
