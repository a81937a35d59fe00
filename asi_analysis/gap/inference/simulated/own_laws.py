"""
Whether the simulator's own laws explain a machine whose nominal model is linear.

A linear law has one formulation, so the nominal part of such a machine is the simulator's, and a
residual is an effect. Effects may be formulated in another way than the simulator's.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from asi_analysis.gap.inference.coloured_noise import not_white, with_noise_of_valve
from asi_analysis.gap.inference.fit import Fitted
from asi_analysis.gap.inference.hypotheses import Weighed
from asi_analysis.gap.inference.probability import Names
from asi_analysis.gap.inference.simulated.behind_valve import (
    behind_valve,
    gain_is_off,
    with_free_gain,
)
from asi_analysis.gap.inference.simulated.evidence import STEPS
from asi_analysis.gap.inference.simulated.explained import most_probable_of, weighed_of
from asi_analysis.gap.inference.simulated.fits import (
    null_fit,
    with_fine_substeps,
    with_noise_from_fit,
    with_noise_left,
)
from asi_analysis.gap.inference.simulated.formulation import goal_beside, in_formulation
from asi_analysis.gap.inference.simulated.found import Found, cost_of
from asi_analysis.gap.inference.simulated.search import of_effects, single_effects, with_pairs
from asi_analysis.gap.inference.simulated.uneven_delay import with_uneven_delay
from asi_analysis.gap.model.effects import PARAMETER, UNKNOWN, has_one_law
from asi_analysis.gap.model.group import Group

# The share of the nominal model's power beyond noise that the right effect may leave, if it is
# formulated in another way; and the power, over what noise and model error explain, that is a gap.
LEFT, GAP = 0.05, 4.0


class OwnLaws(NamedTuple):
    """
    What the simulator's own laws say of a group.

    weighed: None if they do not explain it, with two effects at most; gap: whether the nominal
    model, refitted, leaves so much that this cannot be noise or model error.
    """

    weighed: Weighed | None
    gap: bool

    def agreeing(self, weighed: Weighed) -> Weighed:
        """Return the answer of other fits: where there is a gap, what was none is unknown."""
        if self.weighed is not None or not self.gap:
            return weighed
        chance = dict(weighed.probability)
        chance[(UNKNOWN,)] = chance.get((UNKNOWN,), 0.0) + chance.pop((), 0.0)
        return weighed._replace(probability={**chance, (): 0.0})


def by_own_laws(groups: Sequence[Group], tick: Callable[[], None],
                refuse: Callable[[], object] = bool) -> list[OwnLaws]:
    """
    Return, for each group, whether the simulator's own laws explain it, with up to two effects.

    For a simplified nominal model. Its laws are linear, so a machine's are the same, but effects
    may be formulated in another way than the simulator's; then the block-wise fits are asked.
    groups: as in `explained_by_simulator`; refuse: called as soon as the first is not explained,
    to raise an error if other fits would not explain it either.
    """
    valve, *others = groups
    valve, gain = with_free_gain(valve) if others else (valve, None)
    first, fitted, best = _own_laws(valve, tick)
    if first.weighed is None:
        refuse()
    only_noise = bool(not_white(best.problem.group)) and not best.unexplained
    # Behind a valve that is not explained, no pair will leave only noise.
    rest = [_own_laws(behind_valve(with_noise_of_valve(each, best.problem.group), fitted, gain,
                                   only_noise), tick, first.weighed is not None)[0]
            for each in others]
    if any(law.weighed is None and gain_is_off(fitted.record, each, gain)
           for law, each in zip(rest, others, strict=True)):
        first = first._replace(weighed=None)   # the gain is judged with the valve, block by block
    # Of a valve that they do not explain to the noise, the position is not known well enough to
    # blame the rest: an effect of another formulation leaves as much as it is wrong.
    known = first.weighed is not None and not best.unexplained
    return [first, *(each._replace(gap=each.gap and known) for each in rest)]


def _own_laws(group: Group, tick: Callable[[], None], pairs: bool = True
              ) -> tuple[OwnLaws, Fitted, Found]:
    """
    Return what the simulator's own laws say of a group; the most probable fit.

    pairs: whether pairs of effects are fitted.
    """
    null = with_noise_left(with_noise_from_fit({(): null_fit(group)}))[()]
    found = with_uneven_delay(with_noise_left(single_effects(null, tick, _goal)))
    found = _with_pairs(found, tick) if pairs else found
    found = with_fine_substeps(found) if group.channels == ('valve',) else found
    null, best = found[()], min(found.values(), key=cost_of)
    gap = bool((null.relative_residual > GAP).any())
    if not any(_mostly_explains(each, null) for each in found.values()):
        return OwnLaws(None, gap), best.as_fitted, best
    weighed = weighed_of(in_formulation(found, not _has_own_formulation(best, found)), True)
    if weighed is None:
        return OwnLaws(None, gap), best.as_fitted, best
    chosen = most_probable_of(weighed)
    return OwnLaws(weighed, gap), chosen.fitted, found.get(chosen.names, best)


def _has_own_formulation(best: Found, found: Mapping[Names, Found]) -> bool:
    """
    Return whether the best fit needs no model error: only it leaves noise, by effects of one law.

    Where fewer effects leave noise too, what another one adds may be the formulation of a law.
    """
    fewer = (each for each in found.values() if _laws(each) < _laws(best))
    return (bool(best.names) and not best.may_lack_an_effect
            and all(map(_has_one_formulation, best.names))
            and all(each.may_lack_an_effect for each in fewer))


def _laws(found: Found) -> int:
    """Return the number of effects of a fit that have a law; steps of a converter have none."""
    return len(set(found.names) - {STEPS})


def _has_one_formulation(effect: str) -> bool:
    """Return whether an effect has one law, or is the steps of a converter."""
    return effect == STEPS or has_one_law(effect)


def _with_pairs(found: dict[Names, Found], tick: Callable[[], None]) -> dict[Names, Found]:
    """
    Return hypotheses, with pairs that leave no more than noise, as `with_pairs` does.

    Only if the law of the best single effect has one formulation: of another one, a second effect
    would be what the formulation leaves. So would be a parameter beyond its tolerance.
    """
    singles = [each for names, each in found.items() if names]
    first = min(singles, key=cost_of, default=found[()])
    if not first.names or first.names[0].startswith(PARAMETER) or (
            not _has_one_formulation(first.names[0])):
        return found
    every = found[()].problem.group.effects
    effects = {name: forms for name, forms in every.items() if not name.startswith(PARAMETER)}
    pairs = with_pairs({names: of_effects(each, effects) for names, each in found.items()},
                       tick, False)
    return {names: of_effects(each, every) for names, each in pairs.items()
            if len(names) < 2 or not each.unexplained}


def _goal(leader: Found, null: Found) -> float:
    """
    Return the cost that a fit must reach beside the best one.

    If that does not explain the group, another one must leave less, or be what mostly explains it;
    if it does so only with improbable parameters, that is enough.
    """
    goal = goal_beside(leader)
    explaining = max(leader.best.cost, leader.largest_cost + LEFT * null.best.cost)
    if _leaves_little(leader, null):
        return max(goal, explaining) if leader.improbable else goal
    return min(goal, explaining)


def _leaves_little(found: Found, null: Found) -> bool:
    """Return whether a fit leaves only noise, or little of what the nominal model leaves."""
    more, before = (np.maximum(each.relative_residual - 1.0, 0.0) for each in (found, null))
    return bool((more <= LEFT * before).all())


def _mostly_explains(found: Found, null: Found) -> bool:
    """Return whether a hypothesis explains a group with probable nominal parameters."""
    return _leaves_little(found, null) and not found.improbable
