"""Parameters of the controller: compensators, reference, node."""

from typing import Final

from asi_common.loop_parameters import LOOP_PARAMETERS
from asi_common.parameter import Parameter
from asi_controller.additions import ADDITIONS
from asi_controller.compensators import COMPENSATORS

SHAPES = ('topic', 'step', 'ramp', 'sine', 'triangle', 'chirp', 'multisine', 'prbs')

_GAINS = ', '.join(f'{each.name} {each.gain:g}' + (f' {each.gain_at}' if each.gain_at else '')
                   for each in COMPENSATORS.values())

# Those of the choice of a compensator; its own are in its file.
CHOICE_PARAMETERS: tuple[Parameter, ...] = (
    Parameter('compensator', 'proportional', '', 'Which compensator closes the loop',
              choices=tuple(COMPENSATORS)),
    Parameter('gain', 0.0, 'N/N',
              f'Gain of the compensator in use; 0: its own ({_GAINS})', 0.0, 1e4),
    Parameter('feedforward', 1.0, 'N/N', 'Share of the reference that goes straight to the '
              "valve: the inverse of the actuator's static gain", 0.0, 100.0,
              source='6 N at Kp = 3 (Table 1) need it'),
    Parameter('saturation', 4000.0, 'N', 'Largest valve command', 1.0, 1e5, source='assumed'),
    Parameter('transfer_time', 0.02, 's',
              'Time constant of the transition of the command after a change of gain or '
              'compensator, which would otherwise be a step', 0.0, 10.0),
)
ADDITION_PARAMETERS: tuple[Parameter, ...] = tuple(
    parameter for each in ADDITIONS.values() for parameter in each)
COMPENSATOR_PARAMETERS = CHOICE_PARAMETERS + tuple(
    parameter for each in COMPENSATORS.values() for parameter in each.table
) + ADDITION_PARAMETERS

REFERENCE_PARAMETERS: tuple[Parameter, ...] = (
    Parameter('reference.shape', 'topic', '',
              'Where the desired force comes from: the topic force_reference, or a signal that '
              'the controller makes', choices=SHAPES),
    Parameter('reference.amplitude', 100.0, 'N', 'Size of the signal', -1e4, 1e4),
    Parameter('reference.offset', 0.0, 'N', 'Force about which the signal moves', -1e4, 1e4),
    Parameter('reference.start', 0.05, 's', 'Rest at the offset before the signal begins, at the '
              'start and after each change of a parameter of the reference', 0.0, 1e4),
    Parameter('reference.end', 0.0, 's', 'Time from its start at which the signal ends, at the '
              'offset; 0: never', 0.0, 1e5),
    Parameter('reference.duration', 1.0, 's', "Time of the ramp; time of the chirp's sweep",
              1e-3, 1e5),
    Parameter('reference.frequency', 1.0, 'Hz',
              'Frequency; first of the chirp, lowest of the multisine, clock of the PRBS',
              1e-4, 1e4),
    Parameter('reference.end_frequency', 100.0, 'Hz',
              'Last frequency of the chirp, highest of the multisine', 1e-4, 1e4),
    Parameter('reference.tones', 20, '', 'Number of sines of the multisine', 1, 1000),
    Parameter('reference.seed', 1, '', 'Seed of the PRBS', 0, 2**31 - 1),
)

# Parameters that, unless 0, need the velocity of the piston.
VELOCITY_NEEDED: Final = ('velocity_feedforward.share', 'friction_feedforward.level',
                          'gain_schedule.velocity')

CONTROLLER_NODE_PARAMETERS: tuple[Parameter, ...] = LOOP_PARAMETERS + (
    Parameter('state_timeout', 0.1, 's',
              'Real time: without a new state for so long no command is given', 1e-3, 60.0),
    Parameter('reference_timeout', 2.0, 's',
              'Without a force_reference for so long (time of the loop) the desired force is 0; '
              '0: the last one is kept', 0.0, 3600.0,
              source='twice the period of ros2 topic pub'),
)
