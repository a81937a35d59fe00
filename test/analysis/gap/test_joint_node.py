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
RATE_HZ, DURATION_S = 500.0, 8.0
ARM: dict[str, Value] = {'load.mass': 0.05, 'load.damping': 0.1, 'gravity.sine': 1.0}
FRICTION: dict[str, Value] = {
    'friction.coulomb': 0.15, 'friction.presliding_stiffness': 300.0,
    'friction.presliding_damping': 0.5, 'position_sensor.noise': 2e-5}
REFERENCE: dict[str, Value] = {
    'reference.shape': 'multisine', 'reference.amplitude': 1.5, 'reference.frequency': 0.15,
    'reference.end_frequency': 4.0, 'reference.tones': 8}


def recorded(folder: Any, values: dict[str, Value]) -> asi.Run:
    """Return the recording of a joint in lock-step over ROS."""
    return asi.run(values, REFERENCE, DURATION_S, rate_hz=RATE_HZ, plant='joint', out=folder)


def missed(run: asi.Run, real: asi.Run) -> float:
    """Return the error of the motion, as a share of it (rms)."""
    return float(np.std(run.signal('position') - real.signal('position'))
                 / np.std(real.signal('position')))


def test_the_node_with_what_was_found_moves_as_the_machine(tmp_path, start_node):
    real = recorded(tmp_path / 'real', ARM | FRICTION)
    assert [real.unit(name) for name in ('command', 'position')] == ['Nm', 'rad']
    assert 'valve_position' not in real.signals()
    alone = joint.simulate(as_record(ARM | FRICTION), real.signal('command'), real.period_s)
    np.testing.assert_array_equal(alone.position, real.signal('position'))

    # The metadata are of the machine itself: with them there is no gap, without friction there is.
    assert asi.diagnose([real], plant='joint').verdict == 'no_gap'
    gap = asi.diagnose([real], ARM, plant='joint')
    assert 'coulomb_friction' in gap['ambiguity_set']
    path = gap.write_export(tmp_path / 'joint.yaml')

    found = read_parameters(path, 'actuator', 'joint')
    assert found['friction.coulomb'] == pytest.approx(0.15, rel=0.1)
    nominal, improved = (missed(recorded(tmp_path / name, values), real)
                         for name, values in (('nominal', ARM), ('improved', found)))
    print(f'nominal {nominal:.3f}, improved {improved:.4f}')
    assert nominal > 0.2
    assert improved < 0.02
    # Last, since it stays: the node takes the file as it is.
    start_node('asi_actuator.actuator_node', '--params-file', str(path)).wait_for(
        'simulated, joint, lockstep at')


def test_a_joint_is_not_taken_for_an_actuator(tmp_path):
    run = asi.Run(np.arange(10) * 0.01, command_n=np.zeros(10), source='bag',
                  information={'plant': 'joint'})
    with pytest.raises(InputError, match='bag: recorded with plant = joint: --plant joint'):
        asi.diagnose([run])
