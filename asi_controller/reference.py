"""Reference signals of the controller's generator: compiled functions of time."""

import math
from collections.abc import Mapping
from typing import Final

import numpy as np

from asi_common.jit import jit
from asi_common.parameter import ParameterError, Value
from asi_controller.parameters import SHAPES

TOPIC, STEP, RAMP, SINE, TRIANGLE, CHIRP, MULTISINE, PRBS = range(len(SHAPES))
# Frequencies of each signal; the tones of a multisine and a chirp are between theirs.
FREQUENCIES: Final = {
    'sine': ('frequency',), 'triangle': ('frequency',), 'prbs': ('frequency',),
    'chirp': ('frequency', 'end_frequency'), 'multisine': ('frequency', 'end_frequency')}


def check_frequencies(values: Mapping[str, Value], rate_hz: float) -> None:
    """
    Raise ParameterError if the signal has frequencies above half of the control rate (Hz).

    Sampled, they are other ones: a sine of 900 Hz at 1 kHz is one of 100 Hz.
    """
    shape = str(values['reference.shape'])
    most, words = (rate_hz, 'the rate') if shape == 'prbs' else (0.5 * rate_hz, 'half of the rate')
    for name in FREQUENCIES.get(shape, ()):
        if float(values[f'reference.{name}']) > most:
            raise ParameterError(
                f'reference.{name} = {values[f"reference.{name}"]!r} is not allowed for a {shape} '
                f'at a control rate of {rate_hz:g} Hz: it takes at most {words}')


@jit
def _triangle(phase):
    """Return a triangle wave from -1 to 1 that starts at 0 and rises; phase in cycles."""
    return 1.0 - 4.0 * abs((phase + 0.25) % 1.0 - 0.5)


@jit
def _chirp(time, start_hz, end_hz, duration):
    """Return a logarithmic chirp, which continues to the next zero crossing after `duration`."""
    swept = min(time, duration)
    if start_hz == end_hz:
        cycles, total = start_hz * swept, start_hz * duration
    else:
        rate = math.log(end_hz / start_hz) / duration
        cycles = start_hz * math.expm1(rate * swept) / rate
        total = (end_hz - start_hz) / rate
    cycles += end_hz * (time - swept)
    return math.sin(2.0 * math.pi * cycles) if 2.0 * cycles < math.ceil(2.0 * total) else 0.0


@jit
def _multisine(time, start_hz, end_hz, tones):
    """
    Return `tones` equally spaced sines with Schroeder's phases (1970), for a low crest factor.

    With these the sum stays below 1.53 times the root of their number, whatever their frequencies
    (the worst are three; test/controller/test_reference.py tries each number).
    """
    total = 0.0
    step = (end_hz - start_hz) / (tones - 1) if tones > 1 else 0.0
    for k in range(tones):
        phase = -math.pi * (k * (k + 1) % (2 * tones)) / tones
        total += math.sin(2.0 * math.pi * (start_hz + k * step) * time + phase)
    return total / min(tones, 1.53 * math.sqrt(tones))


@jit
def _prbs(cell, seed):
    """Return a pseudo-random +1 or -1 for a cell and a seed (SplitMix64)."""
    x = np.uint64(seed) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(cell)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return 1.0 if (x >> np.uint64(63)) != np.uint64(0) else -1.0


@jit
def reference_force(time, r):
    """
    Return the desired force (N) at `time` s after the signal was chosen.

    r: record of REFERENCE_PARAMETERS. The difference from the offset is at most the amplitude.
    """
    t = time - r.reference_start
    # The tolerance is for a tick that rounding puts just before the start.
    if t < -1e-9:
        return r.reference_offset
    t = max(t, 0.0)
    if 0.0 < r.reference_end <= t + 1e-9:
        return r.reference_offset
    shape = int(r.reference_shape)
    value = 0.0
    if shape == STEP:
        value = 1.0
    elif shape == RAMP:
        value = min(t / r.reference_duration, 1.0)
    elif shape == SINE:
        value = math.sin(2.0 * math.pi * r.reference_frequency * t)
    elif shape == TRIANGLE:
        value = _triangle(t * r.reference_frequency)
    elif shape == CHIRP:
        value = _chirp(t, r.reference_frequency, r.reference_end_frequency, r.reference_duration)
    elif shape == MULTISINE:
        value = _multisine(t, r.reference_frequency, r.reference_end_frequency,
                           int(r.reference_tones))
    elif shape == PRBS:
        value = _prbs(int(t * r.reference_frequency + 1e-9), int(r.reference_seed))
    return r.reference_offset + r.reference_amplitude * value


@jit
def reference_forces(r, period, count):
    """Return the desired forces (N) at so many times, `period` s apart; see reference_force."""
    found = np.empty(count)
    for tick in range(count):
        found[tick] = reference_force(tick * period, r)
    return found
