"""The parameters of the actuator node, besides those of its physics (`parameters.py`)."""

from importlib.metadata import entry_points
from typing import Final

from asi_actuator.joint_parameters import JOINT_PARAMETERS
from asi_actuator.parameters import ACTUATOR_PARAMETERS
from asi_common.loop_parameters import LOOP_PARAMETERS
from asi_common.parameter import Parameter

# What the node can simulate, by its value of the parameter `plant`: the tables of the physics.
PHYSICS: Final = {'actuator': ACTUATOR_PARAMETERS, 'joint': JOINT_PARAMETERS}

# The drivers that are installed, by their value of the parameter `driver` (asi_actuator/driver).
DRIVERS: Final = {entry.name: entry for entry in sorted(
    entry_points(group='asi_actuator.drivers'), key=lambda entry: entry.name)}

# The defaults are beyond what the model does with its own defaults, so that no simulated run
# meets them; config/can.yaml has those for hardware.
SAFETY_PARAMETERS: tuple[Parameter, ...] = (
    Parameter('limit.command_rate', 1e9, 'N/s',
              'Fastest change of the valve command that reaches the actuator', 1.0, 1e9),
    Parameter('limit.force', 2500.0, 'N', 'A larger measured force is a fault', 0.0, 1e6,
              source='thrust and damping force together reach 2200 N'),
    Parameter('limit.force_rate', 1e7, 'N/s', 'A faster change of the measured force is a fault',
              0.0, 1e9, source='2200 N through the fluid and sensor lags'),
    Parameter('limit.valve_position', 1e-4, 'm', 'A larger valve position is a fault', 0.0, 1.0),
    Parameter('limit.velocity', 20.0, 'm/s', 'A larger piston velocity is a fault', 0.0, 1e3),
    Parameter('limit.valve_disagreement', 1e-5, 'm',
              'A larger mean difference between the valve position and that of the command is a '
              'fault', 0.0, 1.0, source='half of the full opening'),
    Parameter('limit.valve_disagreement_time', 0.1, 's', 'Time constant of that mean', 1e-3, 10.0),
    Parameter('limit.state_age', 0.1, 's', 'Hardware: an older state is a fault', 1e-3, 60.0),
    Parameter('limit.lost_states', 100, '',
              'Hardware: more gaps in the counter of the states within 1 s are a fault', 0, 10**6),
    Parameter('limit.bad_frames', 10, '',
              'Hardware: more frames with a wrong checksum or length within 1 s are a fault',
              0, 10**6),
)

ACTUATOR_NODE_PARAMETERS: tuple[Parameter, ...] = LOOP_PARAMETERS + (
    Parameter('duration', 0.0, 's', 'Length of the run, after which the node ends; 0: no end',
              0.0, 1e6, read_only=True),
    Parameter('resend_after', 0.1, 's',
              'Lock-step: publish the state again if no command answers it for so long',
              1e-3, 60.0),
    Parameter('give_up_after', 5.0, 's',
              'Lock-step: end the run with an error if a controller that has answered before '
              'is silent for so long; 0: wait for ever', 0.0, 3600.0),
    Parameter('real_time_factor', 0.0, '',
              'Lock-step: largest ratio of simulated to wall time; 0: as fast as possible',
              0.0, 1000.0),
    Parameter('command_timeout', 0.1, 's',
              'Real time: a command older than this is a fault, and the valve command 0',
              1e-3, 60.0),
    Parameter('calibration_file', '', '',
              'YAML file with offset and scale of the force sensor: read at the start, written by '
              '~/calibrate; none if empty', read_only=True),
    Parameter('calibration_noise', 5.0, 'N',
              'Noise (standard deviation) up to which ~/calibrate trusts the mean', 0.0, 1e4),
    Parameter('plant', 'actuator', '',
              'actuator: the hydraulic one; joint: any joint or drive, moved by a force or a '
              'servo. Their parameters differ (doc/how_to/simulate_a_joint.md)',
              choices=tuple(PHYSICS), read_only=True),
    Parameter('driver', 'simulated', '',
              'simulated: the model; can: hardware on a CAN bus (doc/how_to/bridge.md); replay: '
              'the states of a bag', choices=tuple(DRIVERS), read_only=True),
    Parameter('can.interface', 'socketcan', '', 'Interface of python-can: socketcan, slcan …',
              read_only=True),
    Parameter('can.channel', 'can0', '', 'Channel of that interface: can0, /dev/ttyACM0 …',
              read_only=True),
    Parameter('can.bitrate', 1_000_000, 'bit/s', 'Bit rate of the bus', 10_000, 1_000_000,
              read_only=True),
    Parameter('can.dbc', '', '',
              'Layout of the frames; if empty, asi_actuator.dbc of the package', read_only=True),
    Parameter('replay.bag', '', '', 'Bag whose states are played', read_only=True),
) + SAFETY_PARAMETERS
