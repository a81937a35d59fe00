"""
Frequency response from an input to an output; bandwidth and delay.

From a run that excites many frequencies (chirp, multisine, PRBS): the H1 estimate with its
coherence. From a step: the spectrum of the differentiated step response, which is the impulse
response of a linear loop.
"""

import math
from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import ndimage, signal

from asi_analysis.arrays import Array, Complex, Mask
from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError
from asi_analysis.measures.correlation import correlation_delay
from asi_analysis.measures.oscillation import fit_sine, sine_frequency
from asi_analysis.measures.step_response import Step, largest_step, step_responses
from asi_analysis.reporting.result import Pictures, Result, Table, frame, number

AVERAGED_LINES: Final = 9
# A line is used if its input power is at least this share of that of the strongest line,
EXCITED: Final = 1e-4
# this share of that of the strongest line within a NEARBY share of the spectrum (less between the
# tones of a multisine),
EXCITED_NEARBY: Final = 0.03
NEARBY: Final = 0.01
# and its coherence at least this.
COHERENT: Final = 0.8
# A line is not used if the input has it only in the outer fortieth of the record or so, where the
# tapers are small: their slopes then have this multiple of their usual power.
AT_EDGE: Final = 5.0
# The gain of a first-order lag is that at rest, but for 2 %, so many times below its bandwidth.
LOWEST: Final = 5.0
# Largest number of lines of the spectrum of a step response.
MOST_LINES: Final = 2**22
# A reference of at least this many steps (PRBS) has a broad spectrum.
FEWEST_STEPS: Final = 4
HALF_POWER: Final = np.sqrt(0.5)
# A sine has at least this share of its power within so many lines of the strongest one.
SINE: Final = 0.99
SINE_LINES: Final = 3
# A sine of fewer cycles may be a ramp or a staircase.
FEWEST_CYCLES: Final = 0.6
# Of fewer samples, many signals look like a sine.
SINE_LEAST: Final = 8
# Samples that suffice to fit one of so few cycles.
SINE_SAMPLES: Final = 2000
Places = npt.NDArray[np.intp]
TOO_POOR: Final = 'the input excites too few frequencies, or the output does not follow it'


class Estimate(NamedTuple):
    """
    A frequency response at m frequencies where the input is excited and the output coherent.

    bandwidth_hz: where the gain is 3 dB below that at the lowest frequencies, interpolated; None
    if that is above the highest frequency. delay_s: from the slope of the phase up to the
    bandwidth.
    """

    frequency_hz: Array
    response: Complex
    coherence: Array
    bandwidth_hz: float | None
    delay_s: float | None

    @property
    def lowest_hz(self) -> float:
        """The lowest frequencies, whose gain is the level of the bandwidth."""
        return float(np.median(self.frequency_hz[:AVERAGED_LINES]))


def bandwidth(frequency_hz: Array, gain: Array) -> float | None:
    """
    Return where `gain` is first 3 dB below its median over the lowest tenth of an octave.

    The median is of at least as many lines as the estimate averages: one alone may be off by 5 %.
    """
    lowest = np.count_nonzero(frequency_hz <= 1.07 * frequency_hz[0])
    low = np.median(gain[:max(lowest, AVERAGED_LINES)])
    level = low * HALF_POWER
    below = np.flatnonzero(gain < level)
    if not below.size or below[0] == 0:
        return None
    k = int(below[0])
    # Linear interpolation of decibels over the logarithm of the frequency.
    x, y = np.log(frequency_hz[k - 1:k + 1]), np.log(gain[k - 1:k + 1])
    return float(np.exp(x[0] + (np.log(level) - y[0]) / (y[1] - y[0]) * (x[1] - x[0])))


def phase_delay(frequency_hz: Array, response: Complex,
                weights: Array) -> float:
    """Return the delay (s) whose phase, zero at 0 Hz, fits the response best (least squares)."""
    phase = np.unwrap(np.angle(response))
    phase -= 2.0 * np.pi * np.round(phase[0] / (2.0 * np.pi))
    omega = 2.0 * np.pi * frequency_hz
    return float(-np.sum(weights * omega * phase) / np.sum(weights * omega**2))


def _at_its_frequency(time: Array, sine: Array, output: Array) -> tuple[float, complex] | None:
    """
    Return the frequency (Hz) of a sine, and the response of an output to it.

    None if the output does not follow it. The lines of a spectrum are too coarse for few cycles.
    """
    moves = np.flatnonzero(np.diff(sine))   # before and after it rests
    moving = slice(int(moves[0]), int(moves[-1]) + 2)
    time, sine, output = time[moving], sine[moving], output[moving]
    frequency = sine_frequency(time, sine - sine.mean())
    answer, left = fit_sine(time, output, frequency)
    if not np.var(left) < (1.0 - COHERENT) * np.var(output):
        return None
    return frequency, answer / fit_sine(time, sine, frequency)[0]


def is_sine(values: Array) -> bool:
    """Return whether nearly all of a signal is a single sine, of which one frequency is known."""
    if values.size < SINE_LEAST or np.ptp(values) == 0.0:
        return False
    window = signal.windows.hann(values.size)
    power = np.abs(np.fft.rfft(window * (values - values.mean()))) ** 2
    k = int(np.argmax(power))
    if k <= SINE_LINES:   # harmonics are among those lines
        return _sine_share(values, k) > SINE
    return bool(power[max(k - SINE_LINES, 0):k + SINE_LINES + 1].sum() > SINE * power.sum())


def _sine_share(values: Array, cycles: int) -> float:
    """Return the share of the variance that a sine of about so many cycles in the record has."""
    values = values[::-(-values.size // SINE_SAMPLES)]
    if np.ptp(values) == 0.0:
        return 0.0
    turn = 2.0 * np.pi * np.arange(values.size) / values.size
    left = []
    tried = cycles + np.linspace(-1.0, 1.0, 41)[1:]
    for each in tried[tried > FEWEST_CYCLES]:
        columns = np.column_stack([np.cos(each * turn), np.sin(each * turn), np.ones(turn.size)])
        left.append(np.std(values - columns @ np.linalg.lstsq(columns, values)[0]))
    return float(1.0 - (min(left) / np.std(values)) ** 2)


class _Spectra(NamedTuple):
    """At each line: power of the input, whether it lies inside the tapers, response, coherence."""

    power: Array
    inside: Mask
    response: Complex
    coherence: Array


def _averaged(x: Array, y: Array) -> _Spectra:
    """
    Return the spectra of n changes of an input and an output.

    Averaged over sine tapers (Riedel, Sidorenko, IEEE Trans. Signal Processing 43, 1995), which
    widen a line to AVERAGED_LINES. Each is 0 at both ends of the record, where the signals need
    not be at rest, and together they weight the rest of it evenly, as a chirp needs, which passes
    each frequency only once. A response with a memory s also sees the slope of the taper:
    w(t) h x = h (w x) + (s h) (w' x) + ..., so that it is fitted together with that of w' x.
    """
    place = np.pi * (np.arange(x.size) + 1.0) / (x.size + 1.0)
    lines = x.size // 2 + 1
    power, slopes, outputs = np.zeros((3, lines))
    mixed, cross, cross_slope = np.zeros((3, lines), complex)
    for turns in range(1, AVERAGED_LINES + 1):
        taper, slope = np.sin(turns * place), turns * np.cos(turns * place)
        u, s, v = (np.fft.rfft(each) for each in (taper * x, slope * x, taper * y))
        power += np.abs(u) ** 2
        slopes += np.abs(s) ** 2
        outputs += np.abs(v) ** 2
        mixed += np.conj(u) * s
        cross += np.conj(u) * v
        cross_slope += np.conj(s) * v
    whole = np.maximum(power * slopes - np.abs(mixed) ** 2, 1e-12 * power * slopes) + 1e-300
    response = (slopes * cross - mixed * cross_slope) / whole
    memory = (power * cross_slope - np.conj(mixed) * cross) / whole
    explained = (np.conj(response) * cross + np.conj(memory) * cross_slope).real
    usual = (AVERAGED_LINES + 1) * (2 * AVERAGED_LINES + 1) / 6.0
    return _Spectra(power, slopes < AT_EDGE * usual * power, response,
                    explained / np.maximum(outputs, 1e-300))


def _usable(found: _Spectra, size: int) -> Places:
    """Return the lines at which the input is excited and the output coherent."""
    lines = np.arange(found.power.size)
    # That of the signal, not of its changes; a widened line is not that of one frequency.
    power = found.power / np.sin(np.pi * np.maximum(lines, AVERAGED_LINES // 2) / size) ** 2
    nearby = ndimage.maximum_filter1d(power, max(4 * AVERAGED_LINES, int(NEARBY * power.size)))
    return np.flatnonzero((power > EXCITED * power.max()) & (power > EXCITED_NEARBY * nearby)
                          & (found.coherence > COHERENT) & found.inside & (lines > 0))


def estimate(input_: Array, output: Array, period_s: float) -> Estimate | None:
    """
    Return the H1 estimate from n samples each; None with fewer than 3 usable frequencies.

    From tapers over the whole run (`_averaged`): unlike Welch's segments this has no bias for a
    chirp, which passes each frequency only once.
    """
    valid = np.isfinite(input_) & np.isfinite(output)
    if valid.sum() < 3:
        return None
    x, y = (np.where(valid, v, np.interp(np.arange(v.size), np.flatnonzero(valid), v[valid]))
            for v in (input_, output))
    # A delay turns the phase over the averaged lines, and by whole turns between tones: the output
    # is taken back by it, and its phase is put back below. A sine would lose its whole cycles.
    late = 0 if is_sine(x) else max(round(correlation_delay(x, y, 1.0) or 0.0), 0)
    x, y = x[:x.size - late], y[late:]
    # Their changes have no offset, and of a staircase no slope of the spectrum that would leak.
    found = _averaged(np.diff(x), np.diff(y))
    usable = _usable(found, x.size - 1)
    if usable.size < 3:
        return None
    frequency, response, coherence = (
        usable / ((x.size - 1) * period_s), found.response[usable], found.coherence[usable])
    # One line alone may be below the level by noise.
    limit = bandwidth(frequency, ndimage.median_filter(np.abs(response), AVERAGED_LINES,
                                                       mode='nearest'))
    band = frequency <= (limit or frequency[-1])
    delay = late * period_s + phase_delay(frequency[band], response[band], coherence[band])
    turned = response * np.exp(-2j * np.pi * frequency * late * period_s)
    return Estimate(frequency, turned, coherence, limit, delay)


def step_bandwidth(run: Run, step: Step) -> float | None:
    """
    Return the bandwidth (Hz) from a step response; None if that does not settle.

    From the spectrum of the differences of the controlled signal, from the step to twice the
    settling time.
    """
    if step.settling_time_2_s is None or step.rise_time_s is None:
        return None
    start = int(np.searchsorted(run.time_s, step.time_s))
    # Twice the settling time covers slow tails; after that there is only noise.
    end = start + int(2.0 * step.settling_time_2_s * run.rate_hz) + 2
    output = run.signal(run.controlled())[max(start - 1, 0):end]
    differences = np.diff(output[np.isfinite(output)])
    # Zero-padded to a hundred lines below the bandwidth of a first-order lag with this rise time.
    padded = int(100.0 * run.rate_hz * step.rise_time_s / 0.35)
    lines = max(8 * differences.size, min(padded, MOST_LINES))
    gain = np.abs(np.fft.rfft(differences, lines)).astype(np.float64)
    return bandwidth(np.fft.rfftfreq(lines, run.period_s)[1:].astype(np.float64), gain[1:])


def _is_driven_by_a_sine(run: Run, name: str) -> bool:
    """Return whether the reference, or without one the named signal, is a single sine."""
    driving = run.signal(name) if run.reference_n is None else run.reference_n
    return is_sine(driving[np.isfinite(driving)])


def actuator_bandwidth(run: Run, name: str = 'force', lowest_hz: float = 0.0
                       ) -> tuple[float | None, str | None]:
    """
    Return the bandwidth (Hz) from command to a signal, and why it is doubtful.

    lowest_hz: the lowest frequencies that the reference excites; below them the command has only
    what noise and friction make of it. None if the bandwidth cannot be measured, or without doubt.
    """
    output = run.signals().get(name)
    if run.command_n is None or output is None or _is_driven_by_a_sine(run, 'command'):
        return None, None
    response = estimate(run.command_n, output, run.period_s)
    if response is None:
        return None, None
    return response.bandwidth_hz, _doubt(response.bandwidth_hz, max(lowest_hz, response.lowest_hz))


class Bandwidth(NamedTuple):
    """
    Bandwidth and delay of a loop; method: 'excitation', 'step', or None.

    reason: why there is no bandwidth, or why it is doubtful. lowest_hz: the lowest frequencies
    that the reference excites, 0 if it is no excitation.
    """

    bandwidth_hz: float | None
    method: str | None
    delay_s: float | None
    correlation_delay_s: float | None
    reason: str | None
    lowest_hz: float = 0.0


def loop_bandwidth(run: Run, name: str | None = None) -> Bandwidth:
    """Return bandwidth and delay from the reference of a run to a signal, by default its own."""
    output = run.followed(name)
    if run.reference_n is None or output is None:
        missing = ('the run has no reference' if run.reference_n is None else
                   f'the reference is that of a {run.controlled()}, not of the {run.output(name)}')
        return Bandwidth(None, None, None, None, missing)
    valid = np.isfinite(run.reference_n) & np.isfinite(output)
    lag = correlation_delay(np.where(valid, run.reference_n, 0.0), np.where(valid, output, 0.0),
                            run.period_s) if len(np.unique(run.reference_n[valid])) > 1 else None
    steps = step_responses(run)
    step = largest_step(steps)
    if step is not None and len(steps) < FEWEST_STEPS:
        found = step_bandwidth(run, step)
        return Bandwidth(found, 'step', None, lag, None if found else
                         'the step response does not settle')
    if is_sine(run.reference_n[valid]):
        found_there = _at_its_frequency(run.time_s[valid], run.reference_n[valid], output[valid])
        if found_there is None:
            return Bandwidth(None, None, None, lag, TOO_POOR)
        frequency_hz, ratio = found_there
        phase_deg = round(math.degrees(np.angle(ratio)))
        return Bandwidth(None, None, None, None, (
            f'the reference is a single sine of {frequency_hz:.4g} Hz, which shows only the gain '
            f'there, {abs(ratio):.3g}, and the phase, {phase_deg} degrees'))
    response = estimate(run.reference_n, output, run.period_s)
    if response is None:
        return Bandwidth(None, None, None, lag, TOO_POOR)
    reason = _doubt(response.bandwidth_hz, response.lowest_hz) if response.bandwidth_hz else (
        f'the gain does not fall by 3 dB up to {response.frequency_hz[-1]:.4g} Hz, the highest '
        'frequency that is excited')
    return Bandwidth(response.bandwidth_hz, 'excitation', response.delay_s, lag, reason,
                     response.lowest_hz)


def _doubt(bandwidth_hz: float | None, lowest_hz: float) -> str | None:
    """Return a doubt if the lowest frequencies, whose gain is the level, are not low."""
    if bandwidth_hz is None or bandwidth_hz > LOWEST * lowest_hz:
        return None
    return (f'doubtful, as it is where the gain is 3 dB below that at {lowest_hz:.4g} Hz, the '
            'lowest frequencies that are excited: at rest it may be higher')


class FrequencyResponse(Result):
    """
    The result of `frequency_response`.

    `run` is the recording; frequency_hz, gain, phase_deg and coherence are lists of m values.
    """

    title = 'Frequency response'
    run: Run

    def parts(self) -> Iterator[str | Table]:
        yield (f'{self.run.source or "run"}: {self.input} to {self.output}, '
               f'{len(self.frequency_hz)} frequencies from {self.frequency_hz[0]:.4g} to '
               f'{self.frequency_hz[-1]:.4g} Hz')
        yield Table(('', ''), [('bandwidth', number(self.bandwidth_hz, 'Hz', 3)),
                               ('delay, from the phase', number(1e3 * self.delay_s, 'ms', 3))])

    def pictures(self) -> Pictures:
        from asi_analysis.reporting.figures import bode
        return {'bode': (bode(*(np.array(self[key]) for key in (
            'frequency_hz', 'gain', 'phase_deg', 'coherence'))),
            f'Frequency response from {self.input} to {self.output}')}

    def to_frame(self) -> Any:
        """Return frequency_hz, gain, phase_deg and coherence as a pandas DataFrame."""
        return frame({key: self[key] for key in ('frequency_hz', 'gain', 'phase_deg',
                                                 'coherence')})


def frequency_response(run: Run, input: str = 'reference', output: str | None = None  # noqa: A002
                       ) -> FrequencyResponse:
    """
    Return the frequency response from one signal of a run to another, with its coherence.

    run: a recording whose input excites many frequencies (chirp, multisine, PRBS); input, output:
    names of signals, the output by default the controlled one. Gain in units of output
    over input, phase in degrees, bandwidth in Hz (-3 dB), delay in s. Frequencies without
    excitation, or where the coherence is below 0.8, are left out. Raises InputError for a signal
    that was not recorded, for a reference of a few steps or a single sine, or if fewer than 3
    frequencies are left.

    H1 estimator: Bendat and Piersol, Random Data, 4th ed., section 6.1.

    >>> import asi_analysis as asi
    >>> run = asi.simulate({}, {'reference.shape': 'chirp', 'reference.frequency': 2.0,
    ...                         'reference.end_frequency': 200.0}, 2.0)
    >>> response = asi.frequency_response(run, 'command', 'force')
    >>> print(f'{response.bandwidth_hz:.0f} Hz')
    22 Hz
    """
    output = output or run.controlled()
    if input == 'reference' and 0 < len(step_responses(run)) < FEWEST_STEPS:
        raise InputError(f'{run.source or "run"}: a step excites too few frequencies: use '
                         'step_response, or record a chirp, multisine or PRBS')
    if _is_driven_by_a_sine(run, input):
        raise InputError(f'{run.source or "run"}: a single sine shows one frequency only: record '
                         'a chirp, multisine or PRBS')
    found = estimate(run.signal(input), run.signal(output), run.period_s)
    if found is None:
        raise InputError(f'{run.source or "run"}: {TOO_POOR}')
    return FrequencyResponse({
        'input': input, 'output': output, 'bandwidth_hz': found.bandwidth_hz,
        'delay_s': found.delay_s, 'frequency_hz': found.frequency_hz.tolist(),
        'gain': np.abs(found.response).tolist(),
        'phase_deg': np.degrees(np.unwrap(np.angle(found.response))).tolist(),
        'coherence': found.coherence.tolist()}, run=run)
