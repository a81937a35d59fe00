"""A pure delay: a ring of past values, read between two of them by linear interpolation."""

from typing import NamedTuple

from asi_actuator.parameters import RING
from asi_common.jit import jit


class DelaySteps(NamedTuple):
    """A delay in sub-steps: the whole ones, and the rest (0 to 1)."""

    whole: int
    part: float


@jit
def delay_steps(delay_s, h):
    """Return a delay (s) in sub-steps of `h` s; at most RING - 2 of them fit the ring."""
    steps = delay_s / h
    whole = int(steps)
    return DelaySteps(whole, steps - whole)


@jit
def delay(ring, index, value, steps):
    """Put `value` into the ring (RING past values) at `index`; return that of `steps` ago."""
    ring[index] = value
    newer = ring[(index - steps.whole) & (RING - 1)]
    older = ring[(index - steps.whole - 1) & (RING - 1)]
    return newer + steps.part * (older - newer)
