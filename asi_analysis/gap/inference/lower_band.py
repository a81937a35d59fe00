"""A load that rattles in its backlash, compared with the model at low frequencies only."""

from collections.abc import Callable, Mapping, Sequence
from typing import Final

import numpy as np

from asi_analysis.gap.inference.hypotheses import Weighed, weigh_groups
from asi_analysis.gap.inference.probability import marginals
from asi_analysis.gap.model.effects import UNKNOWN
from asi_analysis.gap.model.group import Group, with_tolerances
from asi_analysis.gap.model.predict import measured

BANDS_HZ: Final = (10.0, 5.0, 2.5)
# The least share of the force's power that the nominal model leaves if there are impacts.
IMPACT_SHARE: Final = 0.25


def with_lower_band(weighed: list[Weighed], groups: Callable[[float], Sequence[Group]],
                    tolerances: Mapping[str, float], tick: Callable[[], None]
                    ) -> tuple[list[Weighed], list[str]]:
    """
    Return the groups of a joint, in a lower band if backlash explains them only there; and notes.

    The times of impacts depend on small errors, and each impact has a wide spectrum. weighed: in
    the whole band; groups: returns those up to a frequency (Hz); tolerances: by field.
    """
    last = weighed[-1]
    if last.group.channels != ('load',) or marginals(last.probability)[UNKNOWN] < 0.5:
        return weighed, []
    power = max(float(np.var(measured(r, 'load')[r.known])) for r in last.group.recordings)
    if last.candidates[()].fitted.held_out['load'] < IMPACT_SHARE * power:
        return weighed, []
    for band_hz in BANDS_HZ:
        refitted, = weigh_groups([with_tolerances(groups(band_hz)[-1], tolerances)], tick)
        chance = marginals(refitted.probability)
        if chance['backlash'] > 0.5 > chance[UNKNOWN]:
            return [*weighed[:-1], refitted], [
                f'a load that rattles in its gap is judged up to {band_hz:g} Hz: above that small '
                'errors decide when it touches']
    return weighed, []
