"""Oscillations in bursts: they last for a part of each period of a drive."""

from typing import Final, NamedTuple

import numpy as np

from asi_analysis.arrays import Array
from asi_analysis.measures.sinusoids.sinusoid import analytic_signal, dominant_frequency, on_grid

# Phases of the drive at which the envelope is averaged.
PHASES: Final = 24
# Least share of the envelope's variance that follows the phase of the drive.
FOLLOWS: Final = 0.5
# Least cycles above half of the largest amplitude: a damping ratio below 0.04 if it rings down.
FEWEST_CYCLES: Final = 3.0
# Least periods of the drive that show it.
FEWEST_DRIVEN: Final = 2.0


class Bursts(NamedTuple):
    """Frequency, largest amplitude, and cycles above half of it in the longest burst."""

    frequency_hz: float
    amplitude: float
    cycles: float


def bursts(time: Array, values: Array, period: float) -> Bursts | None:
    """
    Return the bursts in a signal from which a drive of a period (s) was removed; None if none.

    time (s) and values: n samples. The envelope must follow the phase of the drive, which that of
    noise does not. Fewer than FEWEST_DRIVEN periods
    cannot show it.
    """
    even, step = on_grid(time, values)
    frequency = dominant_frequency(time, values)
    seconds = step * np.arange(len(even))
    if not frequency * period > FEWEST_CYCLES or seconds[-1] < FEWEST_DRIVEN * period:
        return None
    envelope = np.abs(analytic_signal(even, step, frequency))
    phase = (PHASES * seconds / period).astype(int) % PHASES
    course = np.bincount(phase, envelope) / np.maximum(np.bincount(phase), 1)
    independent = frequency * seconds[-1]
    unexplained = np.var(envelope - course[phase]) / np.var(envelope)
    follows = 1.0 - unexplained * independent / max(independent - PHASES, 1.0)
    high = np.concatenate([[False], envelope > 0.5 * envelope.max(), [False]])
    edges = np.flatnonzero(np.diff(high.astype(int)))
    cycles = float((edges[1::2] - edges[::2]).max()) * step * frequency
    if follows < FOLLOWS or cycles < FEWEST_CYCLES:
        return None
    return Bursts(frequency, float(envelope.max()), cycles)
