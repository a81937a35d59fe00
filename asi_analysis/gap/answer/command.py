"""`asi gap`: recordings and a nominal model in, the diagnosis out."""

import math
import warnings
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path

from asi_actuator.parameters import ACTUATOR_PARAMETERS
from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError, InputWarning
from asi_analysis.experiments.experiment import TABLES, read_parameters
from asi_analysis.gap.answer.show import Gap
from asi_analysis.gap.diagnose import diagnose as diagnosis_of
from asi_analysis.gap.diagnose import document, plain
from asi_analysis.gap.model.group import TOLERANCE
from asi_analysis.gap.model.joint import OF_ANY_SIZE
from asi_analysis.measures.quality import quality_of
from asi_analysis.terminal import Progress, silent
from asi_common.parameter import ParameterError, Value, completed

PLANTS = ('actuator', 'joint')
LEAST_TOLERANCE = 1e-3
DRIVES = (None, 'force', 'position')


Model = str | Path | Mapping[str, Value]


def nominal_model(model: Model | None, plant: str = 'actuator') -> dict[str, Value]:
    """
    Return the actuator's parameters of a model, by name or in a file; {} without one.

    Mass and damping of a joint may be of any size. Warns of a name that is no parameter; under
    /** a file may have the controller's. Raises InputError for a value out of its range.
    """
    if model is None:
        return {}
    known = {parameter.name for parameter in ACTUATOR_PARAMETERS}
    path = 'model' if isinstance(model, Mapping) else Path(model)
    found = model if isinstance(model, Mapping) else read_parameters(Path(model), 'actuator')
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


def diagnose(runs: Sequence[Run], model: Model | None = None, plant: str = 'actuator',
             held_out: Sequence[Run] = (), tolerance: float = TOLERANCE, drive: str | None = None,
             progress: Progress = silent) -> Gap:
    """
    Return where recordings of the real machine differ from their model, why, and how far.

    model: nominal parameters by name or a ROS parameter file; None: the defaults. plant:
    'actuator', or 'joint' for any rigid joint or drive. held_out: recordings on which the result
    is only judged. tolerance: how far the nominal parameters may be off, as a share. drive: of a
    joint, 'force' or 'position'; None: by its signals. Raises InputError for recordings that
    cannot be judged; `notes` says what is doubtful.

    >>> import asi_analysis as asi
    >>> runs = [asi.read_bag('real_1'), asi.read_bag('real_2')]           # doctest: +SKIP
    >>> gap = asi.diagnose(runs, {'load.mass': 0.3})                      # doctest: +SKIP
    >>> print(gap)                                                        # doctest: +SKIP
    """
    if plant not in PLANTS:
        raise InputError(f'--plant {plant!r} is not allowed: one of {", ".join(PLANTS)}')
    if drive not in DRIVES:
        raise InputError(f'--drive {drive!r} is not allowed: force or position')
    if not LEAST_TOLERANCE <= tolerance < 1.0:
        raise InputError(f'--tolerance {tolerance:g} is not allowed: from {LEAST_TOLERANCE:g}, '
                         'below 1')
    values = nominal_model(model, plant)
    everything = [*runs, *held_out]
    diagnosis = diagnosis_of(everything, values, plant, tolerance,
                             [False] * len(runs) + [True] * len(held_out), drive, progress)
    answer = plain(document(diagnosis))
    if plant == 'actuator':
        from asi_analysis.gap.answer.consequences import consequences
        progress('in the loop', None)
        answer['consequences'] = plain([each._asdict() for each
                                        in consequences(diagnosis, values, runs[0])])
        following = answer['next_experiment']
        if isinstance(model, str | Path) and following and following['command']:
            for key in ('command', 'advice'):
                following[key] += f' --actuator {model}'
    return Gap(answer | {'report': None, 'quality': quality_of(everything)},
               runs=everything, diagnosis=diagnosis,
               model=values if plant == 'actuator' else None)
