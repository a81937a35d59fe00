"""
A transport delay that differs from period to period, as of a bus or a network with other traffic.

After each jump of the command such a valve differs from one with a constant delay by far more than
noise. What arrives in a period, less what would arrive after the mean delay, is noise of the
command, independent from period to period; its variance is that of the command over all delays
that are possible. Errors of the valve position are made white with the covariance of this noise,
as the valve passes it on, and of the sensor's: generalised least squares (Ljung, System
Identification, 2nd ed., 7.3).
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.linalg import cholesky_banded

from asi_analysis.arrays import Array
from asi_analysis.gap.inference.hypotheses import Candidate
from asi_analysis.gap.inference.posterior import Posterior
from asi_analysis.gap.inference.probability import Names
from asi_analysis.gap.inference.simulated.fits import refitted_as, with_usual_parameters
from asi_analysis.gap.inference.simulated.formulation import COST_RANGE
from asi_analysis.gap.inference.simulated.found import Found
from asi_analysis.gap.model.predict import measured, predict
from asi_analysis.gap.model.simulator import DELAYS, SPREAD, of_simulator, pulse_response
from asi_analysis.gap.prepare import Recording, first_of_recording
from asi_analysis.gap.sampling import whitened_by

EFFECT, (COMMAND, FLEXURE) = 'transport_delay', DELAYS
# Half widths that are tried, as shares of the mean delay, and delays within a width.
WIDTHS, SHARES = np.geomspace(0.02, 1.0, 18), np.linspace(-1.0, 1.0, 33)
# The pulse response of the valve ends with this share of its peak, or after so many samples.
TAIL, MOST_TAPS = 3e-3, 256
CUTS = 2   # of a period, in which what arrives counts as constant
SAMPLES = 2 ** 14   # samples of a recording by which the width is found
ROUNDS = 3             # fits with another width


def with_uneven_delay(found: Mapping[Names, Found]) -> dict[Names, Found]:
    """
    Return hypotheses; where all leave more than noise, that of a delay with an uneven one instead.

    Only if with it a delay is so much more probable that no other hypothesis counts.
    """
    late, even = found.get((EFFECT,)), min(found.values(), key=lambda each: each.best.cost)
    if (late is None or not all(each.unexplained for each in found.values())
            or late.problem.group.channels != ('valve',)
            or any(recording.colour for recording in late.problem.group.recordings)):
        return dict(found)
    # Taken for noise of the sensor, the errors would move the nominal parameters.
    late = with_usual_parameters(_of_command(late).refined())
    for _ in range(ROUNDS):
        width = _width(late)
        group, p = late.problem.group, late.problem.record(late.best.theta)
        factors = [covariance_factor(r, p, width, group.error_floor['valve'])
                   for r in group.recordings]
        late = refitted_as(late, _with(late, factors, width))
    volume = sum(float(np.log(factor[r.known, 0]).sum())
                 for factor, r in zip(factors, group.recordings, strict=True))
    beyond_doubt = late.best.cost + volume < even.best.cost - COST_RANGE
    return dict(found) | ({(EFFECT,): late} if beyond_doubt else {})


def how_uneven(best: Candidate) -> str | None:
    """Return the note on the uneven delay of the most probable hypothesis; None without."""
    p = best.fitted.record
    if EFFECT not in best.names or not of_simulator(p) or not p[SPREAD] > 0.0:
        return None
    return (f'the delay of the command differs from period to period: by about '
            f'{1e3 * float(p[SPREAD]):.2g} ms either way')


def _of_command(found: Found) -> Found:
    """Return a hypothesis whose delay is all of the command, of which a part may be uneven."""
    problem, p = found.problem, found.problem.record(found.best.theta)
    effect = next(each for each in problem.group.effects if each.name == EFFECT)
    form = next(each for each in effect.variants if each.free[0].field == COMMAND)
    numbers = [number for number, free in enumerate(problem.free) if free.field == FLEXURE]
    if form in found.variants or not numbers:
        return found
    nominal = float(problem.group.nominal[FLEXURE])
    free, theta = list(problem.free), found.best.theta.copy()
    free[numbers[0]] = form.free[0]
    problem = replace(problem, free=tuple(free), fixed=(*problem.fixed, (FLEXURE, nominal)))
    theta[numbers[0]] = problem.parameter(form.free[0]).share(
        max(float(p[FLEXURE]) - nominal, 0.0))
    variants = tuple(form if any(each.field == FLEXURE for each in variant.free) else variant
                     for variant in found.variants)
    return found._replace(variants=variants, problem=problem, best=found.best._replace(
        slopes=None)).at(theta)


def _with(found: Found, factors: Sequence[Array], width: float) -> Posterior:
    """Return the problem of a hypothesis with an uneven delay."""
    group = found.problem.group
    fixed = dict(found.problem.fixed) | {SPREAD: width}
    return replace(found.problem, fixed=tuple(fixed.items()), group=replace(group, recordings=[
        replace(r, uneven_delay=factor) for r, factor in zip(
            group.recordings, factors, strict=True)]))


def _width(found: Found) -> float:
    """Return the most likely half width (s) of the delay of a fit."""
    group, p = found.problem.group, found.problem.record(found.best.theta)
    unlikely, widths = np.zeros(WIDTHS.size), WIDTHS * float(p[COMMAND])
    for recording in group.recordings:
        error = measured(recording, 'valve') - predict(recording, 'valve', p)
        part = first_of_recording(recording, SAMPLES / recording.fit.size)
        for number, width in enumerate(widths):
            factor = covariance_factor(part, p, width, group.error_floor['valve'])
            white = whitened_by(factor, error[:part.fit.size], part.valid)[part.valid]
            unlikely[number] += 0.5 * float(white @ white) / group.error_floor['valve'] + float(
                np.log(factor[part.valid, 0]).sum())
    return float(widths[np.argmin(unlikely)])


def covariance_factor(recording: Recording, p: np.void, width: float, variance: float) -> Array:
    """
    Return the factor of the covariance of the valve's errors, over that of the sensor's noise.

    As `whitened_by` takes it. p: record of the valve; width: half of the range of the delay, s;
    variance: of the sensor's noise, m2.
    """
    period = recording.period_s
    pulse = pulse_response(p, period / CUTS, CUTS * MOST_TAPS)
    last = np.flatnonzero(np.abs(pulse) > TAIL * np.abs(pulse).max())[-1] // CUTS
    # What arrives in a period shows in the sample after it, soonest what arrives at its end.
    pulses = pulse[:CUTS * (last + 1)].reshape(-1, CUTS)[:, ::-1].T
    arriving = _covariance(recording, _delay(p), width)
    length = next_fast_len(recording.fit.size + last, real=True)
    driven = rfft(arriving, length)
    bands = np.zeros((last + 1, recording.fit.size))
    for band in range(last + 1):   # the errors of samples that are so far apart
        products = rfft(pulses[:, None, :last + 1 - band] * pulses[None, :, band:], length)
        bands[band, 1:] = irfft((driven * products).sum(axis=(0, 1)),
                                length)[:recording.fit.size - 1]
    bands /= variance
    bands[0] += 1.0
    return np.ascontiguousarray(cholesky_banded(bands, lower=True).T)


def _delay(p: np.void) -> float:
    """Return the whole delay (s) of the command."""
    return sum(float(p[name]) for name in DELAYS)


def _covariance(recording: Recording, delay: float, width: float) -> Array:
    """Return the covariance (N2) of what arrives in the cuts of each period, (CUTS, CUTS, n)."""
    command = recording.command
    assert command is not None
    at = np.arange(command.size) + (np.arange(CUTS)[:, None, None] + 0.5) / CUTS
    sent = np.floor(at - (delay + width * SHARES[:, None]) / recording.period_s)
    arrived = command[np.clip(sent, 0, None).astype(int)]
    arrived -= arrived.mean(axis=1, keepdims=True)
    return np.einsum('isn,jsn->ijn', arrived, arrived) / SHARES.size
