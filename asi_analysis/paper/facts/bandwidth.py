"""Bandwidths by stepped sines, open loop and closed loop (section 2.2)."""

import math
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from asi_analysis.arrays import Array
from asi_analysis.loop.bench import RATE_HZ, Bench, Values, open_loop
from asi_analysis.measures.oscillation import amplitude_at

# A sine is projected over whole periods, after at least this long.
SETTLING_S: Final = 0.1
WHOLE_PERIODS: Final = 4


def _periods(frequency_hz: float, refinement: int) -> tuple[int, int]:
    """Return the numbers of samples for settling and for the projection, both whole periods."""
    period = RATE_HZ / frequency_hz
    settling = math.ceil(refinement * SETTLING_S * frequency_hz) * period
    return round(settling), round(refinement * WHOLE_PERIODS * period)


def _amplitude(force: Array, frequency_hz: float, samples: int) -> float:
    """Return the amplitude of the last `samples` of a force at a frequency."""
    last = force[-samples:]
    return abs(amplitude_at(last - last.mean(), frequency_hz, RATE_HZ))


def open_loop_gain(plant: np.void, amplitude_n: float, frequency_hz: float, refinement: int = 1
                   ) -> float:
    """Return the force per valve command, N/N, at an amplitude (N) and a frequency (Hz)."""
    settling, samples = _periods(frequency_hz, refinement)
    time = np.arange(settling + samples) / RATE_HZ
    run = open_loop(plant, amplitude_n * np.sin(2.0 * np.pi * frequency_hz * time))
    return _amplitude(run.force_n, frequency_hz, samples) / amplitude_n


def closed_loop_gain(plant: np.void, controller: Values, amplitude_n: float, frequency_hz: float,
                     refinement: int = 1) -> float:
    """Return the force per desired force, N/N, at an amplitude (N) and a frequency (Hz)."""
    settling, samples = _periods(frequency_hz, refinement)
    bench = Bench(plant, controller)
    force = bench.run((settling + samples) / RATE_HZ, amplitude_n, frequency_hz).force_n
    return _amplitude(force, frequency_hz, samples) / amplitude_n


def bandwidth_hz(gain: Callable[[float], float], low_hz: float,
                 frequencies_hz: Sequence[float], refinement: int = 1) -> float:
    """
    Return the frequency at which `gain` is 3 dB below its value at `low_hz`; infinite if none.

    frequencies_hz: rising; between two of them the gain is interpolated as a power of the
    frequency. refinement: factor by which the grid of frequencies is refined.
    """
    index = np.arange((len(frequencies_hz) - 1) * refinement + 1) / refinement
    finer = np.exp(np.interp(index, np.arange(len(frequencies_hz)), np.log(frequencies_hz)))
    level = gain(low_hz) / math.sqrt(2.0)
    before_hz, before = low_hz, level * math.sqrt(2.0)
    for frequency in finer if refinement > 1 else frequencies_hz:
        after = gain(frequency)
        if after < level:
            share = math.log(before / level) / math.log(before / max(after, 1e-9))
            return before_hz * (frequency / before_hz) ** share
        before_hz, before = frequency, after
    return math.inf
