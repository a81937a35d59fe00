"""What a valve may do to its command: the operators that the shape of a cycle is tested on."""

import numpy as np
import numpy.typing as npt

from asi_actuator.model.jit import jit

Array = npt.NDArray[np.float64]


@jit
def _stick(command, start, static, dynamic, out):
    position = command[start] - dynamic
    out[:start] = position
    for k in range(start, command.size):
        push = command[k] - position
        if abs(push) > static:
            position = command[k] - np.sign(push) * dynamic
        out[k] = position


def stick(command: Array, static: float, dynamic: float, first: int) -> Array:
    """
    Return the position of a valve that sticks until pushed by `static`, then slips to `dynamic`.

    In units of the command. static = dynamic: backlash, the play; dynamic < static: stiction (He,
    Wang, Pottmann, Qin, Ind. Eng. Chem. Res. 46, 2007: f_S and f_D). It begins where the command
    is largest within its `first` samples, as if the valve had just slipped upward there.
    """
    out = np.empty_like(command)
    start = int(np.argmax(command[:first]))
    _stick(np.ascontiguousarray(command), start, static, dynamic, out)
    return out


def hysteresis(command: Array, width: float, first: int) -> Array:
    """Return the mean of plays of half widths up to `width`: smooth loops (Prandtl 1928)."""
    widths = width * (np.arange(6) + 0.5) / 6.0
    return np.mean([stick(command, each, each, first) for each in widths], axis=0)


def clip(command: Array, share: float) -> Array:
    """Return the command held within `share` of its swing about the middle of it."""
    middle, half = 0.5 * (command.max() + command.min()), 0.5 * np.ptp(command)
    return np.clip(command, middle - share * half, middle + share * half)
