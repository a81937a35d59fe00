"""
How an input becomes an output at each frequency; bandwidth and delay.

From a run that excites many frequencies (chirp, multisine, PRBS): the H1 estimate with its
coherence. From a step: the spectrum of the differentiated step response, which is the impulse
response of a linear loop.
"""

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import ndimage, signal

from asi_analysis.bags.run import Run
from asi_analysis.measures.step_response import Step, headline, step_responses

AVERAGED_LINES: Final = 9
# Lines where the input holds less than this share of its strongest line's power tell nothing;
EXCITED: Final = 1e-4
# nor do those between the tones of a multisine, weak against the strongest nearby ...
EXCITED_NEARBY: Final = 0.03
NEARBY: Final = 0.01
# ... nor those where less than this share of the output comes from the input.
COHERENT: Final = 0.8
HALF_POWER: Final = np.sqrt(0.5)

Array = npt.NDArray[np.float64]


class FrequencyResponse(NamedTuple):
    """
    The response at m frequencies where the input moves and the output follows it.

    Bandwidth: where the gain has fallen by 3 dB from that at the lowest frequencies, between the
    lines; None if it does not fall so far below the highest frequency.
    Delay: the lag of the output, from the slope of the phase up to the bandwidth.
    """

    frequency_hz: Array
    response: npt.NDArray[np.complex128]
    coherence: Array
    bandwidth_hz: float | None
    delay_s: float | None


def bandwidth(frequency_hz: Array, gain: Array) -> float | None:
    """
    Return where `gain` first falls by 3 dB from that of the lowest tenth of an octave.

    Of so many lines at least as the estimate averages: one line alone may be off by 5 %.
    """
    lowest = np.count_nonzero(frequency_hz <= 1.07 * frequency_hz[0])
    low = np.median(gain[:max(lowest, AVERAGED_LINES)])
    level = low * HALF_POWER
    below = np.flatnonzero(gain < level)
    if not below.size or below[0] == 0:
        return None
    k = int(below[0])
    # Straight in decibels against the logarithm of the frequency, as in a Bode plot.
    x, y = np.log(frequency_hz[k - 1:k + 1]), np.log(gain[k - 1:k + 1])
    return float(np.exp(x[0] + (np.log(level) - y[0]) / (y[1] - y[0]) * (x[1] - x[0])))


def phase_delay(frequency_hz: Array, response: npt.NDArray[np.complex128],
                weights: Array) -> float:
    """Return the delay (s) whose phase fits the response best, a line through zero at 0 Hz."""
    phase = np.unwrap(np.angle(response))
    phase -= 2.0 * np.pi * np.round(phase[0] / (2.0 * np.pi))
    omega = 2.0 * np.pi * frequency_hz
    return float(-np.sum(weights * omega * phase) / np.sum(weights * omega**2))


def correlation_delay(input_: Array, output: Array, period_s: float) -> float:
    """Return the lag (s) at which the output resembles the input most, between the samples."""
    a, b = input_ - input_.mean(), output - output.mean()
    correlation = signal.correlate(b, a, method='fft')
    k = int(np.argmax(np.abs(correlation)))
    lag = float(k - (a.size - 1))
    if 0 < k < correlation.size - 1:
        left, middle, right = correlation[k - 1:k + 2]
        lag += 0.5 * (left - right) / (left - 2.0 * middle + right)
    return float(lag * period_s)


def frequency_response(input_: Array, output: Array, period_s: float) -> FrequencyResponse | None:
    """
    Return the response of an output to an input, n samples each; None if the input is too poor.

    The spectra of the whole run, averaged over neighbouring lines: unlike Welch's segments this
    has no bias for a chirp, which is at each frequency only once.
    """
    valid = np.isfinite(input_) & np.isfinite(output)
    x, y = (np.where(valid, v, np.interp(np.arange(v.size), np.flatnonzero(valid), v[valid]))
            for v in (input_, output))
    u, v = (np.fft.rfft(each - each.mean()) for each in (x, y))
    frequency = np.fft.rfftfreq(x.size, period_s)
    power, output_power, cross = (
        ndimage.uniform_filter1d(each, AVERAGED_LINES, mode='nearest')
        for each in (np.abs(u)**2, np.abs(v)**2, np.conj(u) * v))
    coherence = np.abs(cross)**2 / np.maximum(power * output_power, 1e-300)
    nearby = ndimage.maximum_filter1d(power, max(4 * AVERAGED_LINES, int(NEARBY * power.size)))
    # The lines nearest to zero are averaged with the mean, which is not there.
    trusted = ((power > EXCITED * power.max()) & (power > EXCITED_NEARBY * nearby)
               & (coherence > COHERENT))
    trusted[:AVERAGED_LINES // 2 + 1] = False
    if trusted.sum() < 3:
        return None
    frequency, response, coherence = (
        frequency[trusted], (cross[trusted] / power[trusted]), coherence[trusted])
    limit = bandwidth(frequency, np.abs(response))
    band = frequency <= (limit or frequency[-1])
    delay = phase_delay(frequency[band], response[band], coherence[band])
    return FrequencyResponse(frequency, response, coherence, limit, delay)


def step_bandwidth(run: Run, step: Step) -> float | None:
    """
    Return the bandwidth (Hz) that a step response stands for; None if it has not come to rest.

    The Fourier sum of the differences of the force from the step to the end of its plateau,
    as far as they are more than noise: until the force stays within 2 % of its end.
    """
    if step.settling_time_2_s is None or run.force_n is None or step.rise_time_s is None:
        return None
    start = int(np.searchsorted(run.time_s, step.time_s))
    # Past the settling time there is nothing but its own length again, for slow tails.
    end = start + int(2.0 * step.settling_time_2_s * run.rate_hz) + 2
    force = run.force_n[max(start - 1, 0):end]
    differences = np.diff(force[np.isfinite(force)])
    # Padded so that a hundred lines lie below the bandwidth of a first-order lag of this rise.
    lines = max(8 * differences.size, int(100.0 * run.rate_hz * step.rise_time_s / 0.35))
    gain = np.abs(np.fft.rfft(differences, lines)).astype(np.float64)
    return bandwidth(np.fft.rfftfreq(lines, run.period_s)[1:].astype(np.float64), gain[1:])


def actuator_bandwidth(run: Run) -> float | None:
    """Return the bandwidth (Hz) from the valve command to the force; None if it cannot be told."""
    if run.command_n is None or run.force_n is None:
        return None
    response = frequency_response(run.command_n, run.force_n, run.period_s)
    return response.bandwidth_hz if response else None


class Bandwidth(NamedTuple):
    """What a run tells of the loop's bandwidth, and how: 'excitation', 'step' or None."""

    bandwidth_hz: float | None
    method: str | None
    delay_s: float | None
    correlation_delay_s: float | None
    reason: str | None


def loop_bandwidth(run: Run) -> Bandwidth:
    """Return bandwidth and delay from the reference of a run to the signal it asks for."""
    output = None if run.reference_n is None else run.signals().get(run.controlled())
    if run.reference_n is None or output is None:
        missing = 'reference' if run.reference_n is None else run.controlled()
        return Bandwidth(None, None, None, None, f'the run holds no {missing}')
    steps = step_responses(run)
    step = headline(steps)
    if step is not None and len(steps) < 4:
        found = step_bandwidth(run, step)
        return Bandwidth(found, 'step', None, None, None if found else
                         'the step response does not come to rest')
    response = frequency_response(run.reference_n, output, run.period_s)
    if response is None:
        return Bandwidth(None, None, None, None,
                         'the reference moves at too few frequencies, or the output does not '
                         'follow it')
    valid = np.isfinite(run.reference_n) & np.isfinite(output)
    lag = correlation_delay(np.where(valid, run.reference_n, 0.0), np.where(valid, output, 0.0),
                            run.period_s)
    reason = None if response.bandwidth_hz else (
        f'the gain does not fall by 3 dB up to {response.frequency_hz[-1]:.4g} Hz, the highest '
        'that the run tells of')
    return Bandwidth(response.bandwidth_hz, 'excitation', response.delay_s, lag, reason)
