"""Gravity or a spring of a joint that is found only together with an effect."""

from collections.abc import Callable, Mapping, Sequence

from asi_analysis.gap.inference.hypotheses import Candidate, Weighed, weigh_groups
from asi_analysis.gap.inference.probability import marginals
from asi_analysis.gap.model.effects import UNKNOWN
from asi_analysis.gap.model.gravity import ACCEPTED_RESIDUAL
from asi_analysis.gap.model.group import Group, with_tolerances


def with_hidden_load(weighed: list[Weighed], groups: Callable[[], tuple[Sequence[Group], object]],
                     tolerances: Mapping[str, float], tick: Callable[[], None]
                     ) -> tuple[list[Weighed], list[str]]:
    """
    Return the groups of a joint, with gravity or a spring in every fit if needed; and notes.

    It is needed if no effect explains the gap without it, one does with it, and the residual
    power is then below ACCEPTED_RESIDUAL of that before. weighed: without it; groups: returns
    those with it; tolerances: by field.
    """
    without = weighed[-1]
    if without.group.channels != ('load',):
        return weighed, []
    left = _best(without).fitted.held_out['load']
    if left < without.group.error_floor['load']:
        return weighed, []
    group = with_tolerances(groups()[0][-1], tolerances)
    if len(group.nuisance) == len(without.group.nuisance):
        return weighed, []
    refitted, = weigh_groups([group], tick)
    best = _best(refitted)
    share = best.fitted.held_out['load'] / left
    unknown = marginals(refitted.probability)[UNKNOWN] > 0.5
    if not best.names or share > ACCEPTED_RESIDUAL or unknown:
        return weighed, []
    turns = 'gravity_sine' in best.fitted.values
    return [*weighed[:-1], refitted], [
        f'the joint {"has gravity" if turns else "is held by a spring"}, which shows beside an '
        f'effect only: it leaves {100.0 * share:.2g} % of what that leaves without']


def _best(weighed: Weighed) -> Candidate:
    """Return the hypothesis that fits best."""
    return min(weighed.candidates.values(), key=lambda each: each.fitted.cost)
