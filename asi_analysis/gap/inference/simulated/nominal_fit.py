"""The fit of the nominal model: of its uncertain parameters, shapes of laws and initial states."""

import math
from collections.abc import Iterator
from dataclasses import replace

from asi_analysis.arrays import Array
from asi_analysis.gap.inference.posterior import (
    FAR,
    ODDS_AGAINST,
    ROUGHLY,
    ROUNDS,
    Posterior,
    most_probable,
)
from asi_analysis.gap.inference.simulated.fits import converged
from asi_analysis.gap.inference.simulated.found import Found
from asi_analysis.gap.model.effects import DOTTED, PARAMETER, Effects, Free, Variant
from asi_analysis.gap.model.group import Group, with_fitted_start
from asi_analysis.gap.model.simulator import VALVE_ERROR
from asi_analysis.gap.model.start import SEAL

SEAL_STARTS = (0.15, 0.85)   # initial guesses of the seals' deflection, as shares of its range


def null_fit(group: Group) -> Found:
    """Return the fit of the nominal model: of its uncertain parameters and initial states."""
    return with_start_of_fit(to_the_end(rough_null_fit(group)))


def rough_null_fit(group: Group) -> Found:
    """Return `null_fit`, roughly converged."""
    group = replace(group, effects=group.effects | parameter_errors(group),
                    scale=dict(group.scale))
    problem = Posterior(group, group.nuisance)
    first = min((most_probable(problem, start, rounds=2) for start in _start_guesses(problem)),
                key=lambda best: best.cost)
    return Found((), (), problem, most_probable(
        problem, first.theta, rounds=2 * ROUNDS, converged=ROUGHLY, near=first))


def to_the_end(null: Found) -> Found:
    """Return a rough fit of the nominal model, converged unless it explains nothing anyway."""
    if null.best.cost >= FAR * null.largest_cost:
        return null
    return converged(null._replace(best=most_probable(
        null.problem, null.best.theta, rounds=2 * ROUNDS, converged=0.0, near=null.best)))


def with_start_of_fit(null: Found) -> Found:
    """Return a fit from which on recordings that start in motion have its initial states."""
    return null._replace(best=null.best._replace(slopes=None), problem=replace(
        null.problem, group=with_fitted_start(
            null.problem.group, null.problem.record(null.best.theta))))


def hides_an_effect(null: Found) -> bool:
    """Return whether the nominal model leaves a residual, or its parameters are improbable."""
    return null.unexplained or null.prior_cost > ODDS_AGAINST


def _start_guesses(problem: Posterior) -> Iterator[Array]:
    """Yield nominal parameters, with guesses of the shapes of laws and of initial states."""
    mean = problem.nominal
    yield mean
    started = [n for n, free in enumerate(problem.free) if free.scale != 'nominal'
               and not free.field.startswith(VALVE_ERROR)]
    if not started:
        return
    alone = replace(problem, free=tuple(problem.free[n] for n in started))
    begun = mean.copy()
    begun[started] = most_probable(alone, alone.prior[0]).theta
    yield begun
    seals = [n for n in started if problem.free[n].field.startswith(SEAL)]
    for share in SEAL_STARTS if seals else ():
        begun = mean.copy()
        begun[seals] = share
        yield begun


def parameter_errors(group: Group) -> Effects:
    """Return the hypotheses that a nominal parameter is beyond its tolerance."""
    held = {free.field for forms in group.effects.values() for form in forms
            for free in form.free if free.scale == 'nominal'}
    return {PARAMETER + DOTTED[free.field]: (Variant((
        Free(free.field, 0.1, 10.0, (0.5, 0.7, 1.5, 2.2), 'nominal'),)),)
        for free in group.nuisance
        if free.prior < math.inf and free.scale == 'nominal' and free.field not in held}
