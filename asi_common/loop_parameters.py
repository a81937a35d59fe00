"""Parameters that actuator and controller share and must set to the same values."""

from collections.abc import Mapping
from typing import Final

from asi_common.parameter import Parameter, Value

MODES = ('lockstep', 'realtime')
DEFAULT_RATE_HZ: Final = {'lockstep': 5000.0, 'realtime': 1000.0}

LOOP_PARAMETERS: tuple[Parameter, ...] = (
    Parameter('mode', 'lockstep', '',
              'lockstep: the actuator owns time and waits for each command; realtime: both nodes '
              'run on wall timers', choices=MODES, read_only=True),
    Parameter('rate_hz', 0.0, 'Hz',
              'Control rate, the same for both nodes; 0: 5000 in lock-step, 1000 in real time',
              0.0, 2e4, read_only=True),
    Parameter('await_recorder', False, '',
              'Delay the first message until a recorder has every topic of this node',
              read_only=True),
    Parameter('thread_priority', 50, '',
              'Real time: priority (SCHED_FIFO) of the threads of the node, if the user may have '
              'one, as in ros2_control; 0: that of any process', 0, 99, read_only=True),
)


def control_rate(values: Mapping[str, Value]) -> float:
    """Return the control rate (Hz) of a node's parameters."""
    return float(values['rate_hz']) or DEFAULT_RATE_HZ[str(values['mode'])]
