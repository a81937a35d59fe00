"""
A joint modelled or compared in another way, where no effect explains it: another `Extent`.

Gravity, a spring or a servo's order may show together with an effect only; a load that rattles in
its backlash is compared with the model at low frequencies only.
"""

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from asi_analysis.gap.inference.hypotheses import Candidate, Weighed, weigh_groups
from asi_analysis.gap.inference.probability import marginals
from asi_analysis.gap.model.effects import UNKNOWN
from asi_analysis.gap.model.gravity import ACCEPTED_RESIDUAL
from asi_analysis.gap.model.group import Group
from asi_analysis.gap.model.joint import Extent
from asi_analysis.gap.model.predict import measured

ABOVE_NOISE: Final = 1.5   # multiple of the noise variance below which a servo is explained
BANDS_HZ: Final = (10.0, 5.0, 2.5)
# The least share of the force's power that the nominal model leaves if there are impacts.
IMPACT_SHARE: Final = 0.25
# Where something else is left in each band: least probability of a backlash beside it.
BESIDE: Final = 0.9
JUDGED: Final = ('a load that rattles in its gap is judged up to {:g} Hz: above that small errors '
                 'decide when it touches')

# The groups of a joint in another extent, notes, and that extent.
Refitted = tuple[list[Weighed], list[str], Extent]


def with_hidden_load(weighed: list[Weighed], groups: Callable[[Extent], Sequence[Group]],
                     extent: Extent, tick: Callable[[], None]) -> Refitted:
    """
    Return the groups of a joint with what was hidden in every fit, if needed.

    And notes, and their extent. It is gravity or a spring; of a servo, its second order;
    and needed if no effect explains the gap without it, one does with it (of a servo, it may do so
    alone), and the residual power is then below ACCEPTED_RESIDUAL of that before.
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
    if not (best.names or servo) or share > ACCEPTED_RESIDUAL or unknown:
        return weighed, [], extent
    what = ('the servo is of second order' if servo else 'the joint has gravity'
            if 'gravity_sine' in best.fitted.values else 'the joint is held by a spring')
    what += ', which shows beside an effect only' if best.names else ''
    return [*weighed[:-1], refitted], [
        f'{what}: with it {100.0 * share:.2g} % of the power of the error is left'], whole


def _best(weighed: Weighed) -> Candidate:
    """Return the hypothesis that fits best."""
    return min(weighed.candidates.values(), key=lambda each: each.fitted.cost)


def with_lower_band(weighed: list[Weighed], groups: Callable[[Extent], Sequence[Group]],
                    extent: Extent, tick: Callable[[], None]) -> Refitted:
    """
    Return the groups of a joint, in a lower band if backlash explains them only there.

    And notes, and their extent. The times of impacts depend on small errors, and each impact has a
    wide spectrum. weighed: in the whole band; groups: returns those of another extent.
    """
    last = weighed[-1]
    if last.group.channels != ('load',) or marginals(last.probability)[UNKNOWN] < 0.5:
        return weighed, [], extent
    power = max(float(np.var(measured(r, 'load')[r.known])) for r in last.group.recordings)
    # The model of the healthy machine leaves little before: what it leaves now may be impacts.
    if (not last.group.floor_measured
            and last.candidates[()].fitted.held_out['load'] < IMPACT_SHARE * power):
        return weighed, [], extent
    beside: tuple[Weighed, Extent] | None = None
    for band_hz in (each for each in BANDS_HZ if each < extent.band_hz):
        lower = extent._replace(band_hz=band_hz)
        refitted, = weigh_groups([groups(lower)[-1]], tick)
        chance = marginals(refitted.probability)
        if chance['backlash'] > 0.5 > chance[UNKNOWN]:
            return [*weighed[:-1], refitted], [JUDGED.format(band_hz)], lower
        if beside is None and chance['backlash'] > BESIDE:
            beside = refitted, lower
    if beside is None:
        return weighed, [], extent
    return [*weighed[:-1], beside[0]], [JUDGED.format(beside[1].band_hz)], beside[1]
