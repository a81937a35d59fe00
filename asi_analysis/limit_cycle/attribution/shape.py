"""
What the shape of an oscillation, in command and output of a loop, says of its cause.

The features are independent of units, time scale and sign. The signals are cut into single cycles,
so that a varying period does not blur them. `classifier.py` turns features into probabilities.
"""

from typing import Final, NamedTuple

import numpy as np
from scipy import signal, stats

from asi_analysis.arrays import Array, Complex
from asi_analysis.errors import InputError
from asi_analysis.limit_cycle.attribution.hammerstein import Explanation, explain, without_drift
from asi_analysis.limit_cycle.detection.drive import flat_share
from asi_analysis.measures.sinusoids.noise import autoregression
from asi_analysis.measures.sinusoids.record import reduce
from asi_analysis.measures.sinusoids.sinusoid import analytic_signal, on_grid, valid_samples

FEWEST_CYCLES: Final = 3.5
MOST_CYCLES: Final = 20.0
# Points to which each cycle is resampled, and harmonics that are computed from them.
POINTS: Final = 32
HARMONICS: Final = 5
KINDS: Final = ('stiction', 'backlash', 'hysteresis', 'saturation')

FEATURES: Final = (
    # Gain in description length (nats) of each kind of valve over a linear one, and ratio of the
    # unexplained power (Hammerstein models: Srinivasan et al. 2005, Jelali 2008).
    *[f'{kind}_gain' for kind in KINDS], *[f'{kind}_ratio' for kind in KINDS],
    'unexplained', 'lag', 'delay',
    # Harmonics relative to the fundamental, with their phase: they distinguish triangle, square
    # and sine (He et al. 2007, Haegglund 2011).
    *[f'{name}_{part}' for name in ('output', 'command')
      for part in ('second', 'third_cos', 'third_sin', 'fifth_cos', 'fifth_sin')],
    # Twice the phase from command to output (Horch 1999): the sign of the process is unknown.
    'phase_cos', 'phase_sin',
    # Square 1, sine 1.5, triangle 1.8, noise 3; of the slopes: jumps make it large.
    'output_kurtosis', 'command_kurtosis', 'output_slope_kurtosis', 'command_slope_kurtosis',
    # Share of time in which the output rests while the command moves (Yamashita 2006), and vice
    # versa.
    'output_rests', 'command_rests',
    # Scatter of amplitude and period (Thornhill et al. 2003): large in a linear loop driven by
    # noise.
    'unevenness', 'period_scatter', 'size_scatter',
    # Residual of a PI law from output to command: large if the set point moves.
    'law', 'flat', 'hiss', 'cycles')


class Shape(NamedTuple):
    """
    The features of an oscillation, in the order of FEATURES, and the signals behind them.

    `command_cycle` and `output_cycle`: the mean cycle, POINTS samples, in units of the signals;
    `command` and `output`: the analysed segment, drift removed.
    """

    features: Array
    frequency_hz: float
    cycles: float
    explanations: dict[str, Explanation]
    command: Array
    output: Array
    command_cycle: Array
    output_cycle: Array


def shape(time_s: Array, command: Array, output: Array) -> Shape:
    """
    Return the shape of the oscillation in a loop's command and output.

    Raises InputError for fewer than FEWEST_CYCLES cycles, or a signal that does not move.
    """
    valid = np.isfinite(time_s) & np.isfinite(command) & np.isfinite(output)
    time_s, command, output = time_s[valid], command[valid], output[valid]
    if len(time_s) < 30:
        raise InputError(f'{len(time_s)} samples of command and output: at least 30 are needed')
    _check_moves(command, output)
    frequency = prominent_frequency(time_s, output)
    if not np.isfinite(frequency):
        raise InputError(f'no oscillation of at least {FEWEST_CYCLES:g} cycles')
    last = time_s >= time_s[-1] - MOST_CYCLES / frequency
    _check_moves(command[last], output[last])
    even = [on_grid(*reduce(time_s[last], each[last], frequency))
            for each in (command, output)]
    cycle = 1.0 / (frequency * even[0][1])
    command, output = even[0][0], even[1][0]
    return _described(command, output, cycle, frequency)


def _check_moves(command: Array, output: Array) -> None:
    if np.ptp(command) == 0.0 or np.ptp(output) == 0.0:
        raise InputError('command or output does not move: no oscillation to attribute')


def prominent_frequency(time_s: Array, values: Array) -> float:
    """
    Return the frequency (Hz) of the most prominent peak of the spectrum.

    A plant's slow drift can have more power than its oscillation: half the slope of a straight
    line through the log-log spectrum is removed. NaN if the record is too short for FEWEST_CYCLES.
    """
    even, period = on_grid(*valid_samples(time_s, values))
    count = len(even)
    even = signal.detrend(even) * np.hanning(count)
    power = np.abs(np.fft.rfft(even, 4 * count)) ** 2
    number = np.arange(len(power)) / 4.0                  # cycles in the record
    # Mean over the main lobe of the window: a line of varying frequency counts as a sharp one.
    width = 8 + (number * 0.25 * 4).astype(int)
    total = np.concatenate([[0.0], np.cumsum(power)])
    index = np.arange(len(power))
    low, high = np.maximum(index - width, 0), np.minimum(index + width + 1, len(power))
    smooth = (total[high] - total[low]) / (high - low)
    first, end = int(4 * FEWEST_CYCLES), int(0.4 * len(power))
    if end - first < 8 or not power[first:end].any():
        return float('nan')
    level, x = np.log(smooth[first:end] + 1e-12 * smooth.max()), np.log(number[first:end])
    # Weighted towards equal influence per octave: most points are at high frequencies.
    weight = 1.0 / np.sqrt(number[first:end])
    line = np.polynomial.polynomial.polyfit(x, level, 1, w=weight)
    slope = float(np.clip(line[1], -3.0, 0.0))
    # Half of the slope: a peak must have power too.
    prominence = level - 0.5 * slope * x
    peak = int(first + np.argmax(prominence))
    lobe = slice(max(peak - int(width[peak]), first), peak + int(width[peak]) + 1)
    return float(number[lobe.start + int(np.argmax(power[lobe]))] / (count * period))


def _described(command: Array, output: Array, cycle: float, frequency: float) -> Shape:
    found = explain(command, output, cycle)
    raw = command
    command, output = without_drift(np.array([command, output]), cycle)
    f = dict.fromkeys(FEATURES, 0.0)
    _explained(f, found)
    starts = _starts(output, cycle)
    cycles = [_cycles(each, starts) for each in (command, output)]
    harmonics = [np.fft.rfft(each, axis=1)[:, 1:HARMONICS + 1] for each in cycles]
    size = np.abs(harmonics[1][:, 0])
    for name, amplitudes in zip(('command', 'output'), harmonics, strict=True):
        relative = _relative(amplitudes)
        f[f'{name}_second'] = float(abs(relative[1]))
        for number, word in ((3, 'third'), (5, 'fifth')):
            f[f'{name}_{word}_cos'] = float(relative[number - 1].real)
            f[f'{name}_{word}_sin'] = float(relative[number - 1].imag)
    turn = np.sum(harmonics[1][:, 0] * harmonics[0][:, 0].conj())
    twice = (turn / max(abs(turn), 1e-300)) ** 2
    f['phase_cos'], f['phase_sin'] = float(twice.real), float(twice.imag)

    hop = max(1, round(cycle / 12.0))
    steps = {}
    for name, each in (('output', output), ('command', command)):
        steps[name] = each[hop:] - each[:-hop]
        f[f'{name}_kurtosis'] = _kurtosis(each)
        f[f'{name}_slope_kurtosis'] = _kurtosis(steps[name])
    moves = {name: np.abs(step) / np.abs(step).mean() for name, step in steps.items()}
    f['output_rests'] = float(np.mean((moves['output'] < 0.35) & (moves['command'] > 0.7)))
    f['command_rests'] = float(np.mean((moves['command'] < 0.35) & (moves['output'] > 0.7)))

    f['unevenness'] = float(np.log10(max(_unevenness(output, cycle), 1e-3)))
    lengths = np.diff(starts)
    f['period_scatter'] = float(np.log10(max(lengths.std() / lengths.mean(), 1e-3)))
    f['size_scatter'] = float(np.log10(max(size.std() / size.mean(), 1e-3)))
    f['law'] = _law(command, output)
    f['flat'] = float(flat_share(raw))
    f['hiss'] = float(np.log10(max(float(np.var(np.diff(output, 2)) / 6.0
                                    / np.var(output)), 1e-6)))
    f['cycles'] = float(np.log10(len(starts)))
    means = [np.mean(each, axis=0) for each in cycles]
    return Shape(np.array([f[name] for name in FEATURES]), frequency, float(len(output) / cycle),
                 found, command, output, means[0], means[1])


def _explained(f: dict[str, float], found: dict[str, Explanation]) -> None:
    """Set the features of the fitted valves."""
    if 'linear' not in found:
        raise InputError('the command rests in the oscillation: no valve to attribute it to')
    linear = found['linear']
    description = autoregression(linear.residual).description
    for kind in KINDS:
        if kind in found:
            better = description - autoregression(found[kind].residual).description
            f[f'{kind}_gain'] = float(np.arcsinh(better / 10.0))
            f[f'{kind}_ratio'] = float(np.log(max(linear.unexplained, 1e-5)
                                              / max(found[kind].unexplained, 1e-5)))
    f['unexplained'] = float(np.log10(max(linear.unexplained, 1e-4)))
    f['lag'], f['delay'] = float(np.log10(linear.lag + 0.01)), linear.delay


def _starts(output: Array, cycle: float) -> Array:
    """Return the starts of the cycles, in samples, from the phase of the analytic signal."""
    phase = np.unwrap(np.angle(analytic_signal(output, 1.0, 1.0 / cycle))) / (2.0 * np.pi)
    phase = np.maximum.accumulate(phase)
    whole = np.arange(np.ceil(phase[0]), np.floor(phase[-1]) + 1)
    starts = np.interp(whole, phase, np.arange(len(phase)))
    if len(starts) < 3:
        raise InputError(f'no oscillation of at least {FEWEST_CYCLES:g} cycles')
    return starts


def _cycles(values: Array, starts: Array) -> Array:
    """Return the cycles, resampled and detrended (cycles x POINTS)."""
    share = np.arange(POINTS) / POINTS
    rows = []
    for begin, end in zip(starts[:-1], starts[1:], strict=True):
        part = np.interp(begin + share * (end - begin), np.arange(len(values)), values)
        rise = np.interp([begin, end], np.arange(len(values)), values)
        rows.append(part - share * (rise[1] - rise[0]))
    table = np.array(rows)
    return table - table.mean(1, keepdims=True)


def _relative(harmonics: Complex) -> Complex:
    """Return the mean of each harmonic relative to the fundamental, phase from its peak."""
    order = np.arange(1, HARMONICS + 1)
    turned = harmonics * np.exp(-1j * order * np.angle(harmonics[:, :1]))
    # Weighted by amplitude; the third harmonic of a square is -1/3, of a triangle 1/9.
    mean = turned.sum(0) / max(float(np.abs(harmonics[:, 0]).sum()), 1e-300)
    return mean / np.maximum(np.abs(mean), 1.0)


def _law(command: Array, output: Array) -> float:
    """Return log10 of the share of the command's steps that a PI law leaves unexplained."""
    columns = np.column_stack([np.diff(output), output[1:]])
    steps = np.diff(command)
    residual = steps - columns @ np.linalg.lstsq(columns, steps, rcond=None)[0]
    share = float(residual @ residual) / max(float(steps @ steps), 1e-300)
    return float(np.log10(max(share, 1e-4)))


def _kurtosis(values: Array) -> float:
    return float(np.log(float(np.asarray(stats.kurtosis(values, fisher=False))) / 1.5))


def _unevenness(values: Array, cycle: float) -> float:
    """Return the variance of the squared envelope over its squared mean."""
    skip = min(int(0.5 * cycle), len(values) // 8)
    power = np.abs(analytic_signal(values, 1.0, 1.0 / cycle))[skip:len(values) - skip] ** 2
    return float(power.var() / power.mean() ** 2)
