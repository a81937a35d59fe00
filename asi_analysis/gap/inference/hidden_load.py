"""Gravity or a spring of a joint, or a servo's order, found only together with an effect."""

from collections.abc import Callable, Sequence

from asi_analysis.gap.inference.hypotheses import Candidate, Weighed, weigh_groups
from asi_analysis.gap.inference.probability import marginals
from asi_analysis.gap.model.effects import UNKNOWN
from asi_analysis.gap.model.gravity import ACCEPTED_RESIDUAL
from asi_analysis.gap.model.group import Group
from asi_analysis.gap.model.joint import Extent

ABOVE_NOISE = 1.5   # multiple of the noise variance below which a servo is explained


def with_hidden_load(weighed: list[Weighed], groups: Callable[[Extent], Sequence[Group]],
                     extent: Extent, tick: Callable[[], None]
                     ) -> tuple[list[Weighed], list[str], Extent]:
    """
    Return the groups of a joint with what was hidden in every fit, if needed.

    And notes, and their extent. It is gravity or a spring; of a servo, its second order;
    and needed if no effect explains the gap without it, one does with it, and the residual power
    is then below ACCEPTED_RESIDUAL of that before.
    weighed: without it; groups: returns those of another extent.
    """
    without = weighed[-1].group
    channel = without.channels[-1]
    servo = without.floor_by_best and without.channels == ('valve',)
    if without.channels != ('load',) and not servo:
        return weighed, [], extent
    left = _best(weighed[-1]).fitted.held_out[channel]
    if left < (ABOVE_NOISE * without.noise[channel] ** 2 if servo else
               without.error_floor[channel]):
        return weighed, [], extent
    whole = extent._replace(hidden=True)
    group = groups(whole)[-1]
    if len(group.nuisance) == len(without.nuisance):
        return weighed, [], extent
    refitted, = weigh_groups([group], tick)
    best = _best(refitted)
    share = best.fitted.held_out[channel] / left
    unknown = marginals(refitted.probability)[UNKNOWN] > 0.5
    if not best.names or share > ACCEPTED_RESIDUAL or unknown:
        return weighed, [], extent
    what = ('the servo is of second order' if servo else 'the joint has gravity'
            if 'gravity_sine' in best.fitted.values else 'the joint is held by a spring')
    return [*weighed[:-1], refitted], [
        f'{what}, which shows beside an effect only: with it that leaves {100.0 * share:.2g} % of '
        'the power of the error'], whole


def _best(weighed: Weighed) -> Candidate:
    """Return the hypothesis that fits best."""
    return min(weighed.candidates.values(), key=lambda each: each.fitted.cost)
