"""What asi gap finds of a joint, loaded into the node that simulates it: the gap shrinks there."""

from typing import Any

import numpy as np
import pytest

import asi_analysis as asi
from asi_actuator.joint import joint
from asi_actuator.joint_parameters import as_record
from asi_analysis.errors import InputError
from asi_analysis.experiments.experiment import read_parameters
from asi_common.parameter import Value

pytestmark = pytest.mark.filterwarnings('ignore::asi_analysis.errors.InputWarning')
RATE_HZ, DURATION_S = 500.0, 4.0
ARM: dict[str, Value] = {'load.mass': 0.05, 'load.damping': 0.1, 'gravity.sine': 1.0}
FRICTION: dict[str, Value] = {
    'friction.coulomb': 0.15, 'friction.presliding_stiffness': 300.0,
    'friction.presliding_damping': 0.5, 'position_sensor.noise': 2e-5}
REFERENCE: dict[str, Value] = {
    'reference.shape': 'multisine', 'reference.amplitude': 1.5, 'reference.frequency': 0.15,
    'reference.end_frequency': 4.0, 'reference.tones': 8}


def recorded(folder: Any, values: dict[str, Value]) -> asi.Run:
    """Return the recording of a joint in lock-step over ROS, which is whole."""
    run = asi.run(values, REFERENCE, DURATION_S, rate_hz=RATE_HZ, plant='joint', out=folder)
    assert len(run) == DURATION_S * RATE_HZ
    return run


def missed(run: asi.Run, real: asi.Run) -> float:
    """Return the error of the motion, as a share of it (rms)."""
    return float(np.std(run.signal('position') - real.signal('position'))
                 / np.std(real.signal('position')))


@pytest.fixture(scope='module')
def machine(tmp_path_factory):
    """Return the recording of an arm with friction, its diagnosis without, and the export."""
    folder = tmp_path_factory.mktemp('machine')
    real = recorded(folder / 'real', ARM | FRICTION)
    gap = asi.diagnose([real], ARM, plant='joint')
    return real, gap, gap.write_export(folder / 'joint.yaml')


def test_the_bag_says_that_it_is_of_a_joint(machine):
    real, _, _ = machine
    assert [real.unit(name) for name in ('command', 'position')] == ['Nm', 'rad']
    assert 'valve_position' not in real.signals()
    alone = joint.simulate(as_record(ARM | FRICTION), real.signal('command'), real.period_s)
    np.testing.assert_array_equal(alone.position, real.signal('position'))
    # Its metadata are those of the machine itself: with them there is no gap.
    assert asi.diagnose([real], plant='joint').verdict == 'no_gap'


def test_the_node_with_what_was_found_moves_as_the_machine(machine, tmp_path):
    real, gap, path = machine
    assert 'coulomb_friction' in gap['ambiguity_set']
    found = read_parameters(path, 'actuator', 'joint')
    assert found['friction.coulomb'] == pytest.approx(0.15, rel=0.1)
    nominal, improved = (missed(recorded(tmp_path / name, values), real)
                         for name, values in (('nominal', ARM), ('improved', found)))
    print(f'nominal {nominal:.3f}, improved {improved:.4f}')
    assert nominal > 0.2
    assert improved < 0.02


def test_the_node_takes_the_file_as_it_is(machine, start_node):
    *_, path = machine
    start_node('asi_actuator.actuator_node', '--params-file', str(path)).wait_for(
        'simulated, joint, lockstep at')


def test_a_joint_is_not_taken_for_an_actuator():
    run = asi.Run(np.arange(10) * 0.01, command_n=np.zeros(10), source='bag',
                  information={'plant': 'joint'})
    with pytest.raises(InputError, match='bag: recorded with plant = joint: --plant joint'):
        asi.diagnose([run])


@pytest.mark.parametrize(('changes', 'verdict'), [
    ({'drive.force_limit': 1.2}, 'unknown'),
    pytest.param({'drive.warm_loss': 0.3, 'drive.warm_time': 5.0}, 'unknown',
                 marks=pytest.mark.slow),
    pytest.param({'drive.force_rate_limit': 8.0}, 'unknown', marks=pytest.mark.slow),
    pytest.param({'ripple.force': 0.2, 'ripple.period': 0.3}, 'unknown', marks=pytest.mark.slow),
    pytest.param({'drive.deadband': 0.2}, 'unknown', marks=pytest.mark.slow),
    pytest.param({'command_path.quantum': 0.4}, 'unknown', marks=pytest.mark.slow),
    pytest.param({'position_sensor.lag_time': 0.02}, 'valve_lag', marks=pytest.mark.slow),
    ({'drive.bias': 0.2}, 'no_gap'),
    pytest.param({'position_sensor.offset': 0.3}, 'no_gap', marks=pytest.mark.slow)])
def test_what_the_diagnosis_has_no_word_for_is_unknown(changes: dict[str, Value], verdict: str):
    """As doc/how_to/simulate_a_joint.md says."""
    time_s, rng = 0.005 * np.arange(3200), np.random.default_rng(1)
    waves = sum(np.sin(2.0 * np.pi * f * time_s + rng.uniform(0.0, 2.0 * np.pi))
                for f in np.arange(0.1, 2.5, 0.15))
    command = 2.0 * waves / np.abs(waves).max()
    moved = joint.simulate(as_record({
        'load.mass': 0.05, 'load.damping': 0.1, 'load.stiffness': 1.0,
        'position_sensor.noise': 1e-5, **changes}), command, 0.005)
    run = asi.Run(time_s, command_n=command, position_m=moved.position, source='arm',
                  information={'signals': {'command': 'Nm', 'position': 'rad'}})
    assert asi.diagnose([run], plant='joint').verdict == verdict
