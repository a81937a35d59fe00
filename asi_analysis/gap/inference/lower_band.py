"""A load that rattles in its backlash, compared with the model at low frequencies only."""

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from asi_analysis.gap.inference.hypotheses import Weighed, weigh_groups
from asi_analysis.gap.inference.probability import marginals
from asi_analysis.gap.model.effects import UNKNOWN
from asi_analysis.gap.model.group import Group
from asi_analysis.gap.model.joint import Extent
from asi_analysis.gap.model.predict import measured

BANDS_HZ: Final = (10.0, 5.0, 2.5)
# The least share of the force's power that the nominal model leaves if there are impacts.
IMPACT_SHARE: Final = 0.25
# Where something else is left in each band: least probability of a backlash beside it.
BESIDE: Final = 0.9
JUDGED: Final = ('a load that rattles in its gap is judged up to {:g} Hz: above that small errors '
                 'decide when it touches')


def with_lower_band(weighed: list[Weighed], groups: Callable[[Extent], Sequence[Group]],
                    extent: Extent, tick: Callable[[], None]
                    ) -> tuple[list[Weighed], list[str], Extent]:
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
