"""The free quantities of a search: parameters of the actuator, and conditions of Table 1."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Final, NamedTuple

from asi_actuator.parameters import ACTUATOR_PARAMETERS
from asi_analysis.errors import InputError
from asi_analysis.free_parameter import FreeParameter, Scale
from asi_analysis.loop.bench import Values
from asi_analysis.paper.facts.conditions import LOCKED, SPRING, Conditions, StepTest
from asi_common.files import read_text, write_text
from asi_common.parameter import Value, completed, defaults
from asi_controller.compensator import OWN_GAIN
from asi_controller.parameters import COMPENSATOR_PARAMETERS


class Candidate(NamedTuple):
    """A point of the search: actuator parameters and conditions."""

    actuator: Values
    conditions: Conditions


def _value(one: Candidate, name: str) -> float:
    """Return a quantity of a candidate: an actuator parameter or a condition of Table 1."""
    actuator = completed(one.actuator, ACTUATOR_PARAMETERS)
    kind, _, rest = name.partition('.')
    if kind != 'conditions':
        return float(actuator[name])
    which, _, parameter = rest.partition('.')
    if which == 'step_n':
        return one.conditions.proportional.amplitude_n
    test: StepTest = getattr(one.conditions, 'proportional' if which == 'load' else which)
    return float({**actuator, **defaults(COMPENSATOR_PARAMETERS), 'gain': OWN_GAIN.get(which, 0.0),
                  **test.controller, **test.load}[rest if which == 'load' else parameter])


def _free(name: str, low: float, high: float, source: str, scale: Scale = Scale.LOG
          ) -> FreeParameter:
    return FreeParameter(name, _value(Candidate({}, Conditions()), name), low, high, scale,
                         source=source)


JUDGED: Final = 'judgement: '
VALVE: Final = JUDGED + 'jet-pipe valve of a small actuator; the paper says 20 Hz open loop'
FIG_3: Final = 'Fig. 3: the damping builds up and saturates within 1 m/s'
CARD: Final = JUDGED + 'analogue card of the 1990s: conditioning between 0.2 and 5 kHz'
SEALS: Final = JUDGED + 'seals that break away at 27 N after 0.01 to 1 mm'
IRON: Final = JUDGED + 'soft iron: its slope grows several times from small to large fields'
TABLE_1: Final = 'the paper does not say; within the thrust and the range of its leads'
# The bounds are the physically plausible ranges, so that a search stays within them.
FREE: Final = (
    _free('valve_flexure.coil_frequency', 14.0, 40.0, VALVE),
    _free('valve_flexure.natural_frequency', 150.0, 2500.0, VALVE),
    _free('valve_flexure.damping_ratio', 0.2, 2.0, VALVE, Scale.LINEAR),
    _free('valve_flexure.delay', 5e-5, 2.5e-3, JUDGED + 'jet, lines and sampling'),
    _free('force_sensor.natural_frequency', 200.0, 2500.0, JUDGED + 'flexure of a few 1e6 N/m'),
    _free('force_sensor.card_frequency', 200.0, 5000.0, CARD),
    _free('force_sensor.delay', 5e-5, 1.5e-3, JUDGED + 'conversion and transfer'),
    _free('force_sensor.mass_share', 0.0, 1.0, 'by definition', Scale.LINEAR),
    _free('valve_hysteresis.radius', 8.0, 30.0, 'Table 1: 6 N at Kp = 3; up to 3 % of the thrust',
          Scale.LINEAR),
    _free('valve_hysteresis.lag_time', 2e-4, 4e-3, JUDGED + 'eddy currents in solid iron'),
    _free('valve_hysteresis.rate_exponent', 0.0, 1.0, JUDGED + 'eddy currents', Scale.LINEAR),
    _free('valve_hysteresis.rate_filter', 60.0, 10000.0, JUDGED + 'eddy currents'),
    _free('valve_hysteresis.saturation', 1000.0, 8000.0, 'Fig. 4: linear up to the thrust'),
    _free('hydraulic_damping.centre_share', 0.02, 1.0, FIG_3),
    _free('hydraulic_damping.saturation_velocity', 0.01, 0.8, FIG_3),
    _free('hydraulic_damping.saturation_shift', -0.7, 0.7, FIG_3, Scale.LINEAR),
    _free('hydraulic_damping.saturation_narrowing', -0.7, 0.7, FIG_3, Scale.LINEAR),
    _free('hydraulic_damping.velocity_width', 0.01, 0.4, FIG_3),
    _free('hydraulic_damping.width_growth', 0.0, 3.0, FIG_3, Scale.LINEAR),
    _free('hydraulic_damping.viscous', 5.0, 5000.0, FIG_3),
    _free('friction.presliding_stiffness', 3e4, 2e6, SEALS),
    _free('friction.presliding_damping', 5.0, 3000.0, SEALS),
    _free('load.mass', 0.2, 5.0, 'section 2.1: the package weighs 0.5 kg; with a fixture'),
    _free('load.locked_stiffness', 1e5, 2e7, JUDGED + 'steel fixture with its joints'),
    _free('load.locked_damping', 10.0, 10000.0, 'see the damping ratio'),
    _free('conditions.step_n', 20.0, 850.0, TABLE_1),
    _free('conditions.load.mass', 0.2, 6.0, TABLE_1),
    _free('conditions.load.stiffness', 4e3, 1e7, TABLE_1),
    _free('conditions.load.damping', 1.0, 1500.0, TABLE_1),
    _free('conditions.lead_lag.gain', 3.0, 45.0, TABLE_1),
    _free('conditions.lead_lag.lead_lag.centre_frequency', 60.0, 100.0,
          'section 5: maximum action from 60 to 100 Hz', Scale.LINEAR),
    _free('conditions.lead4.gain', 0.5, 30.0, TABLE_1),
    _free('conditions.lead4.lead4.zero_frequency', 60.0, 800.0, TABLE_1),
    _free('conditions.lead4.lead4.ratio', 1.2, 14.0, TABLE_1),
    _free('conditions.lead4.lead4.lag_ratio', 1.5, 1000.0, TABLE_1),
    _free('conditions.lead4.lead4.lag_time', 0.05, 0.6, TABLE_1),
    _free('valve_hysteresis.widening', 0.0, 8.0, IRON, Scale.LINEAR),
    _free('valve_hysteresis.widening_from', 0.0, 1500.0, IRON, Scale.LINEAR),
    _free('valve_hysteresis.widening_range', 50.0, 6000.0, IRON),
)
# Only the structures whose loop widens with the amplitude vary these.
ONE_PLAY: Final = {'valve_hysteresis.widening': 0.0, 'valve_hysteresis.widening_from': 0.0,
                   'valve_hysteresis.widening_range': 1500.0}
NO_RATE: Final = {'valve_hysteresis.lag_time': 0.0, 'valve_hysteresis.rate_exponent': 0.0,
                  'valve_hysteresis.rate_filter': 1000.0}
# Values of a part that is switched off: they have no plausible range.
OFF: Final = {'valve_hysteresis.lag_time': 0.0, **ONE_PLAY}
# The quantities of the model with one play; those that are the actuator's parameters, and not
# conditions of Table 1.
ONE_PLAYS: Final = tuple(free for free in FREE if free.name not in ONE_PLAY)
PHYSICAL: Final = tuple(k for k, free in enumerate(FREE) if free in ONE_PLAYS
                        and not free.name.startswith('conditions'))


class Structure(NamedTuple):
    """A variant of the model for a search, and the quantities fixed in it."""

    words: str
    fixed: Mapping[str, float] = {}
    load: Mapping[str, Value] | None = None      # of Table 1; None: that of the start


STRUCTURES: Final[Mapping[str, Structure]] = {
    'side': Structure('the sensor feels any share of the inertia of the mass', ONE_PLAY),
    'cylinder': Structure('the sensor between cylinder and piston: it feels all of the inertia',
                          {**ONE_PLAY, 'force_sensor.mass_share': 0.0}),
    'behind': Structure('the sensor behind the mass: it feels none of the inertia',
                        {**ONE_PLAY, 'force_sensor.mass_share': 1.0}),
    'locked': Structure('Table 1 with the piston locked', ONE_PLAY, load=LOCKED),
    'spring': Structure('Table 1 on a spring with a mass', ONE_PLAY, load=SPRING),
    'static': Structure('a static loop alone: it widens with the amplitude, not with the rate',
                        NO_RATE),
    'widening': Structure('a loop that widens with the amplitude and with the rate'),
}
TESTS: Final = ('proportional', 'lead_lag', 'lead4')


def candidate(quantities: Mapping[str, float], fixed: Values, base: Conditions) -> Candidate:
    """
    Return actuator and conditions: those of `fixed` and `base`, changed by `quantities`.

    Table 1 keeps one load and one step for its three controllers.
    """
    actuator: dict[str, Value] = dict(fixed)
    load, step_n = dict(base.proportional.load), base.proportional.amplitude_n
    controllers = {name: dict(getattr(base, name).controller) for name in TESTS}
    for name, value in quantities.items():
        kind, _, rest = name.partition('.')
        which, _, parameter = rest.partition('.')
        if kind != 'conditions':
            actuator[name] = value
        elif which == 'step_n':
            step_n = value
        elif which == 'load':
            load[rest] = value
        else:
            controllers[which][parameter] = value
    if load['load.type'] == 'locked':
        load = dict(LOCKED)
    return Candidate(actuator, with_tests(base, {
        name: StepTest(controller, step_n, load) for name, controller in controllers.items()}))


def with_tests(base: Conditions, tests: Mapping[str, StepTest]) -> Conditions:
    """Return conditions with other tests of Table 1, by the names of TESTS."""
    return base._replace(proportional=tests['proportional'], lead_lag=tests['lead_lag'],
                         lead4=tests['lead4'])


def quantities(one: Candidate) -> dict[str, float]:
    """Return the quantities of FREE that belong to a candidate, by name."""
    return {free.name: _value(one, free.name) for free in FREE}


def write_best(one: Candidate, path: Path) -> None:
    """Write a candidate as JSON: parameters of the actuator, and the tests of Table 1."""
    tests = {name: getattr(one.conditions, name)._asdict() for name in TESTS}
    write_text(path, json.dumps({'actuator': one.actuator, 'table_1': tests}, indent=2) + '\n')


def read_best(path: Path) -> Candidate:
    """
    Return a candidate from a file of `write_best`.

    Raises InputError if the file has none, or one with several loads or steps in Table 1.
    """
    try:
        document = json.loads(read_text(path))
        tests = {name: StepTest(**document['table_1'][name]) for name in TESTS}
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f'{path} holds no result of a calibration: {error}') from None
    first = tests['proportional']
    if any(test.amplitude_n != first.amplitude_n or test.load != first.load
           for test in tests.values()):
        raise InputError(f'{path}: Table 1 takes one load and one step for its three tests')
    return Candidate(document['actuator'], with_tests(Conditions(), tests))
