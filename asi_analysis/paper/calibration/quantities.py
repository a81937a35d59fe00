"""What a search may vary: parameters of the actuator, and the conditions of Table 1."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Final, NamedTuple

from asi_actuator.parameters import ACTUATOR_PARAMETERS
from asi_analysis.errors import InputError
from asi_analysis.free_parameter import FreeParameter, Scale
from asi_analysis.loop.bench import Values
from asi_analysis.paper.facts.conditions import Conditions, StepTest
from asi_common.files import write_text
from asi_common.parameter import Value, completed, defaults
from asi_controller.compensator import OWN_GAIN
from asi_controller.parameters import COMPENSATOR_PARAMETERS


class Candidate(NamedTuple):
    """A point of the search as what it stands for."""

    actuator: Values
    conditions: Conditions


def _value(one: Candidate, name: str) -> float:
    """Return a quantity of a candidate: an actuator's parameter or 'conditions.TEST.NAME'."""
    actuator = completed(one.actuator, ACTUATOR_PARAMETERS)
    kind, _, rest = name.partition('.')
    if kind != 'conditions':
        return float(actuator[name])
    which, _, parameter = rest.partition('.')
    test: StepTest = getattr(one.conditions, which)
    return float({**actuator, **defaults(COMPENSATOR_PARAMETERS), 'gain': OWN_GAIN[which],
                  **test.controller, **test.load, 'amplitude_n': test.amplitude_n}[parameter])


def _free(name: str, low: float, high: float, scale: Scale = Scale.LOG) -> FreeParameter:
    return FreeParameter(name, _value(Candidate({}, Conditions()), name), low, high, scale)


FREE: Final = (
    _free('valve_flexure.coil_frequency', 14.0, 40.0),
    _free('valve_flexure.natural_frequency', 150.0, 2500.0),
    _free('valve_flexure.damping_ratio', 0.2, 2.0, Scale.LINEAR),
    _free('valve_flexure.delay', 5e-5, 2.5e-3),
    _free('force_sensor.natural_frequency', 200.0, 2500.0),
    _free('force_sensor.card_frequency', 200.0, 5000.0),
    _free('force_sensor.delay', 5e-5, 1.5e-3),
    _free('force_sensor.mass_share', 0.0, 1.0, Scale.LINEAR),
    _free('valve_hysteresis.radius', 8.0, 30.0, Scale.LINEAR),
    _free('valve_hysteresis.lag_time', 2e-4, 4e-3),
    _free('valve_hysteresis.rate_exponent', 0.0, 1.0, Scale.LINEAR),
    _free('valve_hysteresis.rate_filter', 60.0, 10000.0),
    _free('valve_hysteresis.saturation', 900.0, 8000.0),
    _free('hydraulic_damping.centre_share', 0.02, 1.0),
    _free('hydraulic_damping.saturation_velocity', 0.01, 0.8),
    _free('hydraulic_damping.saturation_shift', -0.7, 0.7, Scale.LINEAR),
    _free('hydraulic_damping.saturation_narrowing', -0.7, 0.7, Scale.LINEAR),
    _free('hydraulic_damping.velocity_width', 0.01, 0.4),
    _free('hydraulic_damping.width_growth', 0.0, 3.0, Scale.LINEAR),
    _free('hydraulic_damping.viscous', 5.0, 5000.0),
    _free('friction.presliding_stiffness', 3e4, 2e6),
    _free('friction.presliding_damping', 5.0, 3000.0),
    _free('load.mass', 0.2, 5.0),
    _free('load.locked_stiffness', 1e5, 2e7),
    _free('load.locked_damping', 10.0, 10000.0),
    _free('conditions.proportional.amplitude_n', 100.0, 850.0),
    _free('conditions.proportional.load.mass', 0.2, 6.0),
    _free('conditions.proportional.load.stiffness', 4e3, 5e5),
    _free('conditions.proportional.load.damping', 1.0, 1500.0),
    _free('conditions.lead_lag.gain', 3.0, 45.0),
    _free('conditions.lead_lag.lead_lag.centre_frequency', 60.0, 100.0, Scale.LINEAR),
    _free('conditions.lead_lag.amplitude_n', 50.0, 750.0),
    _free('conditions.lead4.gain', 0.5, 30.0),
    _free('conditions.lead4.lead4.zero_frequency', 60.0, 800.0),
    _free('conditions.lead4.lead4.ratio', 1.2, 14.0),
    _free('conditions.lead4.lead4.lag_ratio', 1.5, 1000.0),
    _free('conditions.lead4.amplitude_n', 50.0, 750.0),
)
# The actuator's parameters; the others are conditions of Table 1.
PHYSICAL: Final = tuple(k for k, free in enumerate(FREE)
                        if not free.name.startswith('conditions'))


class Structure(NamedTuple):
    """A structure of the model to search: what it says, and the quantities that it holds fixed."""

    words: str
    fixed: Mapping[str, float] = {}
    one_load: bool = False        # all three controllers of Table 1 on the load of the first


STRUCTURES: Final[Mapping[str, Structure]] = {
    'side': Structure('the sensor feels any share of the inertia of the mass'),
    'cylinder': Structure('the sensor between cylinder and piston: it feels all of the inertia',
                          {'force_sensor.mass_share': 0.0}),
    'one-load': Structure('as side, with one load for all of Table 1', one_load=True),
}
TESTS: Final = ('proportional', 'lead_lag', 'lead4')


def candidate(quantities: Mapping[str, float], fixed: Values, base: Conditions,
              one_load: bool = False) -> Candidate:
    """Return actuator and conditions: those of `fixed` and `base`, changed by `quantities`."""
    actuator: dict[str, Value] = dict(fixed)
    tests: dict[str, StepTest] = {name: getattr(base, name) for name in TESTS}
    for name, value in quantities.items():
        kind, _, rest = name.partition('.')
        if kind != 'conditions':
            actuator[name] = value
            continue
        which, _, parameter = rest.partition('.')
        test = tests[which]
        if parameter == 'amplitude_n':
            tests[which] = test._replace(amplitude_n=value)
        elif parameter.startswith('load.'):
            tests[which] = test._replace(load={**test.load, parameter: value})
        else:
            tests[which] = test._replace(controller={**test.controller, parameter: value})
    if one_load:
        tests = {name: test._replace(load=tests['proportional'].load)
                 for name, test in tests.items()}
    return Candidate(actuator, base._replace(
        proportional=tests['proportional'], lead_lag=tests['lead_lag'], lead4=tests['lead4']))


def quantities(one: Candidate) -> dict[str, float]:
    """Return the quantities of FREE that belong to a candidate, by name."""
    return {free.name: _value(one, free.name) for free in FREE}


def write_best(one: Candidate, path: Path) -> None:
    """Write a candidate as JSON: parameters of the actuator, and the tests of Table 1."""
    tests = {name: getattr(one.conditions, name)._asdict() for name in TESTS}
    write_text(path, json.dumps({'actuator': one.actuator, 'table_1': tests}, indent=2) + '\n')


def read_best(path: Path) -> Candidate:
    """Return a candidate that `write_best` wrote. Raises InputError if the file holds none."""
    try:
        document = json.loads(path.read_text())
        tests = {name: StepTest(**document['table_1'][name]) for name in TESTS}
        return Candidate(document['actuator'], Conditions(
            proportional=tests['proportional'], lead_lag=tests['lead_lag'],
            lead4=tests['lead4']))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f'{path} holds no result of a calibration: {error}') from None
