"""The parameters that a node needs around the physics; the one place, as `parameters.py` is."""

from collections.abc import Mapping
from typing import Final

from asi_actuator.parameters import Parameter, Value

MODES = ('lockstep', 'realtime')
DEFAULT_RATE_HZ: Final = {'lockstep': 5000.0, 'realtime': 1000.0}

# What the actuator and the controller must agree on.
LOOP_PARAMETERS: tuple[Parameter, ...] = (
    Parameter('mode', 'lockstep', '',
              'lockstep: the actuator owns time and waits for each command; realtime: both nodes '
              'run on wall timers', choices=MODES, read_only=True),
    Parameter('rate_hz', 0.0, 'Hz',
              'Control rate, the same for both nodes; 0: 5000 in lock-step, 1000 in real time',
              0.0, 2e4, read_only=True),
    Parameter('await_recorder', False, '',
              'Hold the first message back until a recorder hears every topic of this node',
              read_only=True),
)

ACTUATOR_NODE_PARAMETERS: tuple[Parameter, ...] = LOOP_PARAMETERS + (
    Parameter('duration', 0.0, 's', 'Length of the run, after which the node ends; 0: no end',
              0.0, 1e6, read_only=True),
    Parameter('resend_after', 0.1, 's',
              'Lock-step: publish the state again if no command answers it for so long',
              1e-3, 60.0),
    Parameter('give_up_after', 5.0, 's',
              'Lock-step: end the run with an error if a controller that has answered before '
              'is silent for so long', 1e-2, 3600.0),
    Parameter('command_timeout', 0.1, 's',
              'Real time: without a command for so long the valve command is 0', 1e-3, 60.0),
)


def control_rate(values: Mapping[str, Value]) -> float:
    """Return the control rate (Hz) that a node's parameters ask for."""
    return float(values['rate_hz']) or DEFAULT_RATE_HZ[str(values['mode'])]
