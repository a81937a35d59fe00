"""
Write blind cases as bags without hints, and the answers in one sealed file beside them.

A directory of cases: `nominal_WORLD_LOAD.yaml` (the model file that a user would have), `case_K/`
(bags whose name and metadata tell nothing), `fresh_K/` (another recording of the same machine),
`cases.json` (which bags and model belong together) and `answers.sealed` (compressed, so that no
search in the files finds a hint).
"""

import base64
import json
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from asi_analysis.bag import write_bag
from asi_analysis.parallel import each
from asi_analysis.run import Run
from asi_examiner.cases import EFFECTS, NOISE, Case, draw, excite
from asi_examiner.plant import PERIOD_S, simulate

HIDDEN = {'all': (), 'no_valve': ('valve_position_m',), 'no_velocity': ('velocity_m_s',),
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
    return simulate(case.plant, reference, case.closed, 1.0 / 0.535, NOISE, case.seed + 1_000_000)


def model_text(nominal: Mapping[str, Any]) -> str:
    """Return the nominal parameters as a ROS parameter file."""
    tree: dict[str, Any] = {}
    for name, value in nominal.items():
        *outer, last = name.split('.')
        branch = tree
        for part in outer:
            branch = branch.setdefault(part, {})
        branch[last] = value
    return yaml.safe_dump({'/**/asi_actuator': {'ros__parameters': tree}})


def write_case(case: Case, out: Path, number: int, signals: str = 'all') -> Answer:
    """Write one case's bag, its fresh bag and its model; return the answer."""
    write_bag(as_run(case.recording, HIDDEN[signals]), out / f'case_{number:04d}', {})
    write_bag(as_run(fresh(case), HIDDEN[signals]), out / f'fresh_{number:04d}', {})
    (out / f'nominal_{case.world}_{case.load}.yaml').write_text(model_text(case.nominal))
    return Answer(case.kind, list(case.effects),
                  [EFFECTS[name] for name in case.effects if name in EFFECTS], case.excitation,
                  case.world, case.load, signals, case.visibility)


def _write(out: Path, number: int, seed: int, world: str, load: str, signals: str) -> Answer:
    return write_case(draw(seed, world, load), out, number, signals)


def write_cases(out: Path, count: int, seed: int, world: str = 'textbook', load: str = 'spring',
                signals: str = 'all') -> Iterator[int]:
    """Write `count` cases of seeds from `seed` on into a directory; yields how many are done."""
    out.mkdir(parents=True, exist_ok=True)
    names = [f'{number:04d}' for number in range(count)]
    (out / 'cases.json').write_text(json.dumps([
        {'bag': f'case_{name}', 'fresh': f'fresh_{name}', 'model': f'nominal_{world}_{load}.yaml'}
        for name in names], indent=1))
    answers = {}
    written = each(_write, ((out, number, seed + number, world, load, signals)
                            for number in range(count)))
    for done, (name, answer) in enumerate(zip(names, written, strict=True), 1):
        answers[f'case_{name}'] = answer._asdict()
        yield done
    seal(answers, out / 'answers.sealed')


def seal(answers: Mapping[str, Any], path: Path) -> None:
    """Write answers so that they cannot be read by chance."""
    path.write_bytes(base64.b85encode(zlib.compress(json.dumps(answers).encode())))

