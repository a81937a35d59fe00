"""
A transport delay that differs from period to period, as of a bus or a network with other traffic.

After each jump of the command such a valve differs from one with a constant delay by far more than
noise. What arrives in a period is the command at a random moment of a range, independent of other
periods; its mean and covariance over this range pass through the linearised valve. Errors of the
valve position are taken from that mean, and made white with that covariance and the noise of the
sensor: generalised least squares (Ljung, System Identification, 2nd ed., 7.3).
"""

from collections.abc import Sequence
from dataclasses import replace
from operator import attrgetter
from typing import NamedTuple

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.linalg import cholesky_banded
from scipy.optimize import minimize_scalar

from asi_analysis.arrays import Array
from asi_analysis.gap.inference.coloured_noise import is_white, not_white
from asi_analysis.gap.inference.hypotheses import Candidate
from asi_analysis.gap.inference.posterior import Posterior
from asi_analysis.gap.inference.probability import Names
from asi_analysis.gap.inference.simulated.fits import (
    refitted_as,
    with_fine_substeps,
    with_usual_parameters,
)
from asi_analysis.gap.inference.simulated.found import COST_RANGE, Found
from asi_analysis.gap.model.predict import judged_error, measured, predict
from asi_analysis.gap.model.simulator import DELAYS, SPREAD, of_simulator, pulse_response
from asi_analysis.gap.prepare import Recording, first_of_recording
from asi_analysis.gap.sampling import whitened_by

EFFECT, (COMMAND, FLEXURE) = 'transport_delay', DELAYS
# Half widths with which a fit is repeated, and how far about the best its width is refined; shares
# of the mean delay. Delays within a width.
WIDTHS, ABOUT, SHARES = (0.05, 0.12, 0.3, 0.8), 3.0, np.linspace(-1.0, 1.0, 33)
# The pulse response of the valve ends with this share of its peak, or after so many samples.
TAIL, MOST_TAPS = 3e-3, 256
CUTS = 4   # of a period, in which what arrives counts as constant
# The samples of a recording by which the width is refined, and the most that memory allows.
SAMPLES, MOST_SAMPLES = 2 ** 14, 2 ** 17
MOST_HELD = 10   # samples over which a controller that is slower than the recording may hold


class _Late(NamedTuple):
    """A fit with an uneven delay, and its cost with the log volume of the covariance."""

    found: Found
    width: float   # s
    cost: float


def with_uneven_delay(found: dict[Names, Found]) -> dict[Names, Found]:
    """
    Return hypotheses; where all leave more than noise, that of a delay with an uneven one instead.

    Only if that leaves nothing but white noise, with probable nominal parameters, and is so much
    more probable that no other hypothesis counts. The valve position has white noise.
    """
    null, group = found[()], found[()].problem.group
    if group.channels != ('valve',) or not all(each.unexplained for each in found.values()) or (
            not_white(group) or not all(map(_is_suitable, group.recordings))):
        return found
    late = _of_command(found.get((EFFECT,)) or _with_delay(null)).refined()
    late, = with_fine_substeps({(EFFECT,): late}).values()
    # Taken for noise of the sensor, the errors would move the nominal parameters.
    start = with_usual_parameters(late)
    delay = float(start.problem.record(start.best.theta)[COMMAND])
    if delay == 0.0:
        return found
    fits = sorted((_fitted(start, share * delay) for share in WIDTHS), key=attrgetter('cost'))
    even = min(each.best.cost for each in found.values())
    if not fits[0].cost < even - COST_RANGE:
        return found
    # Refined with the parameters of a fit, a width may miss the best: hence of two fits.
    best = min(fits[0], *(_fitted(each.found, _refined_width(each)) for each in fits[:2]),
               key=attrgetter('cost'))
    explains = not best.found.may_lack_an_effect and _leaves_white_noise(best.found)
    return found | ({(EFFECT,): best.found} if explains else {})


def _is_suitable(recording: Recording) -> bool:
    """Return whether each recorded sample of the command is a period of the controller."""
    command = recording.command
    if command is None or recording.fit.size > MOST_SAMPLES:
        return False
    changes = np.flatnonzero(np.diff(command))
    held = int(np.gcd.reduce(np.diff(changes))) if changes.size > 1 else 1
    return not (1 < held <= MOST_HELD and changes.size > 0.5 * command.size / held)


def _leaves_white_noise(found: Found) -> bool:
    """Return whether the errors of the valve, made white, are so in each recording."""
    p = found.problem.record(found.best.theta)
    errors = [judged_error(r, 'valve', p)[r.valid] for r in found.problem.group.recordings]
    return all(is_white(np.abs(np.fft.rfft(each)[1:]) ** 2) for each in errors)


def how_uneven(best: Candidate) -> str | None:
    """Return the note on the uneven delay of the most probable hypothesis; None without."""
    p = best.fitted.record
    if EFFECT not in best.names or not of_simulator(p) or not p[SPREAD] > 0.0:
        return None
    return (f'the delay of the command differs from period to period: by about '
            f'{1e3 * float(p[SPREAD]):.2g} ms either way, at random')


def _with_delay(null: Found) -> Found:
    """Return the nominal model with a delay of the command in addition, not fitted."""
    problem, form = null.problem, null.problem.group.effects[EFFECT][0]
    free, = form.free
    longer = replace(problem, free=(*problem.free, free))
    theta = np.append(null.best.theta, longer.start(free, free.starts[0]))
    return null._replace(names=(EFFECT,), variants=(form,)).moved(longer, theta)


def _of_command(found: Found) -> Found:
    """Return a hypothesis whose delay is all of the command, of which a part may be uneven."""
    problem, p = found.problem, found.problem.record(found.best.theta)
    form = problem.group.effects[EFFECT][0]
    numbers = [number for number, free in enumerate(problem.free) if free.field == FLEXURE]
    if form in found.variants or not numbers:
        return found
    nominal = problem.group.nominal
    delay = max(float(nominal[COMMAND] + p[FLEXURE] - nominal[FLEXURE]), 0.0)
    free, theta = list(problem.free), found.best.theta.copy()
    free[numbers[0]] = form.free[0]
    problem = replace(problem, free=tuple(free), fixed=(
        *problem.fixed, (FLEXURE, float(nominal[FLEXURE]))))
    theta[numbers[0]] = problem.parameter(form.free[0]).share(delay)
    return found._replace(variants=(form,)).moved(problem, theta)


def _fitted(start: Found, width: float) -> _Late:
    """Return a fit with an uneven delay, of half this width (s), from a start."""
    group, p = start.problem.group, start.problem.record(start.best.theta)
    made = [uneven(r, p, width, group.error_floor['valve']) for r in group.recordings]
    found = refitted_as(start, _with(start, made, width))
    volume = sum(float(np.log(factor[r.known, 0]).sum())
                 for (_, factor), r in zip(made, group.recordings, strict=True))
    return _Late(found, width, found.best.cost + volume)


def _with(found: Found, made: Sequence[tuple[Array, Array]], width: float) -> Posterior:
    """Return the problem of a hypothesis with an uneven delay."""
    group = found.problem.group
    fixed = dict(found.problem.fixed) | {SPREAD: width}
    return replace(found.problem, fixed=tuple(fixed.items()), group=replace(group, recordings=[
        replace(r, uneven_mean=mean, uneven_delay=factor) for r, (mean, factor) in zip(
            group.recordings, made, strict=True)]))


def _refined_width(late: _Late) -> float:
    """Return the most likely half width (s) about that of a fit, with its parameters."""
    group, p = late.found.problem.group, late.found.problem.record(late.found.best.theta)
    floor = group.error_floor['valve']
    parts = [first_of_recording(r, SAMPLES / r.fit.size) for r in group.recordings]
    errors = [(measured(r, 'valve') - predict(r, 'valve', p))[:part.fit.size]
              for r, part in zip(group.recordings, parts, strict=True)]

    def unlikely(log_width: float) -> float:
        total = 0.0
        for part, error in zip(parts, errors, strict=True):
            mean, factor = uneven(part, p, float(np.exp(log_width)), floor)
            white = whitened_by(factor, error - mean, part.valid)[part.valid]
            total += 0.5 * float(white @ white) / floor + float(
                np.log(factor[part.valid, 0]).sum())
        return total

    high = max(min(late.width * ABOUT, float(p[COMMAND])), late.width)
    return float(np.exp(minimize_scalar(
        unlikely, bounds=(np.log(late.width / ABOUT), np.log(high)), method='bounded',
        options={'xatol': 0.02, 'maxiter': 12}).x))


def uneven(recording: Recording, p: np.void, width: float, variance: float
           ) -> tuple[Array, Array]:
    """
    Return what an uneven delay makes of the valve's errors (m): mean, and factor of covariance.

    The factor is that of the covariance over the variance of the sensor's noise, as `whitened_by`
    takes it. p: record of the valve; width: half of the range of the delay, s; variance: of the
    sensor's noise, m2.
    """
    period, count = recording.period_s, recording.fit.size
    pulse = pulse_response(p, period / CUTS, CUTS * MOST_TAPS)
    last = np.flatnonzero(np.abs(pulse) >= TAIL * np.abs(pulse).max())[-1] // CUTS
    # What arrives in a period shows in the sample after it, soonest what arrives at its end.
    pulses = pulse[:CUTS * (last + 1)].reshape(-1, CUTS)[:, ::-1].T
    off, varied = _arriving(recording, p, width)
    length = next_fast_len(count + last, real=True)

    def passed(driven: Array, response: Array) -> Array:
        """Return what drives the valve, after responses; summed over their first axes."""
        spectra = (driven * rfft(response, length)).reshape(-1, length // 2 + 1)
        return np.append(0.0, irfft(spectra.sum(axis=0), length)[:count - 1])

    mean, driven = passed(rfft(off, length), pulses), rfft(varied, length)
    bands = np.array([passed(driven, pulses[:, None, :last + 1 - band] * pulses[None, :, band:])
                      for band in range(last + 1)]) / variance   # of errors so far apart
    bands[0] += 1.0
    return mean, np.ascontiguousarray(cholesky_banded(bands, lower=True).T)


def _arriving(recording: Recording, p: np.void, width: float) -> tuple[Array, Array]:
    """
    Return mean and covariance of the command (N) that arrives in the cuts of each period.

    Mean, less what arrives after the mean delay: (CUTS, n); covariance: (CUTS, CUTS, n).
    """
    command = np.clip(recording.input, -p['command_limit'], p['command_limit'])
    delay = sum(float(p[name]) for name in DELAYS)
    width = min(width, float(p[COMMAND]))
    at = np.arange(command.size) + (np.arange(CUTS)[:, None, None] + 0.5) / CUTS
    delays = np.append(delay + width * SHARES, delay)[:, None]
    sent = np.floor(at - delays / recording.period_s)
    known = np.clip(sent, 0, command.size - 1).astype(int)
    *arrived, even = np.moveaxis(command[known], 1, 0)
    mean = np.mean(arrived, axis=0)
    changes = np.array(arrived) - mean
    return mean - even, np.einsum('sin,sjn->ijn', changes, changes) / SHARES.size
