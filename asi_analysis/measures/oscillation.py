"""Does the force oscillate by itself in the steady part of a run, how fast and how much."""

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import optimize, signal

from asi_analysis.bags.run import Run
from asi_analysis.measures.step_response import held

# Part of the run after the last change of the reference's course that counts as steady.
STEADY_SHARE: Final = 0.5
FEWEST_PERIODS: Final = 5
# From the first half of the steady part to the second an oscillation that lasts keeps this share.
KEEPS: Final = 0.9
# Least amplitude, as share of the whole movement of the force, and share of the movement in the
# steady part that the sine must explain.
LEAST_SHARE: Final = 1e-3
LEAST_EXPLAINED: Final = 0.3
HARMONICS: Final = 9

Array = npt.NDArray[np.float64]


class Oscillation(NamedTuple):
    """What swings in the steady part; frequency and amplitude None if nothing does."""

    sustained: bool | None      # None: cannot be told, `reason` says why
    frequency_hz: float | None
    amplitude_n: float | None   # of the fundamental
    reason: str | None


def fit_sine(time: Array, values: Array, frequency_hz: float) -> tuple[complex, Array]:
    """Return amplitude and phase (a complex number) at a frequency, and what is left (N)."""
    angle = 2.0 * np.pi * frequency_hz * time
    basis = np.column_stack([np.cos(angle), np.sin(angle), np.ones_like(time)])
    weights, *_ = np.linalg.lstsq(basis, values, rcond=None)
    return complex(weights[0], -weights[1]), values - basis @ weights


def dominant_frequency(time: Array, values: Array, fewest_periods: int = FEWEST_PERIODS) -> float:
    """
    Return the frequency (Hz) of the strongest sine of at least so many periods.

    The peak of the windowed spectrum, refined by least squares within a line of it.
    """
    period = (time[-1] - time[0]) / (time.size - 1)
    spectrum = np.abs(np.fft.rfft(values * signal.windows.hann(values.size)))
    spectrum[:fewest_periods] = 0.0
    # At half the sampling rate itself amplitude and phase cannot be told apart.
    spectrum[int(0.95 * spectrum.size):] = 0.0
    line = 1.0 / (period * values.size)
    guess = float(np.argmax(spectrum)) * line
    best = optimize.minimize_scalar(
        lambda f: float(np.sum(fit_sine(time, values, f)[1]**2)),
        bounds=(max(guess - line, 0.1 * line), guess + line), method='bounded',
        options={'xatol': 1e-4 * line})
    return float(best.x)


def _steady_part(run: Run) -> slice:
    """Return the samples of the second half of the time after the last jump of the reference."""
    n = run.time_s.size
    start = 0
    if run.reference_n is not None:
        reference = held(run.reference_n)
        large = np.flatnonzero(np.abs(np.diff(reference)) > 0.2 * max(np.ptp(reference), 1e-12))
        start = int(large[-1]) + 1 if large.size else 0
    return slice(start + int((1.0 - STEADY_SHARE) * (n - start)), n)


def _without_reference(time: Array, force: Array, reference: Array) -> Array | None:
    """
    Return the force less the answer to a periodic reference: its frequency and harmonics.

    None if the reference holds more than one sine: then every frequency may be forced.
    """
    if np.ptp(reference) <= 1e-3 * max(np.ptp(force), 1e-12):
        return force
    frequency = dominant_frequency(time, reference, 1)
    amplitude, left = fit_sine(time, reference, frequency)
    # A triangle leaves 1.4 % of its power; a chirp or a PRBS most of it.
    if np.var(left) > 0.05 * np.var(reference):
        return None
    for k in range(1, HARMONICS + 1):
        force = fit_sine(time, force, k * frequency)[1]
    return force


def oscillation(run: Run) -> Oscillation:
    """
    Return the self-sustained oscillation of the force in the steady part of a run.

    Sustained: its amplitude in the second half of that part is at least 0.9 of the first half's.
    What a periodic reference forces (its frequency and harmonics) is taken out before.
    """
    if run.force_n is None:
        return Oscillation(None, None, None, 'the run holds no force')
    part = _steady_part(run)
    time, force = run.time_s[part], run.force_n[part]
    valid = np.isfinite(force)
    time, force = time[valid], force[valid]
    if time.size < 50:
        return Oscillation(None, None, None, 'the steady part is shorter than 50 samples')
    least = LEAST_SHARE * np.ptp(run.force_n[np.isfinite(run.force_n)])
    if least == 0.0:
        return Oscillation(False, None, None, None)
    force = signal.detrend(force)
    if run.reference_n is not None:
        reference = held(run.reference_n)[part][valid]
        freed = _without_reference(time, force, reference - reference.mean())
        if freed is None:
            return Oscillation(None, None, None,
                               'the reference moves at many frequencies to the end of the run')
        force = freed
    frequency = dominant_frequency(time, force)
    amplitude, left = fit_sine(time, force, frequency)
    explained = 1.0 - np.var(left) / max(float(np.var(force)), 1e-300)
    if abs(amplitude) < least or explained < LEAST_EXPLAINED:
        return Oscillation(False, None, None, None)
    half = time.size // 2
    first = abs(fit_sine(time[:half], force[:half], frequency)[0])
    second = abs(fit_sine(time[half:], force[half:], frequency)[0])
    return Oscillation(second >= KEEPS * first, frequency, abs(amplitude), None)
