"""The metadata `asi.run` of a bag: what experiment it is, and the units of its signals."""

import math
from collections.abc import Callable, Mapping
from typing import Any, Final

from asi_actuator.parameters import ACTUATOR_PARAMETERS
from asi_analysis.bags.run import CONTROLLED, SIGNALS
from asi_common.parameter import is_number


def _is_mapping(value: object) -> bool:
    return isinstance(value, dict)


def _are_finite(value: object) -> bool:
    return isinstance(value, dict) and all(
        -math.inf < each < math.inf for each in value.values() if is_number(each))


def _are_parameters(value: object) -> bool:
    return isinstance(value, dict) and all(
        is_number(number := value.get(parameter.name, parameter.default))
        and -math.inf < number < math.inf
        for parameter in ACTUATOR_PARAMETERS if isinstance(parameter.default, float))


def _is_experiment(value: object) -> bool:
    return isinstance(value, dict) and all(
        is_number(value.get(name, 1.0)) for name in ('rate_hz', 'ticks'))


def _is_import(value: object) -> bool:
    return (isinstance(value, dict)
            and _are(str, value.get('problems', []))
            and _are(float, value.get('repeated_times_s', [])))


def _are(kind: type, values: object) -> bool:
    return isinstance(values, list) and all(isinstance(each, kind) for each in values)


def _are_units(value: object) -> bool:
    names = {signal.name for signal in SIGNALS}
    return (isinstance(value, dict) and value.keys() <= names
            and all(isinstance(unit, str) for unit in value.values())
            and value.get('reference', 'N') in CONTROLLED)


FORMS: Final[dict[str, Callable[[object], bool]]] = {
    'experiment': _is_experiment, 'actuator': _are_parameters, 'controller': _are_finite,
    'versions': _is_mapping, 'imported': _is_import, 'signals': _are_units}


def missing_ticks(information: Mapping[str, Any], samples: int) -> int:
    """Return how many samples a recording lacks of the run in lock-step that it was made of."""
    experiment = information.get('experiment', {})
    ticks = experiment.get('ticks', 0) if experiment.get('mode') == 'lockstep' else 0
    return max(0, int(ticks) - samples) if math.isfinite(ticks) else 0


def checked(information: Mapping[str, Any], problems: list[str], source: str) -> dict[str, Any]:
    """
    Return the metadata without entries of another form than this package writes.

    `problems` gets a sentence for each that is left out.
    """
    wrong = [name for name, value in information.items()
             if name in FORMS and not FORMS[name](value)]
    problems += [f'{source}: its metadata {name} = {str(information[name])[:60]!r} cannot be '
                 'used, and is left out' for name in wrong]
    return {name: value for name, value in information.items() if name not in wrong}
