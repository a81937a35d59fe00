"""Every parameter of the controller; the one place, as `asi_actuator/parameters.py` is."""

from asi_common.loop_parameters import LOOP_PARAMETERS
from asi_common.parameter import Parameter

COMPENSATORS = ('proportional', 'lead_lag', 'lead2', 'lead4', 'custom')
SHAPES = ('topic', 'step', 'ramp', 'sine', 'triangle', 'chirp', 'multisine', 'prbs')

# Searched for the fourth-order row of Table 1 at 100 and 500 N on the locked piston, so that
# nothing cycles at 2.5 times the gain at 5 kHz and at 1.5 times the gain at 1 kHz with a period
# of delay, there and on the spring (test/controller/test_default_compensators.py), nor under the
# worst conditions that `asi quench` had found for faster ones. Between those steps, and below
# them, both overshoot more and leave more: see `asi run`.
TUNED = 'search, on the locked piston and the spring load'

COMPENSATOR_PARAMETERS: tuple[Parameter, ...] = (
    Parameter('compensator', 'proportional', '', 'Which compensator closes the loop',
              choices=COMPENSATORS),
    Parameter('gain', 0.0, 'N/N',
              'Gain of the compensator in use (lead2, lead4: above the corner of their lag); '
              '0: its own (proportional 3, lead_lag 13, lead2 2.16, lead4 1.92, custom 1)',
              0.0, 1e4),
    Parameter('feedforward', 1.0, 'N/N', 'Share of the reference that goes straight to the '
              "valve: the inverse of the actuator's static gain", 0.0, 100.0,
              source='6 N at Kp = 3 (Table 1) need it'),
    Parameter('saturation', 4000.0, 'N', 'Largest valve command', 1.0, 1e5, source='assumed'),
    Parameter('transfer_time', 0.02, 's',
              'Time constant with which the step of the command that a change of gain or '
              'compensator would make is let in', 0.0, 10.0),
    Parameter('lead_lag.ratio', 130.0, '', 'a of K(aTs+1)/(Ts+1)', 1.0, 1e3,
              source='paper, section 5'),
    Parameter('lead_lag.centre_frequency', 70.0, 'Hz',
              'Where the lead is largest: 1/(2 pi T sqrt(a))', 0.1, 1e4,
              source='paper, section 5: 60 to 100 Hz'),
    Parameter('lead_lag.lag_time', 0.5, 's', 'Time constant of the lag', 1e-3, 100.0,
              source='paper, section 5'),
    Parameter('lead2.ratio', 5.3, '', 'a of each of the two leads', 1.0, 1e3, source=TUNED),
    Parameter('lead2.zero_frequency', 105.5, 'Hz', 'Corner of the zero of each lead', 0.1, 1e4,
              source=TUNED),
    Parameter('lead2.lag_ratio', 4.74, '', 'How much the lag lowers high frequencies', 1.0, 1e4,
              source=TUNED),
    Parameter('lead2.lag_time', 0.16, 's', 'Time constant of the lag', 1e-3, 100.0, source=TUNED),
    Parameter('lead4.ratio', 1.9, '', 'a of each of the four leads', 1.0, 1e3, source=TUNED),
    Parameter('lead4.zero_frequency', 124.0, 'Hz', 'Corner of the zero of each lead', 0.1, 1e4,
              source=TUNED),
    Parameter('lead4.lag_ratio', 7.2, '', 'How much the lag lowers high frequencies', 1.0, 1e4,
              source=TUNED),
    Parameter('lead4.lag_time', 0.19, 's', 'Time constant of the lag', 1e-3, 100.0, source=TUNED),
    Parameter('custom.zeros', '', 'rad/s',
              'Zeros of the custom compensator, as "-50, -30+40j, -30-40j"'),
    Parameter('custom.poles', '', 'rad/s', 'Poles of the custom compensator, in the same form'),
)

REFERENCE_PARAMETERS: tuple[Parameter, ...] = (
    Parameter('reference.shape', 'topic', '',
              'Where the desired force comes from: the topic force_reference, or a signal that '
              'the controller makes', choices=SHAPES),
    Parameter('reference.amplitude', 100.0, 'N', 'Size of the signal', -1e4, 1e4),
    Parameter('reference.offset', 0.0, 'N', 'Force about which the signal moves', -1e4, 1e4),
    Parameter('reference.start', 0.05, 's', 'Rest at the offset before the signal begins',
              0.0, 1e4),
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

CONTROLLER_NODE_PARAMETERS: tuple[Parameter, ...] = LOOP_PARAMETERS + (
    Parameter('state_timeout', 0.1, 's',
              'Real time: without a new state for so long no command is given', 1e-3, 60.0),
)
