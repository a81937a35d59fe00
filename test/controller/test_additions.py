"""The additions to a compensator: against their formulas, and null without their parameters."""

import numpy as np
import numpy.typing as npt
import pytest

from asi_actuator.model.valve_hysteresis import play
from asi_common.parameter import Value
from asi_controller.additions import ADDITIONS, DOCUMENTATION
from asi_controller.additions.reference_model import extrapolated
from asi_controller.compensator import REST, compensate, compensator, frequency_response
from asi_controller.parameters import COMPENSATOR_PARAMETERS

RATE = 5000.0
# Without this nothing but the addition makes a command.
BARE: dict[str, Value] = {'gain': 1e-12, 'feedforward': 0.0}


def commands(values: dict[str, Value], references: npt.ArrayLike, force: float = 0.0,
             velocity: float = 0.0) -> npt.NDArray[np.float64]:
    c = compensator(values, RATE)
    return np.array([compensate(c, reference, force, velocity)
                     for reference in np.asarray(references, float)])


@pytest.mark.parametrize('name', ADDITIONS)
def test_addition_is_off_by_default_and_its_other_parameters_change_nothing(name: str) -> None:
    switch, *others = ADDITIONS[name]
    assert switch.default == 0.0 and DOCUMENTATION[name].endswith('.')
    assert {switch, *others} <= set(COMPENSATOR_PARAMETERS)
    references = np.random.default_rng(1).normal(0.0, 300.0, 50)
    assert np.array_equal(
        commands({'compensator': 'lead4'}, references, 5.0, 0.1),
        commands({'compensator': 'lead4'} | {each.name: each.high for each in others},
                 references, 5.0, 0.1))


def test_integrator_sums_the_error_and_stops_while_the_command_is_saturated() -> None:
    values = BARE | {'integrator.rate': 50.0, 'saturation': 10.0}
    found = commands(values, np.repeat([100.0, -100.0], [100, 3]))
    assert found[:11] == pytest.approx(np.arange(11.0), abs=1e-6)
    assert found[11:100] == pytest.approx(10.0)
    # It moves back at once: what it did not sum need not be undone.
    assert found[100:] == pytest.approx([10.0, 9.0, 8.0])
    f = np.array([1.0, 30.0])
    both = compensator({'integrator.rate': 50.0}, RATE)
    assert frequency_response(both, f, RATE) - 3.0 == pytest.approx(50.0 / (2j * np.pi * f),
                                                                    rel=0.02)


def test_play_after_its_inverse_passes_what_moves_further_than_the_dead_zone() -> None:
    wave = 100.0 * np.sin(np.linspace(0.0, 20.0, 2000))
    values: dict[str, Value] = {'gain': 1e-12, 'feedforward': 1.0,
                                'hysteresis_inverse.size': 25.0,
                                'hysteresis_inverse.dead_zone': 1.0}
    drive, passed = 0.0, []
    for command in commands(values, wave):
        drive = play(drive, command, 25.0)
        passed.append(drive)
    assert np.abs(passed - wave)[100:].max() < 2.0
    # A wave within the dead zone never gets more than its own size through a play of that width.
    small = commands(values, 0.5 * wave / 100.0)
    assert np.ptp(small) / 2.0 <= 25.0 + 1.0


def test_velocity_is_compensated_in_proportion_and_by_all_of_it_at_most() -> None:
    values = BARE | {'velocity_feedforward.share': 0.5}
    assert commands(values, [0.0], velocity=0.2)[0] == pytest.approx(0.5 * 1600.0 * 0.2)
    assert ADDITIONS['velocity_feedforward'][0].high == 1.0


def test_velocity_is_taken_ahead_by_the_lead_time() -> None:
    values = BARE | {'velocity_feedforward.share': 1.0, 'velocity_feedforward.damping': 1.0,
                     'velocity_feedforward.lead_time': 0.01}
    c = compensator(values, RATE)
    ramp = 2.0 * np.arange(3000) / RATE   # m/s, of 2 m/s2
    found = [compensate(c, 0.0, 0.0, velocity) for velocity in ramp]
    assert found[-1] - ramp[-1] == pytest.approx(2.0 * 0.01, rel=0.1)
    # Off and on again it begins with the velocity of that time, measured or not before.
    for share, velocity in ((0.0, np.nan), (1.0, 0.3)):
        c = compensator({**values, 'velocity_feedforward.share': share, 'transfer_time': 0.0},
                        RATE, c)
        command = compensate(c, 0.0, 0.0, velocity)
    assert command == pytest.approx(0.3)


def test_reference_model_drives_a_lag_like_its_own_along_its_force_without_error() -> None:
    values: dict[str, Value] = {
        'gain': 5.0, 'reference_model.bandwidth': 100.0, 'reference_model.lag_frequency': 20.0,
        'reference_model.delay': 0.0}
    c, force, forces = compensator(values, RATE), 0.0, []
    c['fresh'] = REST
    decay = np.exp(-2.0 * np.pi * 20.0 / RATE)
    for _ in range(200):
        command = compensate(c, 700.0, force, 0.0)
        assert abs(command) <= 1200.0 + 1e-9
        force = command + (force - command) * decay
        forces.append(force)
    assert forces[-1] == pytest.approx(700.0) and max(forces) <= 700.0 + 1e-9
    # As fast as the drive allows: the lag itself would take 25 ms to 96 %.
    assert forces[60] > 0.96 * 700.0


@pytest.mark.parametrize('rate', [5000.0, 1000.0])
def test_reference_model_is_as_fast_at_any_rate_and_does_not_ring(rate: float) -> None:
    values: dict[str, Value] = {
        'gain': 1e-12, 'reference_model.bandwidth': 300.0, 'reference_model.drive': 1e5}
    c = compensator(values, rate)
    c['fresh'] = REST
    forces = []
    for _ in range(round(0.01 * rate)):
        compensate(c, 100.0, 0.0, 0.0)
        forces.append(float(c['model_force']))
    time = np.arange(1, len(forces) + 1) / rate
    assert forces == pytest.approx(100.0 * (1.0 - np.exp(-2.0 * np.pi * 300.0 * time)))


def test_reference_model_extrapolates_a_ramp_and_not_a_jump() -> None:
    assert extrapolated(10.0, 8.0, 0.001, 2e4, 0.0002) == pytest.approx(20.0)
    assert extrapolated(30.0, 8.0, 0.001, 2e4, 0.0002) == 30.0


def test_friction_is_compensated_in_the_direction_of_motion() -> None:
    values = BARE | {'friction_feedforward.level': 7.0, 'friction_feedforward.speed': 0.01}
    found = [commands(values, [0.0], velocity=velocity)[0]
             for velocity in (0.0, 0.01, -0.01, 10.0)]
    assert found == pytest.approx([0.0, 7.0 * 2.0**-0.5, -7.0 * 2.0**-0.5, 7.0], abs=1e-4)


def test_gain_falls_with_the_velocity() -> None:
    values: dict[str, Value] = {'gain': 2.0, 'feedforward': 0.0, 'gain_schedule.velocity': 0.1}
    found = [commands(values, [50.0], velocity=velocity)[0] for velocity in (0.0, 0.1, -0.3)]
    assert found == pytest.approx([100.0, 50.0, 25.0])
    floor, = commands(values | {'gain_schedule.least': 0.2}, [50.0], velocity=-0.3)
    assert floor == pytest.approx(100.0 * (0.2 + 0.8 * 0.25))


def test_disturbance_observer_removes_what_its_model_does_not_explain() -> None:
    """The model's own lag is no disturbance; a force added to it is gone after 1/(2 pi 10 Hz)."""
    values: dict[str, Value] = BARE | {
        'feedforward': 1.0, 'saturation': 150.0, 'disturbance_observer.bandwidth': 10.0,
        'disturbance_observer.lag_frequency': 20.0}
    c, lagged, forces = compensator(values, RATE), 0.0, []
    decay = np.exp(-2.0 * np.pi * 20.0 / RATE)
    for k in range(4000):
        added = 30.0 if 1000 <= k < 2000 else 200.0 if 2000 <= k < 3000 else 0.0
        forces.append(lagged + added)
        command = compensate(c, 100.0, forces[-1], 0.0)
        lagged = command + (lagged - command) * decay
    # It is sampled: the lag of the model and that of the loop differ by a control period.
    assert np.abs(np.array(forces[:1000]) - 100.0 * (1.0 - decay ** np.arange(1000))).max() < 2.0
    assert forces[1999] == pytest.approx(100.0, abs=0.1)
    # The command needed for 200 N, -100 N, is given; after it nothing is wound up.
    assert forces[2999] == pytest.approx(100.0, abs=0.1)
    assert forces[3999] == pytest.approx(100.0, abs=0.1) and max(forces[3000:]) < 101.0


def test_disturbance_observer_starts_without_a_step_of_the_command() -> None:
    off: dict[str, Value] = {'gain': 2.0}
    c = compensator(off, RATE)
    before = [compensate(c, 100.0, 80.0, 0.0) for _ in range(10)][-1]
    c = compensator(off | {'disturbance_observer.bandwidth': 10.0}, RATE, c)
    assert compensate(c, 100.0, 80.0, 0.0) == pytest.approx(before)
