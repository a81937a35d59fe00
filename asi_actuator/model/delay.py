"""A pure delay: a ring of past values, read between two of them by linear interpolation."""

from typing import Final

from asi_actuator.model.jit import jit

RING: Final = 512


@jit
def delay(ring, index, value, delay_s, h):
    """
    Put `value` into the ring at `index` and return the value of `delay_s` s ago.

    ring: RING past values, one a sub-step of `h` s; delay_s at most (RING - 2) * h.
    """
    ring[index] = value
    steps = delay_s / h
    whole = int(steps)
    part = steps - whole
    newer = ring[(index - whole) % RING]
    older = ring[(index - whole - 1) % RING]
    return newer + part * (older - newer)
