"""
Where to begin with effects that a fit finds only from nearby: seen in what another fit leaves.

A disturbance (how often, from when to when) and the steps of a command. What the parameters that
are fitted already could do as well is taken away first, so that it hides nothing.
"""

import itertools

import numpy as np
import numpy.typing as npt
from scipy.fft import next_fast_len

from asi_analysis.gap.inference.fit import STEP, Fitted
from asi_analysis.gap.model import blocks
from asi_analysis.gap.model.effects import of_recording
from asi_analysis.gap.model.group import Values, acts_on
from asi_analysis.gap.model.predict import measured, predict
from asi_analysis.gap.prepare import Array, Recording

Complex = npt.NDArray[np.complexfloating]

CORNERS = 400      # places in a recording where a pulse is looked for to begin or end
FINER = 50         # how often nearer, each time that they are looked for again
# Steps of a command: how many its largest value has, looked for first in a command whose levels
# are put into bins, unless they are few, then nearby, more finely.
STEPS = np.arange(2.0, 60.0, 0.02)
NEARBY = np.linspace(-0.1, 0.1, 101)
BINS, ALIKE = 1000, 0.99
# How they may lie: command_phase and command_truncated.
WAYS = {'residual_step': (0.0, 0.0), 'residual_step_edge': (0.5, 0.0),
        'residual_step_zero': (0.0, 1.0)}
FREE = 1e3         # times what is left: the range of an offset, which may be anything
# An excitation of at most LINES waves, which hold DRIVEN of the power of the force or the motion;
# one of them holds at least LINE of either.
LINES, LINE, DRIVEN = 3, 0.1, 0.8
ORDER = 3          # of harmonics that what is not linear is seen by
RESPONSE_S = 0.2   # after which a valve has answered


def initial_guesses(fitted: Fitted) -> Values:
    """
    Return initial guesses of the parameters that a fit finds only from nearby.

    Of each recording: residual_frequency, residual_phase: of the strongest wave in the load, Hz
    and turns (1 to 2); residual_start, residual_end: of its strongest pulse, s. Of the first:
    residual_step, residual_step_edge, residual_step_zero: of the command (N) with a step's middle
    at zero, with an edge there, cut off towards zero.
    """
    group = fitted.problem.group
    found: Values = {}
    for recording in group.recordings if 'load' in group.channels else ():
        if not recording.fit.any():
            continue
        left, known = _left(fitted, 'load', recording)
        plain = measured(recording, 'load') - predict(recording, 'load', fitted.record)
        own = _wave(left, recording) | _pulse(left, _judged(recording), known, plain,
                                              recording.period_s)
        found |= {of_recording(name, recording.number): value for name, value in own.items()}
    for channel in group.channels:
        if channel == 'valve' or channel == 'force' and not group.measures_valve:
            found |= _steps(fitted, channel)
    return found


def _left(fitted: Fitted, channel: str, recording: Recording) -> tuple[Array, Array]:
    """
    Return what a fit leaves of a channel (n samples) less what its parameters could take of it.

    And n x m numbers whose products with any n samples tell, squared, how much they could take of
    those. Of a parameter whose whole range changes less than is left, that is little: it may not
    go further, however alike the two look.
    """
    group = fitted.problem.group
    base = predict(recording, channel, fitted.record)
    judged = _judged(recording)
    left = (measured(recording, channel) - base) * judged
    columns = [np.full_like(base, FREE * np.linalg.norm(left))]
    for number, free in enumerate(fitted.free):
        if acts_on(free.field, channel, group):
            step = STEP if fitted.theta[number] < 0.5 else -STEP
            moved = fitted.theta.copy()
            moved[number] += step
            columns.append(
                (predict(recording, channel, fitted.problem.record(moved)) - base) / step)
    ranges = np.array(columns).T * judged[:, None]
    triangle = np.linalg.cholesky(ranges.T @ ranges + left @ left * np.eye(len(columns)))
    known = np.linalg.solve(triangle, ranges.T).T
    return left - known @ (known.T @ left), known


def _judged(recording: Recording) -> Array:
    """Return 1 where a recording is judged, else 0: at the ends what is made up is strongest."""
    return recording.known.astype(float)


def _wave(left: Array, recording: Recording) -> Values:
    """
    Return frequency (Hz) and phase (turns) of the strongest wave in what is left.

    Not one of the few at which nearly all of the force or of the motion is: a force that moves
    nothing, or too much, is not told there from another that works against it. Nor their
    harmonics: what happens to be there is what is not linear.
    """
    count = 8 * left.size   # padded, for a frequency as fine as the wave's phase at the end
    lobe = 4 * count // left.size + 1   # as wide as a wave is in these spectra
    motion = recording.motion
    assert motion is not None
    moved = motion.position[motion.pad:motion.pad + left.size]
    power, *driven = (np.abs(np.fft.rfft(signal * np.hanning(left.size), count)) ** 2
                      for signal in (left, *(each - each.mean() for each in (
                          measured(recording, 'load'), moved))))
    lowest = count // left.size   # one wave in the recording
    power[:lowest] = 0.0
    lines = [_lines(each, lobe) for each in driven]
    for line in itertools.chain(*lines):
        power[max(line - lobe // 2, 0):line + lobe // 2 + 1] = 0.0
    harmonics = np.array([number for each in lines for number in _harmonics(each)])
    found = int(np.argmax(power))
    while power[found] > 0.0 and np.any(np.abs(harmonics - found) <= lowest / 2):
        power[max(found - lobe // 2, 0):found + lobe // 2 + 1] = 0.0
        found = int(np.argmax(power))
    turns = found / count * np.arange(left.size)
    phase = np.angle(np.sum(left * np.exp(-2j * np.pi * turns))) / (2.0 * np.pi) - 0.25
    return {'residual_frequency': found / (count * recording.period_s),
            'residual_phase': 1.0 + phase % 1.0}


def _lines(power: Array, lobe: int) -> list[int]:
    """Return where the waves of an excitation are that is made of a few; none if it is not."""
    rest, total, lines = power.copy(), power.sum(), []
    for _ in range(LINES):
        near = np.convolve(rest, np.ones(lobe), 'same')
        line = int(np.argmax(near))
        if near[line] < LINE * total:
            break
        lines.append(line)
        rest[max(line - lobe // 2, 0):line + lobe // 2 + 1] = 0.0
    return lines if rest.sum() < (1.0 - DRIVEN) * total else []


def _harmonics(lines: list[int]) -> list[int]:
    """Return the sums and differences of up to ORDER frequencies, but for themselves."""
    times = itertools.product(range(-ORDER, ORDER + 1), repeat=len(lines))
    return [abs(sum(n * line for n, line in zip(each, lines, strict=True))) for each in times
            if 1 < sum(map(abs, each)) <= ORDER]


def _pulse(left: Array, judged: Array, known: Array, plain: Array, period: float) -> Values:
    """
    Return from when to when (s) a pulse explains most: its square over its length.

    left, judged, known, plain: of each sample; where it is not judged nothing is left.
    """
    sums, length = (np.concatenate([[0.0], np.cumsum(each)]) for each in (left, judged))
    parts = np.concatenate([np.zeros((1, known.shape[1])), np.cumsum(known, axis=0)])

    def strongest(corners: npt.NDArray[np.int_]) -> tuple[int, int]:
        between = parts[corners][:, None] - parts[corners][None]
        size = np.abs(np.subtract.outer(length[corners], length[corners])) - np.sum(
            between ** 2, axis=2)
        explained = np.triu(np.subtract.outer(sums[corners], sums[corners]) ** 2
                            / np.maximum(size, 1.0), 1)
        first, last = divmod(int(np.argmax(explained)), corners.size)
        return int(corners[first]), int(corners[last])

    corners = np.linspace(0, left.size, CORNERS + 1).astype(int)
    start, end = strongest(corners)
    reach = int(corners[1])
    while reach > 0:   # to the corners beside them, ever more finely
        near = np.linspace(-reach, reach, 2 * min(reach, FINER) + 1).astype(int)
        start, end = strongest(np.unique(np.clip([start + near, end + near], 0, left.size)))
        reach //= FINER
    # What begins and stays is, but for a constant, what is there until then: plainly it is not.
    here, then = plain[start:end], plain[end:]
    if 20 * start < left.size and then.size and abs(then.mean()) > abs(here.mean()):
        start, end = end, left.size
    return {'residual_start': max(start, 1) * period, 'residual_end': end * period}


def _steps(fitted: Fitted, channel: str) -> Values:
    """Return the steps of the command that explain most, in each way that they may lie."""
    recording, p = fitted.problem.group.recordings[0], fitted.record
    command = recording.command
    assert command is not None
    left, _ = _left(fitted, channel, recording)
    count = next_fast_len(command.size + _response_samples(recording), real=True)
    # What a step of one newton explains, when it comes: the product with the valve's answer to it.
    asked = np.fft.irfft(np.conj(_response(recording, p, count)) * np.fft.rfft(left, count),
                         count)[:command.size]
    largest = float(np.abs(command).max())
    judged = _judged(recording)

    def promise(counts: Array, levels: Array, way: tuple[float, float]) -> Array:
        values, level = np.unique(levels, return_inverse=True)
        out = np.empty(counts.size)
        blocks.step_gain(values, np.bincount(level, judged), np.bincount(level, asked),
                             largest / counts, *way, blocks.parts(p)[1], out)
        return out

    few = np.unique(command).size <= BINS
    width = 2.0 * largest / BINS
    found = {}
    for name, way in WAYS.items():
        roughly = promise(STEPS, command if few else width * np.round(command / width), way)
        nearby = STEPS[np.argmax(roughly)] + NEARBY
        gains = promise(nearby, command, way)
        # Where a command has few levels, all that are near are alike until one level jumps.
        found[name] = largest / float(nearby[gains >= ALIKE * gains.max()].mean())
    return found


def _response_samples(recording: Recording) -> int:
    """Return in how many samples a valve has answered; at least the step and one after it."""
    return max(int(RESPONSE_S / recording.period_s), 2)


def _response(recording: Recording, p: np.void, count: int) -> Complex:
    """Return the valve's frequency response to its command, all that is not linear left out."""
    plain = p.copy()
    for name in ('valve_hysteresis_model', 'loop_width', 'command_deadband', 'command_bias',
                 'command_quantum', 'valve_limit'):
        plain[name] = 0
    step = np.zeros((2, _response_samples(recording)))
    step[0, 1:] = 1.0
    blocks.valve(step[0], *blocks.parts(plain), recording.period_s, recording.sub_steps(1e-3),
                 step[1])
    return np.fft.rfft(np.diff(step[1], append=step[1, -1]), count)
