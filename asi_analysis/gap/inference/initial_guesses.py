"""
Initial guesses, from a fit's residual, of parameters with many local minima of the cost.

Frequency, phase, start and end of a disturbance, and the quantum of a command. The part of the
residual that the fitted parameters could explain is removed first.
"""

import itertools
import math
from collections.abc import Callable, Iterable

import numpy as np
import numpy.typing as npt
from scipy.fft import next_fast_len
from scipy.signal import detrend, find_peaks

from asi_actuator.model.valve_flexure import dead_zone
from asi_analysis.arrays import Array, Complex
from asi_analysis.gap.inference.fit import STEP, Fitted
from asi_analysis.gap.model import blocks, simulator
from asi_analysis.gap.model.blocks import in_steps
from asi_analysis.gap.model.effects import MOTIONS, Variant, of_recording
from asi_analysis.gap.model.group import Group, Values, acts_on
from asi_analysis.gap.model.predict import in_recording, measured, predict
from asi_analysis.gap.prepare import Recording
from asi_analysis.parallel import in_threads
from asi_common.jit import jit
from asi_common.record import copy_of

PULSE_GRID = 400      # start and end times in the coarse search for a pulse
REFINEMENT = 50    # factor of each refinement of these times
# Candidates for the number of quanta up to the largest command: a coarse grid, in which commands
# are binned. So many of its local maxima, which come from a linear response, are simulated; then a
# fine grid about the best. Quanta that explain nearly as much as the best are equivalent.
STEPS = np.concatenate([np.arange(2.0, 60.0, 0.02), np.arange(60.0, 400.0, 0.1)])
BINS, PEAKS = 4000, 60
FINE_STEPS, EQUIVALENT = np.linspace(-0.1, 0.1, 101), 0.99
# Few steps change the fit without them, too: so many of the best of these are simulated as well,
# and quanta near the best, if that explains more than twice as much as the fine grid's best.
FEW_STEPS, MORE, NEARBY = np.geomspace(2.0, 20.0, 200), 20, np.linspace(0.994, 1.006, 9)
# Kinds of rounding: command_phase. Steps towards zero have the edges of `residual_step_edge`.
QUANTISERS = {'residual_step': 0.0, 'residual_step_edge': 0.5}
OFFSET_RANGE = 1e3  # range of a free offset, as a multiple of the residual's norm
# An excitation by a few sines: their largest number, and the least share of the power of force or
# motion in each of them and in all together.
MOST_LINES, LINE_POWER, LINES_POWER = 3, 0.1, 0.8
ORDER = 3          # highest order of harmonics
# A line of the force is a disturbance if this share of its power remains in the residual (of
# which three quarters of the samples are used).
LINE_REMAINDER = 0.3
SINGLE_WAVE = 0.5  # share of the residual's power in a wave that is a disturbance of its own
REGULARISATION = 1e-12   # ridge, as a share of the trace
STATIC_BINS = 2000  # of the input of a characteristic, in the search for its steps
RESPONSE_S = 0.2   # length of the step response of a valve


def initial_guesses(fitted: Fitted) -> Values:
    """
    Return initial guesses of parameters with many local minima of the cost, by name.

    Of each recording: residual_frequency (Hz) and residual_phase (turns, 1 to 2) of the strongest
    sine in the load's residual; residual_start and residual_end (s) of its strongest pulse. Of
    the recording with the largest command: the quantum (N) of the command if it is rounded to
    the nearest step (residual_step), or to steps with an edge at zero (residual_step_edge).
    """
    group = fitted.problem.group
    found: Values = {}
    moves = {'load', 'static', *MOTIONS}.intersection(group.channels)
    for recording in group.recordings if moves else ():
        if not recording.fit.any():
            continue
        channel, = moves
        residual, known = _deflated_residual(fitted, channel, recording)
        raw = _target(recording, channel) - _predicted(recording, channel, fitted.record)
        own = _wave(residual, recording) | _pulse(residual, _used(recording), known, raw,
                                              recording.period_s)
        if channel in MOTIONS:
            own |= _phase_of_push(fitted, recording, residual, known, own['residual_frequency'])
        found |= {of_recording(name, recording.number): value for name, value in own.items()}
    if 'static' in group.channels:
        found |= _static_steps(fitted)
    for channel in group.channels:
        if channel == 'valve' or channel == 'force' and not group.measures_valve:
            found |= _steps(fitted, channel)
    return found


def _deflated_residual(fitted: Fitted, channel: str, recording: Recording) -> tuple[Array, Array]:
    """
    Return the residual of a channel (n samples) without what the fitted parameters could explain.

    And an n x m matrix K: |K' x|^2 is the energy of a signal x that the parameters could explain.
    By ridge regression: a parameter explains no more than its whole range can.
    """
    group = fitted.problem.group
    base = _predicted(recording, channel, fitted.record)
    used = _used(recording)
    residual = (_target(recording, channel) - base) * used
    columns = [np.full_like(base, OFFSET_RANGE * np.linalg.norm(residual))]
    base = _predicted(recording, channel, fitted.problem.record(fitted.theta))
    for number, free in enumerate(fitted.free):
        if acts_on(free.field, channel, group):
            step = STEP if fitted.theta[number] < 0.5 else -STEP
            moved = fitted.theta.copy()
            moved[number] += step
            columns.append(
                (_predicted(recording, channel, fitted.problem.record(moved)) - base) / step)
    ranges = np.array(columns).T * used[:, None]
    energy = ranges.T @ ranges
    ridge = residual @ residual + REGULARISATION * np.trace(energy)
    triangle = np.linalg.cholesky(energy + ridge * np.eye(len(columns)))
    known = np.linalg.solve(triangle, ranges.T).T
    return residual - known @ (known.T @ residual), known


def _target(recording: Recording, channel: str) -> Array:
    """Return the measured output of a channel; of a motion 0, since `_predicted` is its error."""
    if channel not in MOTIONS:
        return measured(recording, channel)
    return np.zeros(recording.fit.size)


def _predicted(recording: Recording, channel: str, p: np.void) -> Array:
    """Return the predicted output; of a motion, its error as an equivalent force on the load."""
    if channel not in MOTIONS:
        return predict(recording, channel, p)
    return simulator.missed_force(recording, in_recording(p, recording.number))


def _used(recording: Recording) -> Array:
    """Return 1 at samples that are used, else 0."""
    return recording.known.astype(float)


def _wave(residual: Array, recording: Recording) -> Values:
    """
    Return frequency (Hz) and phase (turns) of the strongest sine in a residual.

    If the excitation is a few sines, their frequencies are excluded, since a disturbance there
    cannot be separated from a gain error, and so are their harmonics, which come from
    nonlinearities. The trend of a joint that turns on would hide them, and is removed. A line of
    the force counts as excitation only if the fit explains most of it: a control loop answers a
    disturbance with such a line. No line is excluded if one of several holds most of the residual:
    a model error would show in all of them.
    """
    count = 8 * residual.size   # padded: the frequency must be fine enough for the phase
    lobe = 4 * count // residual.size + 1   # width of a sine in these spectra (Hann window)
    power, *driven = (np.abs(np.fft.rfft(signal * np.hanning(residual.size), count)) ** 2
                      for signal in (residual, *map(detrend, _excitation(recording))))
    lowest = count // residual.size   # one wave in the recording
    power[:lowest] = 0.0
    lines = [_lines(each, lobe) for each in driven]
    found = int(np.argmax(power))
    if lines and (not all(lines) or min(map(len, lines)) > 1 and power[
            max(found - lobe // 2, 0):found + lobe // 2 + 1].sum() > SINGLE_WAVE * power.sum()):
        lines = []
    if lines:   # the first are those of the force, in units of the residual
        lines[0] = [line for line in lines[0]
                    if (near := slice(max(line - lobe // 2, 0), line + lobe // 2 + 1))
                    and power[near].sum() < LINE_REMAINDER * driven[0][near].sum()]
    for line in itertools.chain(*lines):
        power[max(line - lobe // 2, 0):line + lobe // 2 + 1] = 0.0
    harmonics = np.array([number for each in lines for number in _harmonics(each)])
    found = int(np.argmax(power))
    while power[found] > 0.0 and np.any(np.abs(harmonics - found) <= lowest / 2):
        power[max(found - lobe // 2, 0):found + lobe // 2 + 1] = 0.0
        found = int(np.argmax(power))
    found = max(found, 1)   # of a residual of zeros
    turns = found / count * np.arange(residual.size)
    phase = np.angle(np.sum(residual * np.exp(-2j * np.pi * turns))) / (2.0 * np.pi) - 0.25
    if recording.motion is None:   # it adds to the output; a force on a load lowers its output
        phase += 0.5
    return {'residual_frequency': found / (count * recording.period_s),
            'residual_phase': 1.0 + phase % 1.0}


def _phase_of_push(fitted: Fitted, recording: Recording, residual: Array, known: Array,
                   frequency: float) -> Values:
    """
    Return the phase (turns, 1 to 2) of the push of that frequency (Hz) that explains a residual.

    By its simulated response: the phase that the residual itself has is that of a push on a
    rigid load, and beside a compliance the sign may be the other one. Nothing if the
    simulation overflows. residual, known: as `_deflated_residual` returns them.
    """
    p = copy_of(in_recording(fitted.problem.record(fitted.theta), recording.number))
    base, used = simulator.missed_force(recording, p), _used(recording)
    p['load_external_force_frequency'] = frequency
    p['load_external_force'] = 2.0 * np.abs(np.mean(residual * np.exp(
        -2j * np.pi * frequency * recording.period_s * np.arange(residual.size))))
    moved = np.empty((residual.size, 2))
    for column, phase in enumerate((0.0, 0.25)):
        p['load_external_force_phase'] = phase
        change = (simulator.missed_force(recording, p) - base) * used
        moved[:, column] = change - known @ (known.T @ change)
    if not np.isfinite(moved).all():
        return {}
    sine, cosine = np.linalg.lstsq(moved, residual, rcond=None)[0]
    return {'residual_phase': 1.0 + float(np.arctan2(cosine, sine) / (2.0 * np.pi)) % 1.0}


def _excitation(recording: Recording) -> tuple[Array, ...]:
    """Return the force (N) and the position (m) of a load; nothing of a characteristic."""
    motion, force = recording.motion, recording.force_judged
    if motion is None or force is None:
        return ()
    return force, motion.position[motion.inner]


def _lines(power: Array, lobe: int) -> list[int]:
    """Return the bins of an excitation by at most MOST_LINES sines, otherwise none."""
    rest, total, lines = power.copy(), power.sum(), []
    for _ in range(MOST_LINES):
        near = np.convolve(rest, np.ones(lobe), 'same')
        line = int(np.argmax(near))
        if near[line] < LINE_POWER * total:
            break
        lines.append(line)
        rest[max(line - lobe // 2, 0):line + lobe // 2 + 1] = 0.0
    return lines if rest.sum() < (1.0 - LINES_POWER) * total else []


def _harmonics(lines: list[int]) -> list[int]:
    """Return the bins of intermodulation products up to ORDER, without the lines themselves."""
    times = itertools.product(range(-ORDER, ORDER + 1), repeat=len(lines))
    return [abs(sum(n * line for n, line in zip(each, lines, strict=True))) for each in times
            if 1 < sum(map(abs, each)) <= ORDER]


def _pulse(residual: Array, used: Array, known: Array, raw: Array, period: float) -> Values:
    """
    Return start and end (s) of the rectangular pulse that explains most of a residual.

    residual: without what the parameters could explain; 0 where `used` is 0; known: the matrix of
    `_deflated_residual`; raw: the residual itself. One value or row for each sample.
    """
    sums, length = (np.concatenate([[0.0], np.cumsum(each)]) for each in (residual, used))
    parts = np.concatenate([np.zeros((1, known.shape[1])), np.cumsum(known, axis=0)])

    def strongest(corners: npt.NDArray[np.int_]) -> tuple[int, int]:
        product = parts[corners] @ parts[corners].T
        square = np.diag(product)   # |a - b|^2 = |a|^2 + |b|^2 - 2 a b
        size = np.abs(np.subtract.outer(length[corners], length[corners])) - (
            np.add.outer(square, square) - 2.0 * product)
        explained = np.triu(np.subtract.outer(sums[corners], sums[corners]) ** 2
                            / np.maximum(size, 1.0), 1)
        first, last = divmod(int(np.argmax(explained)), corners.size)
        return int(corners[first]), int(corners[last])

    corners = np.linspace(0, residual.size, PULSE_GRID + 1).astype(int)
    start, end = strongest(corners)
    reach = int(corners[1])
    while reach > 0:   # refine between the neighbouring corners
        near = np.linspace(-reach, reach, 2 * min(reach, REFINEMENT) + 1).astype(int)
        start, end = strongest(np.unique(np.clip([start + near, end + near], 0, residual.size)))
        reach //= REFINEMENT
    # A step until the end differs from a pulse before it by a constant only: then the residual
    # itself decides.
    here, then = raw[start:end], raw[end:]
    if 20 * start < residual.size and then.size and abs(then.mean()) > abs(here.mean()):
        start, end = end, residual.size
    return {'residual_start': max(start, 1) * period, 'residual_end': max(end, 1) * period}


def _steps(fitted: Fitted, channel: str) -> Values:
    """Return the command quantum (N) that explains most of a residual, by kind of rounding."""
    recording = max((r for r in fitted.problem.group.recordings if r.fit.any()),
                    key=lambda r: float(np.abs(r.input).max()))
    p = fitted.record
    command = recording.input
    own = simulator.of_simulator(p)
    band, bias = ((p['valve_flexure_deadband'], p['valve_flexure_bias']) if own else
                  (p['command_deadband'], p['command_bias']))
    residual, known = _deflated_residual(fitted, channel, recording)
    count = next_fast_len(command.size + _response_samples(recording), real=True)
    response = _response(recording, p, count)
    # At each sample: the inner product of the residual with the response to 1 N of command.
    gain_by_sample = np.fft.irfft(
        np.conj(response) * np.fft.rfft(residual, count), count)[:command.size]
    largest = float(np.abs(command).max())
    used = _used(recording)

    def gain(counts: Array, levels: Array, phase: float) -> Array:
        values, level = np.unique(levels, return_inverse=True)
        out = np.empty(counts.size)
        step_gain(values, np.bincount(level, used), np.bincount(level, gain_by_sample),
                  largest / counts, phase, band, bias, out)
        return out

    def exact_gain(steps: float, phase: float) -> float:
        # With the response itself, without what the fitted parameters explain of it.
        quantum = largest / steps
        stepped = quantum * (np.floor(command / quantum + 0.5 - phase) + phase)
        driven, plain = (drive - np.clip(drive, -band, band)
                         for drive in (stepped + bias, command + bias))
        change = driven - plain
        moved = used * np.fft.irfft(response * np.fft.rfft(change, count), count)[:command.size]
        moved -= known @ (known.T @ moved)
        return max(float(residual @ moved), 0.0) ** 2 / max(float(moved @ moved), 1e-300)

    few_levels = np.unique(command).size <= BINS
    width = 2.0 * largest / BINS
    found = {}
    for form in _quantisations(fitted.problem.group):
        name = form.free[0].scale
        levels = command if few_levels else width * np.round(command / width)
        coarse = gain(STEPS, levels, QUANTISERS[name])
        peaks, _ = find_peaks(coarse)
        few = np.array([exact_gain(each, QUANTISERS[name]) for each in FEW_STEPS])
        steps = np.concatenate([STEPS[peaks[np.argsort(-coarse[peaks])[:PEAKS]]],
                                FEW_STEPS[np.argsort(-few)[:MORE]]])

        def gained(each: float, form: Variant = form) -> float:
            return -_left_with(fitted, channel, recording, form, largest / each)

        def best_of(several: Array, gained: Callable[[float], float] = gained) -> float:
            return float(several[np.argmax(list(in_threads(gained, several)))])

        alone, best = gained(math.inf), best_of(steps)
        nearby = best + FINE_STEPS
        gains = gain(nearby, command, QUANTISERS[name])
        # With few levels neighbouring quanta are equivalent until one level changes.
        finer = float(nearby[gains >= EQUIVALENT * gains.max()].mean())
        if gained(finer) - alone < 0.5 * (gained(best) - alone):
            finer = best_of(best * NEARBY)
        found[name] = largest / finer
    return found


def _quantisations(group: Group) -> Iterable[Variant]:
    """Return the first form of a quantised command that begins with each guess of the quantum."""
    forms = group.effects.get('command_quantisation', ())
    return {form.free[0].scale: form for form in reversed(forms)
            if form.free[0].scale in QUANTISERS}.values()


def _left_with(fitted: Fitted, channel: str, recording: Recording, form: Variant, quantum: float
               ) -> float:
    """Return the square sum of a channel's residual if the command is in steps of `quantum` N."""
    p = fitted.problem.record(fitted.theta)   # with the sub-step of the fit
    for name, value in (*form.fixed, (form.free[0].field, quantum)):
        p[name] = value
    left = (_target(recording, channel) - _predicted(recording, channel, p)) * _used(recording)
    return float(left @ left)


def _static_steps(fitted: Fitted) -> Values:
    """
    Return quantum (input's unit) and phase (turns, 1 to 2) of a quantised input.

    A quantiser leaves a sawtooth over the input: its period is that of the strongest line in the
    spectrum of the residual over the input.
    """
    places: dict[bool, list[Array]] = {True: [], False: []}
    lefts: dict[bool, list[Array]] = {True: [], False: []}
    for recording in fitted.problem.group.recordings:
        if recording.fit.any() and recording.command is not None:
            residual, _ = _deflated_residual(fitted, 'static', recording)
            for way in (True, False):
                those = recording.known & ((np.gradient(recording.command) > 0.0) == way)
                places[way].append(recording.command[those])
                lefts[way].append(residual[those])
    # Rising and falling input separately, since a lag or hysteresis shifts them.
    ways = [(np.concatenate(places[way]), np.concatenate(lefts[way])) for way in (True, False)]
    every = np.concatenate([place for place, _ in ways])
    low, span = float(every.min()), float(np.ptp(every))
    count = 8 * STATIC_BINS
    power = np.zeros(count // 2 + 1)
    for place, left in ways:
        level = ((place - low) / span * STATIC_BINS).astype(int)
        sums = np.bincount(np.minimum(level, STATIC_BINS - 1), left, STATIC_BINS)
        power += np.abs(np.fft.rfft(sums, count)) ** 2
    power[:8 * 2] = 0.0   # at least two steps over the range
    quantum = span * 8.0 / max(int(np.argmax(power[:count // 4])), 1)
    # q round(u / q - phase) + q phase - u is -sin(2 pi (u / q - phase)) / pi and its harmonics.
    angle = np.angle(sum(np.sum(left * np.exp(-2j * np.pi * place / quantum))
                         for place, left in ways))
    quarter = math.copysign(0.5 * np.pi, float(fitted.record['gain']))
    return {'residual_step': quantum,
            'residual_step_phase': 1.0 + (quarter - angle) / (2.0 * np.pi) % 1.0}


def _response_samples(recording: Recording) -> int:
    """Return the length of the valve's step response in samples, at least 2."""
    return max(int(RESPONSE_S / recording.period_s), 2)


def _response(recording: Recording, p: np.void, count: int) -> Complex:
    """Return the linear frequency response of the valve to its command (as `rfft` of `count`)."""
    linear = p.copy()
    if simulator.of_simulator(p):
        return simulator.valve_response(recording, p, _response_samples(recording), count)
    for name in ('valve_hysteresis_model', 'loop_width', 'command_deadband', 'command_bias',
                 'command_quantum', 'valve_limit', 'servo_limited'):
        linear[name] = 0
    step = np.zeros((2, _response_samples(recording)))
    step[0, 1:] = 1.0
    blocks.valve(step[0], *blocks.parts(linear), recording.period_s, recording.sub_steps(1e-3),
                 step[1], blocks.AT_REST)
    return np.fft.rfft(np.diff(step[1], append=step[1, -1]), count)


@jit
def step_gain(values, counts, sums, quanta, phase, band, bias, out):
    """
    Put into `out` how much of the residual's energy rounding to each quantum (N) could explain.

    Rounding is correlated with the residual; what a gain or an offset of the command explains is
    left out. values: m commands (N); counts: number of samples of each; sums: the inner product
    of the residual with the response to 1 N, over these samples.
    """
    plain, total, mean, square = np.empty(values.size), 0.0, 0.0, 0.0
    for i in range(values.size):
        plain[i] = dead_zone(values[i] + bias, band)
        total += counts[i]
        mean += counts[i] * plain[i]
    mean /= total
    for i in range(values.size):
        square += counts[i] * (plain[i] - mean) ** 2
    for k in range(quanta.size):
        even, along, size, product = 0.0, 0.0, 0.0, 0.0
        for i in range(values.size):
            stepped = in_steps(values[i], quanta[k], phase, 0.0) + bias
            change = dead_zone(stepped, band) - plain[i]
            even += counts[i] * change
            along += counts[i] * change * (plain[i] - mean)
            size += counts[i] * change * change
            product += sums[i] * change
        size -= even * even / total + along * along / max(square, 1e-300)
        out[k] = max(product, 0.0) ** 2 / max(size, 1e-3 * total * quanta[k] ** 2)
