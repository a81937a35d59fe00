"""What `asi gap` does: bags and a model file in, the document out."""

import math
import warnings
from collections.abc import Callable, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from asi_actuator.parameters import ACTUATOR_PARAMETERS
from asi_analysis.bags.bag import read_bag
from asi_analysis.errors import InputError, InputWarning
from asi_analysis.experiments.experiment import TABLES, read_parameters
from asi_analysis.gap.diagnose import diagnose, document, plain
from asi_analysis.gap.model.joint import OF_ANY_SIZE
from asi_common.parameter import ParameterError, Value, completed

PLANTS = ('actuator', 'joint')
LEAST_TOLERANCE = 1e-3
DRIVES = (None, 'force', 'position')


def nominal_model(path: Path | None, plant: str = 'actuator') -> dict[str, Value]:
    """
    Return the actuator's parameters of a model file, in their ranges; {} without one.

    Mass and damping of a joint may be of any size.
    Warns of what is none; under /** there may be the controller's. Raises InputError.
    """
    if path is None:
        return {}
    known = {parameter.name for parameter in ACTUATOR_PARAMETERS}
    found = read_parameters(path, 'actuator')
    for name in found.keys() - known - {parameter.name for parameter in TABLES['controller']}:
        near = get_close_matches(name, known, 1)
        warnings.warn(f'{path}: {name} is no parameter of the actuator, and left out'
                      + (f': did you mean {near[0]}?' if near else ''), InputWarning, stacklevel=2)
    values = {name: value for name, value in found.items() if name in known}
    ranged = dict(values)
    for name in OF_ANY_SIZE & values.keys() if plant == 'joint' else ():
        value = ranged.pop(name)
        number = isinstance(value, int | float) and 0.0 <= value < math.inf
        if not number or (name == 'load.mass' and value == 0.0):
            raise InputError(f'{path}: {name} = {value!r} is not allowed: it takes a number '
                             + ('above 0' if name == 'load.mass' else 'from 0'))
    try:
        completed(ranged, ACTUATOR_PARAMETERS)
    except ParameterError as error:
        raise InputError(f'{path}: {error}') from None
    return values


def run(bags: Sequence[Path], model: Path | None, plant: str, held_out: Sequence[Path],
        tolerance: float, drive: str | None, report: Path | None,
        told: Callable[[str, float | None], None]) -> dict[str, Any]:
    """Return the document of `asi gap`. Raises InputError."""
    if plant not in PLANTS:
        raise InputError(f'--plant {plant!r} is not allowed: one of {", ".join(PLANTS)}')
    if drive not in DRIVES:
        raise InputError(f'--drive {drive!r} is not allowed: force or position')
    if not LEAST_TOLERANCE <= tolerance < 1.0:
        raise InputError(f'--tolerance {tolerance:g} is not allowed: from {LEAST_TOLERANCE:g}, '
                         'below 1')
    told('reading', None)
    runs = [read_bag(path) for path in (*bags, *held_out)]
    values = nominal_model(model, plant)
    diagnosis = diagnose(runs, values, plant, tolerance,
                         [False] * len(bags) + [True] * len(held_out), drive, told)
    answer = plain(document(diagnosis))
    if plant == 'actuator':
        from asi_analysis.gap.answer.consequences import consequences
        told('in the loop', None)
        answer['consequences'] = plain([each._asdict() for each
                                        in consequences(diagnosis, values, runs[0])])
        following = answer['next_experiment']
        if model is not None and following and following['command']:
            for key in ('command', 'advice'):
                following[key] += f' --actuator {model}'
    answer['report'] = None
    if report is not None:
        from asi_analysis.gap.answer.report import write_gap_report
        told('report', None)
        answer['report'] = str(write_gap_report(diagnosis, answer, runs[0], report,
                                                values if plant == 'actuator' else None))
    return answer
