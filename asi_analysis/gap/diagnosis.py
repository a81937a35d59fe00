"""The result of a diagnosis: `Diagnosis`."""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from asi_analysis.bags.run import Run
from asi_analysis.gap.baseline import Healthy
from asi_analysis.gap.findings.shrink import Shrink
from asi_analysis.gap.inference.beyond_tolerance import LEAST_PROBABILITY
from asi_analysis.gap.inference.hypotheses import Candidate, Weighed
from asi_analysis.gap.inference.probability import Names
from asi_analysis.gap.model.effects import UNKNOWN
from asi_analysis.gap.model.joint import WHOLE, Extent
from asi_analysis.gap.model.model_file import improved_model
from asi_common.parameter import Value


@dataclass(frozen=True)
class Diagnosis:
    """
    The result.

    tolerance: of the nominal parameters; tolerances: other ones, by field; joined: probability of
    each set of effects; shrinks: by channel.
    """

    runs: Sequence[Run]
    plant: str
    tolerance: float
    tolerances: Mapping[str, float]
    groups: list[Weighed]
    joined: dict[Names, float]
    verdict: Names                 # () for no gap, ('unknown',) if it holds that
    shrinks: list[Shrink]
    notes: list[str]
    next_experiment: dict[str, object] | None
    chain: dict[str, float] | None
    # With a baseline: the diagnosis of the healthy recordings, and their machine, by channels.
    healthy: 'Diagnosis | None' = None
    machine: Mapping[tuple[str, ...], Healthy] = field(default_factory=dict)
    extent: Extent = WHOLE         # of a joint

    def compared(self, channel: str) -> Weighed:
        """Return the group that holds a channel."""
        return next(each for each in self.groups if channel in each.group.channels)

    def best(self, weighed: Weighed) -> Candidate:
        """Return the hypothesis of a group that agrees with the verdict, but for `unknown`."""
        part = next(part for part, group in zip(_parts(self.groups, self.verdict), self.groups,
                                                strict=True) if group is weighed)
        names = tuple(name for name in part if name != UNKNOWN)
        if names or not part:
            return weighed.candidates[names]
        if weighed.closest is not None:
            return weighed.candidates[weighed.closest]
        known = max(weighed.candidates, key=lambda n: weighed.probability.get(n, 0.0))
        # With a gap that is unknown, an improbable effect is no better than none.
        return weighed.candidates[known if weighed.probability[known] > LEAST_PROBABILITY else ()]


def _parts(groups: Sequence[Weighed], names: Names) -> tuple[Names, ...]:
    """Return the hypothesis of each group of which a joint hypothesis most probably consists."""
    fits = [[part for part in weighed.probability if set(part) <= set(names)]
            for weighed in groups]
    return max((parts for parts in itertools.product(*fits)
                if {name for part in parts for name in part} == set(names)),
               key=lambda parts: math.prod(weighed.probability[part] for weighed, part in zip(
                   groups, parts, strict=True)))


def improved_of(diagnosis: Diagnosis, model: Mapping[str, Value]) -> dict[str, Value]:
    """Return the actuator's parameters of the improved model."""
    return improved_model(model, records_of(diagnosis))[0]


def records_of(diagnosis: Diagnosis) -> list[np.void]:
    """Return the fitted records of the verdict, one for each group of channels."""
    return [diagnosis.best(weighed).fitted.record for weighed in diagnosis.groups]
