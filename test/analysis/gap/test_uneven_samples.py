"""Joints whose samples are unevenly spaced, or held: simulated exactly between the samples."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from asi_analysis.bags.run import Run
from asi_analysis.gap.answer.joint_model import joint_model, node_parameters
from asi_analysis.gap.diagnose import Diagnosis, diagnose
from asi_analysis.gap.model.joint import joint_groups
from asi_analysis.gap.prepare import prepare
from asi_analysis.gap.sampling import noise_of, uniform
from asi_analysis.gap.sizes import sizes_of

PERIOD_S = 0.01
MODEL = {'load.mass': 0.5, 'load.damping': 2.0}


def uneven(count: int = 2000, jitter: float = 0.1) -> np.ndarray:
    """Return times whose distances vary by this share of the period, so that they drift away."""
    rng = np.random.default_rng(2)
    return np.append(0.0, np.cumsum(PERIOD_S * (1.0 + jitter * rng.standard_normal(count - 1))))


def sines(time: np.ndarray) -> np.ndarray:
    """Return a course of four sines."""
    return 0.25 * sum(np.sin(2.0 * np.pi * f * time + 3.0 * f) for f in (0.3, 0.7, 1.3, 2.1))


def held(time: np.ndarray, u: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the states of x' = A x + b u, u held from each time to the next; from 0."""
    states = np.zeros((time.size, b.size))
    for k, step in enumerate(np.diff(time)):
        both = expm(step * np.block([[a, b[:, None]], [np.zeros((1, b.size + 1))]]))
        states[k + 1] = both[:-1, :-1] @ states[k] + both[:-1, -1] * u[k]
    return states


def moved(time: np.ndarray, damping: float = 2.0, noise: float = 1e-4) -> Run:
    """Return the recording of a mass of 0.5 kg with its command, which is held."""
    u = 4.0 * sines(time)
    x = held(time, u, np.array([[0.0, 1.0], [0.0, -damping / 0.5]]), np.array([0.0, 2.0]))[:, 0]
    x += np.random.default_rng(3).normal(0.0, noise, x.size)
    return Run(time, command_n=u, position_m=x, source='joint',
               information={'signals': {'command': 'N', 'position': 'm'}})


def servo(time: np.ndarray, reference: np.ndarray, followed: np.ndarray | None = None) -> Run:
    """Return the recording of a servo of 4 Hz that follows another reference than it is given."""
    w = 8.0 * np.pi
    target = reference if followed is None else followed
    x = held(time, target - target[0], np.array([[0.0, 1.0], [-w * w, -1.6 * w]]),
             np.array([0.0, w * w]))[:, 0] + target[0]
    x += np.random.default_rng(4).normal(0.0, 3e-4, x.size)
    return Run(time, reference_n=reference, position_m=x, source='servo',
               information={'signals': {'reference': 'rad', 'position': 'rad'}})


def driven(time: np.ndarray, force: np.ndarray, command: np.ndarray, late: int = 1) -> Run:
    """Return the recording of a drive whose force answers `late` rows after its command."""
    force = np.append(np.full(late, force[0]), force[:force.size - late])
    force = force + np.random.default_rng(5).normal(0.0, 0.01, force.size)
    return Run(time, command_n=command, force_n=force, source='drive',
               information={'signals': {'command': 'N', 'force': 'N'}})


def of_joint(run: Run, **model: float) -> Diagnosis:
    """Return the diagnosis of a joint."""
    return diagnose([run], model, 'joint')


def test_noise_is_that_of_what_was_recorded():
    # Interpolation makes slow noise of fast noise: of its fourth differences, a third was left.
    time = uneven()
    noisy = sines(time) + np.random.default_rng(1).normal(0.0, 1e-3, time.size)
    run = Run(time, command_n=sines(time), position_m=noisy, source='joint',
              information={'signals': {'command': 'N', 'position': 'm'}})
    assert noise_of(uniform(run).signals['position']) < 0.8e-3
    recording, = prepare([run], 'force')
    assert recording.noise['position'] == pytest.approx(1e-3, rel=0.15)


@pytest.mark.parametrize('drive', ['position', 'force'])
def test_noise_of_fast_uneven_samples_is_that_of_what_is_compared(drive: str):
    # A servo is compared at 5 kHz: its noise is all of it. A force is, at 1 kHz: it is filtered.
    time = uneven(8000) * 0.0002 / PERIOD_S
    rng = np.random.default_rng(1)
    run = Run(time, command_n=sines(time), reference_n=sines(time),
              position_m=sines(time) + rng.normal(0.0, 1e-3, time.size), source='fast',
              information={'signals': {'command': 'N', 'position': 'm', 'reference': 'm'}})
    recording, = prepare([run], drive)
    noise = recording.noise['valve_position' if drive == 'position' else 'position']
    assert noise == pytest.approx(1e-3 if drive == 'position' else 4e-4, rel=0.15)


@pytest.mark.parametrize(('damping', 'verdict'), [
    (2.0, ()), pytest.param(4.0, ('viscous_friction',), marks=pytest.mark.slow)])
def test_a_joint_of_uneven_samples_has_no_compliance(damping: float, verdict: tuple[str, ...]):
    found = of_joint(moved(uneven(), damping), **MODEL)
    assert found.verdict == verdict or {'parameter:load.damping'} == {*found.verdict}
    assert sum(p for names, p in found.joined.items() if 'load_compliance' in names) < 0.05


def test_a_servo_of_uneven_samples_has_no_gap():
    # The reference of each sample came early or late by up to one: 0.6 of `unknown`.
    time = uneven(1500)
    assert of_joint(servo(time, sines(time))).joined[()] > 0.9


def test_a_drive_of_uneven_samples_answers_row_by_row():
    # Its force was interpolated between two steps: the steps were none.
    time = uneven()
    command = 4.0 * sines(time)
    found = of_joint(driven(time, 0.4 * np.round(command / 0.4), command))
    assert found.verdict == ('command_quantisation',)
    assert found.joined[found.verdict] > 0.9


@pytest.mark.parametrize('late', [0, pytest.param(1, marks=pytest.mark.slow)])
def test_the_row_of_the_force_that_answers_a_command_is_a_convention(late: int):
    # In the row of the command it was 0.7 of `no_gap`, and a saturation was not found.
    time = PERIOD_S * np.arange(2000)
    command = 4.0 * sines(time)
    assert of_joint(driven(time, command, command, late)).joined[()] > 0.9
    limited = of_joint(driven(time, np.clip(command, -2.6, 2.6), command, late))
    assert limited.verdict == ('valve_saturation',)


@pytest.mark.parametrize('origin', [pytest.param(0.0, marks=pytest.mark.slow), 0.3])
def test_a_limit_of_a_reference_is_found_about_any_origin(origin: float):
    # Symmetric about an origin that is not the mean, it was steps of the reference, or unknown.
    time = PERIOD_S * np.arange(1500)
    reference = sines(time) + origin
    found = of_joint(servo(time, reference, np.clip(reference, -0.9, 0.55)))
    assert found.verdict == ('valve_saturation',)
    sizes = sizes_of(found, found.verdict)['valve_saturation']['parameters']
    assert sizes['servo_upper'] == pytest.approx(0.55, abs=0.005)
    model = joint_model(found)   # what is exported
    # The node's parameters have no field for it: said with the same number, not from the mean.
    left_out, = node_parameters(found, {})[2]
    assert 'upper limit of the reference 0.550' in left_out
    assert model.most_command == pytest.approx(0.55, abs=0.01)
    assert model.kp == pytest.approx((8.0 * np.pi) ** 2, rel=0.02)


@pytest.mark.slow   # of one: test_a_limit_of_a_reference_is_found_about_any_origin
def test_two_recordings_share_the_limits_of_their_reference():
    # Each counted from its own mean. Of two recordings each drive and servo was a ValueError.
    time = PERIOD_S * np.arange(1000)
    references = [sines(time), sines(time + 3.0) + 0.4]
    found = diagnose([servo(time, each, np.minimum(each, 0.5)) for each in references], {},
                     'joint')
    assert found.verdict == ('valve_saturation',)
    sizes = sizes_of(found, found.verdict)['valve_saturation']['parameters']
    assert sizes['servo_upper'] == pytest.approx(0.5, abs=0.005)


def test_two_recordings_of_a_drive_have_no_gap():
    time = PERIOD_S * np.arange(1000)
    commands = [4.0 * sines(time), 3.0 * sines(time + 3.0)]
    found = diagnose([driven(time, each, each) for each in commands], {}, 'joint')
    assert found.joined[()] > 0.9


@pytest.mark.slow   # of a position: test_a_limit_of_a_reference_is_found_about_any_origin
@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_a_limit_of_a_velocity_that_has_one_sign_is_found(sign: float):
    time = PERIOD_S * np.arange(1000)
    speed = sign * (1.5 + sines(time))
    run = servo(time, speed, sign * np.minimum(np.abs(speed), 1.9))
    run = replace(run, position_m=None, velocity_m_s=run.position_m, information={
        'signals': {'reference': 'rad/s', 'velocity': 'rad/s'}})
    found = of_joint(run)
    assert found.verdict == ('valve_saturation',)
    sizes = sizes_of(found, found.verdict)['valve_saturation']['parameters']
    assert sizes['servo_upper' if sign > 0.0 else 'servo_lower'] == pytest.approx(
        1.9 * sign, abs=0.02)


@pytest.mark.parametrize('late', [-0.5, pytest.param(0.5, marks=pytest.mark.slow)])
def test_a_measured_force_whose_stamp_is_half_a_sample_off_has_no_lag(late: float):
    # It was attenuated as if it were held: a lag of the sensor, 1.00.
    time = 2.0 * PERIOD_S * np.arange(1500)
    rng, force, x = np.random.default_rng(9), 0.0, 0.0
    for f in np.arange(0.43, 6.0, 0.37):
        w = 2.0 * np.pi * f
        force += np.sin(w * time + f * f)
        x += np.imag(np.exp(1j * (w * (time + 2.0 * late * PERIOD_S) + f * f))
                     / (-0.5 * w * w + 2j * w))
    run = Run(time, force_n=force + rng.normal(0.0, 1e-3, time.size),
              position_m=x + rng.normal(0.0, 1e-5, time.size), source='joint',
              information={'signals': {'force': 'N', 'position': 'm'}})
    assert of_joint(run).joined[()] > 0.9


def test_a_held_command_is_attenuated_as_much_as_its_hold_makes_it():
    # By 2 % at 6 Hz, of 50 samples a second: it was a load on a compliance.
    time = 2.0 * PERIOD_S * np.arange(1500)
    rough = sum(np.sin(2.0 * np.pi * f * time + f * f) for f in np.arange(0.43, 6.0, 0.37))
    x = held(time, rough, np.array([[0.0, 1.0], [0.0, -4.0]]), np.array([0.0, 2.0]))[:, 0]
    x += np.random.default_rng(8).normal(0.0, 1e-5, x.size)
    found = of_joint(Run(time, command_n=rough, position_m=x, source='joint', information={
        'signals': {'command': 'N', 'position': 'm'}}))
    assert found.verdict == ()
    assert found.groups[-1].candidates[()].fitted.values['drive_hold'] == pytest.approx(
        0.01, rel=0.05)


def test_a_rough_command_makes_no_backlash_without_a_gap():
    # The guess of its width was 0, and so were its bounds: a ZeroDivisionError.
    time = 2.0 * PERIOD_S * np.arange(1500)
    rough = np.random.default_rng(7).normal(0.0, 4.0, time.size)
    x = held(time, rough, np.array([[0.0, 1.0], [0.0, -4.0]]), np.array([0.0, 2.0]))[:, 0]
    x += np.random.default_rng(8).normal(0.0, 2e-6, x.size)
    run = Run(time, command_n=rough, position_m=x, source='joint', information={
        'signals': {'command': 'N', 'position': 'm'}})
    group, = joint_groups([run], {}, 0.2, [False], 'force')[0]
    assert all(free.low < free.high for form in group.effects['backlash'] for free in form.free)


def test_the_ends_of_a_recording_are_left_out():
    # For a period of the highest frequency that is compared: filters ring there.
    recording, = prepare([moved(PERIOD_S * np.arange(1500))], 'force', band_hz=10.0)
    reach = round(0.8 / (recording.moved.edge_hz * PERIOD_S))   # its edge is a little lower
    assert not recording.valid[:reach].any() and not recording.valid[-reach:].any()
    assert recording.valid[2 * reach:-2 * reach].mean() > 0.9


def test_no_gap_is_not_sure_where_far_more_than_noise_is_left():
    # A gain that fades by a tenth leaves 3 % of the force, as a healthy drive may: 1.00.
    time = PERIOD_S * np.arange(3000)
    command = 4.0 * sines(time)
    found = of_joint(driven(time, command * (1.0 - 0.07 * np.sin(1.3 * time)), command))
    assert found.joined[()] < 0.6
    assert 'more than noise' in ' '.join(found.notes)
