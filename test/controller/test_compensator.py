"""The compensators against python-control, saturated, changed while running, and refused."""

import math
from collections.abc import Callable
from pathlib import Path

import control
import numpy as np
import numpy.typing as npt
import pytest
from scipy import signal

from asi_actuator.model.actuator import measure, rest, step
from asi_actuator.parameters import as_record
from asi_common.parameter import ParameterError, Value
from asi_controller import compensators
from asi_controller.compensator import (
    OWN_GAIN,
    PREWARP_HZ,
    compensate,
    compensator,
    design,
    frequency_response,
)
from asi_controller.compensators import COMPENSATORS, DOCUMENTATION
from asi_controller.parameters import COMPENSATOR_PARAMETERS

RATES = [1000.0, 5000.0, 20000.0]
NOTCH: dict[str, Value] = {'compensator': 'custom', 'gain': 2.0,
                           'custom.zeros': '-3+565j, -3-565j', 'custom.poles': '-400, -400'}
COMPLEX_POLES: dict[str, Value] = {'compensator': 'custom', 'custom.zeros': '-30',
                                   'custom.poles': '-50+300j, -50-300j'}
UNSTABLE_ZERO: dict[str, Value] = {'compensator': 'custom', 'custom.zeros': '200',
                                   'custom.poles': '-2, -900'}
ADDED: dict[str, Value] = {
    'integrator.rate': 20.0, 'hysteresis_inverse.size': 20.0, 'reference_model.bandwidth': 100.0}
# The file of a newcomer: CONTRIBUTING.md.
LEAD_LAG_WITH_NOTCH = """
import math
from asi_common.parameter import Parameter
from asi_controller.compensators import lead_lag
from asi_controller.design import Compensator, Design

def design(gain, notch_frequency, **settings):
    zeros, poles, gain = lead_lag.design(gain, **settings)
    omega = 2.0 * math.pi * notch_frequency
    return Design((*zeros, 1j * omega, -1j * omega), (*poles, -omega, -omega), gain)

COMPENSATOR = lead_lag.COMPENSATOR._replace(
    name='newcomer', order=99, design=design,
    parameters=(*lead_lag.COMPENSATOR.parameters,
                Parameter('notch_frequency', 90.0, 'Hz', 'Centre of the notch', 0.1, 1e4)))
"""
ALL: list[dict[str, Value]] = [*({'compensator': name} for name in OWN_GAIN), NOTCH,
                               COMPLEX_POLES, UNSTABLE_ZERO]


def test_a_compensator_is_one_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / 'newcomer.py').write_text(LEAD_LAG_WITH_NOTCH)
    monkeypatch.setattr(compensators, '__path__', [*compensators.__path__, str(tmp_path)])
    *others, last = (module.COMPENSATOR for module in compensators._declared())
    assert others == list(COMPENSATORS.values())
    assert [each.name for each in last.table][-1] == 'newcomer.notch_frequency'
    ours = {each.name.rpartition('.')[2]: each.default for each in last.table}
    zeros, poles, gain = last.design(5.0, **ours)
    notched = control.zpk(zeros, poles, 1.0)(2j * np.pi * 90.0)
    assert abs(notched) < 1e-9 and (len(zeros), len(poles), gain) == (3, 4, 5.0)


def exact(values: dict[str, Value], frequencies_hz: npt.NDArray[np.float64]
          ) -> npt.NDArray[np.complex128]:
    """Return python-control's response of the design in continuous time."""
    zeros, poles, gain = design(values)
    system = control.zpk(zeros, poles, 1.0)
    return gain / system.dcgain() * system(2j * np.pi * frequencies_hz, squeeze=True)


@pytest.mark.parametrize('rate', RATES)
@pytest.mark.parametrize('values', ALL, ids=str)
def test_response_is_that_of_the_design(values: dict[str, Value], rate: float) -> None:
    frequencies = np.concatenate([np.geomspace(0.01, 0.4 * rate, 60), [PREWARP_HZ]])
    ours = frequency_response(compensator(values, rate), frequencies, rate)
    # Tustin's rule bends the axis of frequencies, and does nothing else.
    bent = (np.tan(np.pi * frequencies / rate) / math.tan(math.pi * PREWARP_HZ / rate)
            * PREWARP_HZ)
    np.testing.assert_allclose(ours, exact(values, bent), rtol=1e-7)
    # So up to a tenth of the rate it is the design, most exactly where the limit cycle is.
    assert bent[-1] == PREWARP_HZ
    low = frequencies <= rate / 10
    straight = exact(values, frequencies[low])
    assert np.abs(ours[low] - straight).max() < 0.12 * np.abs(straight).max()


@pytest.mark.parametrize('rate', RATES)
@pytest.mark.parametrize('values', ALL, ids=str)
def test_filter_does_what_its_response_says(values: dict[str, Value], rate: float) -> None:
    c = compensator(values | {'feedforward': 0.0, 'saturation': 1e5}, rate)
    n, cycle = 40 * 64, 64
    tone = np.sin(2 * np.pi * np.arange(n) / cycle)
    compensate(c, 0.0, 0.0, 0.0)  # begins at rest
    out = np.array([compensate(c, error, 0.0, 0.0) for error in tone])
    late, wave = slice(-4 * cycle, None), np.exp(-2j * np.pi * np.arange(n) / cycle)
    gain = 2j * np.mean(out[late] * wave[late])
    theirs = frequency_response(c, [rate / cycle], rate)[0]
    # What is left of the slow pole's own motion after 40 cycles hardly reaches this harmonic.
    assert abs(gain - theirs) < 0.01 * abs(theirs)


@pytest.mark.parametrize('rate', RATES)
@pytest.mark.parametrize('values', ALL, ids=str)
def test_every_pole_is_stable_and_the_slowest_is_last(values: dict[str, Value], rate: float
                                                      ) -> None:
    c = compensator(values, rate)
    poles = [abs(np.roots([1.0, a1, a2])).max() for *_, a1, a2 in c['sections'][:c['count']]]
    slowest = -c['lag'][2]
    assert max(poles, default=0.0) < 1.0 and slowest < 1.0
    if values in (NOTCH, COMPLEX_POLES):
        assert slowest == 0.0  # no real pole that could stand alone
    else:
        assert slowest >= max(poles, default=0.0)


def naive(values: dict[str, Value]) -> Callable[[float, float], float]:
    """Return the same compensator without anti-windup: scipy's filter, then the limits."""
    c = compensator(values, RATE)
    sos = np.insert(c['sections'][:c['count']], 3, 1.0, axis=1)
    (b0, b1, a1), lag_memory, memory = c['lag'], np.zeros(1), np.zeros((len(sos), 2))

    def command(reference: float, force: float) -> float:
        nonlocal memory, lag_memory
        value = [reference - force]
        if len(sos):
            value, memory = signal.sosfilt(sos, value, zi=memory)
        value, lag_memory = signal.lfilter([b0, b1], [1.0, a1], value, zi=lag_memory)
        return float(np.clip(c['gain'] * value[0] + c['feedforward'] * reference,
                             -c['saturation'], c['saturation']))
    return command


def ours(values: dict[str, Value]) -> Callable[[float, float], float]:
    """Return the compensator as a function."""
    c = compensator(values, RATE)
    return lambda reference, force: compensate(c, reference, force, 0.0)


RATE = 5000.0


def closed(command: Callable[[float, float], float], reference: npt.NDArray[np.float64]
           ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return forces and commands (N) of the actuator in a loop."""
    p, state, forces, commands = as_record(), rest(), [], []
    for desired in reference:
        forces.append(measure(state, p)[0])
        commands.append(command(desired, forces[-1]))
        step(state, commands[-1], p, 1.0 / RATE)
    return np.array(forces), np.array(commands)


WITH_LAG = [name for name, each in COMPENSATORS.items()
            if 'lag_time' in {parameter.name for parameter in each.parameters}]


@pytest.mark.parametrize('name', [
    WITH_LAG[0], *(pytest.param(name, marks=pytest.mark.slow) for name in WITH_LAG[1:])])
def test_saturated_step_recovers_without_windup(name: str) -> None:
    # For half a second more than the actuator can give, then less.
    reference = np.repeat([0.0, 1500.0, 300.0], [100, 2500, 2500])
    values: dict[str, Value] = {'compensator': name, 'saturation': 2000.0}
    force, commands = closed(ours(values), reference)
    wound, _ = closed(naive(values), reference)
    assert commands.max() == 2000.0 and commands[2500] == 2000.0  # exactly, not nearly

    def error(forces: npt.NDArray[np.float64]) -> float:
        return float(np.mean(np.abs(forces[2650:] - 300.0)))

    assert error(force) < 0.25 * error(wound)


CHANGES: list[tuple[dict[str, Value], dict[str, Value]]] = [
    ({'gain': 3.0}, {'gain': 8.0}),
    ({'compensator': 'lead_lag'}, {'compensator': 'lead2'}),
    (NOTCH, COMPLEX_POLES),
    ({}, ADDED),
    (ADDED, ADDED | {'integrator.rate': 60.0, 'hysteresis_inverse.size': 10.0}),
]
MORE_CHANGES: list[tuple[dict[str, Value], dict[str, Value]]] = [
    ({}, {'compensator': 'lead_lag'}),
    ({'compensator': 'lead_lag'}, {'compensator': 'lead_lag', 'gain': 25.0}),
    ({'compensator': 'lead2'}, {}),
    ({}, {'feedforward': 0.0}),
    (ADDED, {}),
]


def changed(before: dict[str, Value], after: dict[str, Value], desired: float
            ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return forces and commands (N) of a loop whose compensator changes at tick 2500."""
    running = compensator(before, RATE)
    ticks = 0

    def command(reference: float, force: float) -> float:
        nonlocal running, ticks
        ticks += 1
        if ticks == 2501:
            running = compensator(after, RATE, running)
        return compensate(running, reference, force, 0.0)
    return closed(command, np.repeat([0.0, desired], [50, 4950]))


@pytest.mark.parametrize(('before', 'after'), [
    *CHANGES, *(pytest.param(*each, marks=pytest.mark.slow) for each in MORE_CHANGES)], ids=str)
def test_change_while_running_makes_no_step(before: dict[str, Value], after: dict[str, Value]
                                            ) -> None:
    _, commands = changed(before, after, 300.0)
    steps = np.abs(np.diff(commands[2490:])) / abs(commands[2499])
    assert steps[9] < 1e-3
    # Afterwards the command moves, but in a tick by no more than a transfer of 20 ms makes it.
    assert steps[10:].max() < 0.03


@pytest.mark.parametrize('saturation', [1500.0, 1000.0])
def test_change_while_saturated_leaves_the_command_there(saturation: float) -> None:
    # The excess was faded in as if it were a step: the command fell to an eighth for 20 ms.
    values: dict[str, Value] = {'gain': 6.0, 'saturation': 1500.0}
    c = compensator(values, RATE)
    before = [compensate(c, 2000.0, 0.0, 0.0) for _ in range(3)]
    c = compensator(values | {'gain': 6.01, 'saturation': saturation}, RATE, c)
    after = [compensate(c, 2000.0, force, 0.0) for force in (0.0, 500.0, 1500.0)]
    assert before == [1500.0] * 3 and after == [saturation] * 3


def test_change_that_saturates_leaves_nothing_of_it_behind() -> None:
    # The excess stayed in the bias: the command was -2000 N when the error had gone.
    values: dict[str, Value] = {'gain': 2.0, 'saturation': 2000.0}
    c = compensator(values, RATE)
    before = [compensate(c, 500.0, 0.0, 0.0) for _ in range(3)]
    c = compensator(values | {'gain': 40.0}, RATE, c)
    after = [compensate(c, 500.0, force, 0.0) for force in (0.0, 0.0, 500.0)]
    assert before == [1500.0] * 3 and after[0] == 1500.0
    assert 1500.0 < after[1] < 2000.0
    assert 0.0 < after[2] < 500.0


def largest_step(before: dict[str, Value], after: dict[str, Value], frequency_hz: float = 4.0,
                 ticks: int = 300) -> float:
    """Return the largest step (N) of the command in so many ticks after a change in motion."""
    p = as_record({'load.type': 'spring', 'load.mass': 1.0, 'load.stiffness': 5e4,
                   'load.damping': 100.0})
    state, c, found = rest(), compensator(before, RATE), []
    for k in range(2600 + ticks):
        if k == 2600:
            c = compensator(after, RATE, c)
        force, _, _, velocity = measure(state, p)
        reference = 200.0 * math.sin(2.0 * math.pi * frequency_hz * k / RATE)
        found.append(compensate(c, reference, force, velocity))
        step(state, found[-1], p, 1.0 / RATE)
    return float(np.abs(np.diff(found[2590:])).max())


@pytest.mark.parametrize('addition', [
    {'reference_model.bandwidth': 100.0},
    {'gain_schedule.velocity': 0.05, 'gain_schedule.least': 0.3}], ids=str)
def test_addition_that_changes_the_error_is_no_kick_of_the_lead(addition: dict[str, Value]
                                                                ) -> None:
    """In motion: without it the command jumped by 450 to 1400 N, one tick after the change."""
    lead2: dict[str, Value] = {'compensator': 'lead2'}
    for before, after in ((lead2 | addition, lead2), (lead2, lead2 | addition)):
        assert largest_step(before, after) < 25.0


@pytest.mark.parametrize('name', ['proportional', 'lead2'])
def test_reference_model_without_delay_from_now_on_is_no_step(name: str) -> None:
    """The delayed force jumped to the other one a tick after the change: nothing faded it in."""
    values: dict[str, Value] = {'compensator': name, 'reference_model.bandwidth': 100.0,
                                'reference_model.delay': 0.01}
    assert largest_step(values, values | {'reference_model.delay': 0.0}) < 10.0


@pytest.mark.parametrize('before', ['lead_lag', 'proportional', 'lead4'])
def test_change_to_a_lead_in_motion_is_no_kick(before: str) -> None:
    """The lead took the error for one that had not moved: steps of 4 to 25 N, and 180 at 16 Hz."""
    assert largest_step({'compensator': before}, {'compensator': 'lead2'}) < 5.0
    assert largest_step({'compensator': before}, {'compensator': 'lead2'}, 16.0) < 100.0


def test_change_to_a_lead_of_slow_roots_is_no_kick() -> None:
    """Its steady state along a line would be that of a motion far longer than the recent one."""
    before: dict[str, Value] = {'compensator': 'lead_lag'}
    assert largest_step(before, before | {'lead_lag.centre_frequency': 0.1}, ticks=20) < 15.0


def test_change_between_compensators_with_a_lag_leaves_the_force() -> None:
    # Without feed-forward it is the lag that holds the force: each at its own static gain.
    bare: dict[str, Value] = {'feedforward': 0.0}
    for after in ({'compensator': 'lead_lag', 'gain': 25.0},
                  {'compensator': 'lead2', 'lead2.lag_ratio': 5.0}):
        forces, _ = changed({'compensator': 'lead_lag', 'gain': 20.0} | bare, after | bare, 300.0)
        assert np.ptp(forces[2499:]) < 6.0


def test_command_stays_exactly_within_the_saturation() -> None:
    c = compensator({'compensator': 'lead4', 'saturation': 123.0}, 5000.0)
    rng = np.random.default_rng(1)
    commands = np.array([compensate(c, *rng.normal(0, 500, 2), 0.0) for _ in range(2000)])
    assert commands.max() == 123.0 and commands.min() == -123.0


def test_clipped_kick_of_a_lead_leaves_nothing_behind() -> None:
    c = compensator({'compensator': 'lead4', 'feedforward': 0.0}, RATE)
    compensate(c, 0.0, 0.0, 0.0)
    kick = [compensate(c, reference, 0.0, 0.0) for reference in (500.0, *[0.0] * 50)]
    assert max(kick) == 4000.0 and min(kick) == -4000.0
    assert abs(kick[-1]) < 5.0


@pytest.mark.parametrize(('values', 'reason'), [
    ({'custom.poles': '-50, abc'}, r"custom\.poles = '-50, abc' is not allowed: it takes numbers"),
    ({'custom.poles': '-50+3j'}, r"custom\.poles = '-50\+3j' .* conjugate pairs"),
    ({'custom.poles': 'nan'}, r'every number must be finite'),
    ({'custom.poles': '-1, -inf'}, r'every number must be finite'),
    ({'custom.poles': '5'}, r'custom\.poles: 5\+0j is not allowed'),
    ({'custom.poles': '0'}, r'custom\.poles: 0\+0j is not allowed'),
    ({'custom.poles': '-5', 'custom.zeros': '0'}, r'custom\.zeros: 0 is not allowed'),
    ({'custom.zeros': '-5'}, r'custom\.zeros has 1 and custom\.poles 0'),
    ({'custom.poles': ','.join(['-5'] * 17)}, r'custom\.poles has 17 numbers: at most 16'),
    ({'custom.poles': '-1e-17'}, r'too slow or too fast'),
    ({'custom.poles': '-1e22'}, r'too slow or too fast'),
    ({'custom.zeros': '-1e-17', 'custom.poles': '-9'}, r'too slow or too fast'),
    ({'gain': math.nan}, r'gain = nan is not allowed'),
    ({'gain': 1e-310}, r'gain = 1e-310 is not allowed: it is 0, or at least 1e-100'),
    ({'saturation': 0.0}, r'saturation = 0\.0 is not allowed'),
    ({'compensator': 'pid'}, r'compensator = .pid. is not allowed: it takes one of'),
], ids=str)
def test_bad_parameters_are_refused(values: dict[str, Value], reason: str) -> None:
    with pytest.raises(ParameterError, match=reason):
        compensator({'compensator': 'custom'} | values, 5000.0)


def test_rate_too_low_for_the_prewarping_is_refused() -> None:
    with pytest.raises(ParameterError, match='a control rate of 150 Hz'):
        compensator({'compensator': 'lead_lag'}, 150.0)


def test_custom_without_roots_is_a_gain() -> None:
    c = compensator({'compensator': 'custom', 'gain': 4.0, 'feedforward': 0.0}, 5000.0)
    assert [compensate(c, 100.0, force, 0.0) for force in (0.0, 50.0)] == [400.0, 200.0]


@pytest.mark.parametrize('name', COMPENSATORS)
def test_compensator_declares_all_that_is_made_of_it(name: str) -> None:
    each = COMPENSATORS[name]
    assert each.name == name and each.gain > 0.0 and DOCUMENTATION[name].endswith('.')
    assert all(parameter.description and parameter.problem(parameter.default) is None
               for parameter in each.parameters)
    assert set(each.table) <= set(COMPENSATOR_PARAMETERS)
    assert f'{name} {each.gain:g}' in COMPENSATOR_PARAMETERS[1].description
    assert name in COMPENSATOR_PARAMETERS[0].choices
    # Its own gain, unless another is given.
    values: dict[str, Value] = {'compensator': name}
    assert design(values).gain == pytest.approx(design(values | {'gain': each.gain}).gain)
    assert design(values | {'gain': 2.0}).gain == pytest.approx(
        design(values | {'gain': 1.0}).gain * 2.0)


def test_compensators_are_in_the_order_that_they_ask_for() -> None:
    orders = [each.order for each in COMPENSATORS.values()]
    assert orders == sorted(orders) and len(set(orders)) == len(orders)
