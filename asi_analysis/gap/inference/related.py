"""
Fit hypotheses again, from the parameters of related ones that fit better.

Effects that act alike make local minima: where one of them has found its way, another follows.
"""

import itertools
from typing import NamedTuple

from asi_analysis.gap.inference.fit import Fitted, refit
from asi_analysis.gap.inference.probability import Names
from asi_analysis.gap.model.effects import Variant, fields_of
from asi_analysis.gap.model.group import Group
from asi_analysis.parallel import in_threads

# Fields of delays and lags, of a servo or of the drive of a joint.
DELAYS_AND_LAGS = ('command_delay', 'valve_lag', 'drive_delay', 'drive_lag')


class Candidate(NamedTuple):
    """A hypothesis of a group: its effects, their forms and the best fit."""

    names: Names
    variants: tuple[Variant, ...]
    fitted: Fitted


def refitted_from_related(group: Group, found: dict[Names, Candidate]
                          ) -> dict[Names, Candidate]:
    """
    Return effects that fit worse than another one with a common parameter, refitted from that.

    Friction effects share a level. The linear screen does not tell the pre-sliding displacement,
    which is the same for each of them.
    """
    def from_related(candidate: Candidate) -> Candidate:
        fields = fields_of(candidate.variants)
        related = min((each for each in found.values() if each.names != candidate.names
                       and fields & fields_of(each.variants)),
                      key=lambda each: each.fitted.cost, default=candidate)
        return candidate if related.fitted.cost >= candidate.fitted.cost else candidate._replace(
            fitted=refit(group, candidate.fitted, [related.fitted]))

    better = {each.names: each for each in in_threads(from_related, found.values())}
    return better | _refitted_delays(group, found)


def _refitted_delays(group: Group, found: dict[Names, Candidate]) -> dict[Names, Candidate]:
    """
    Return a lag or a delay that fits worse than the other, refitted from the other's value.

    The total delay can be shared with the servo's own lag in several ways: local minima.
    """
    late = {name: names for names, each in found.items() if len(names) == 1
            for name in DELAYS_AND_LAGS if each.fitted.values.get(name)}
    better: dict[Names, Candidate] = {}
    for field, other in itertools.permutations(late, 2):
        own, rival = found[late[field]], found[late[other]]
        if rival.fitted.cost < own.fitted.cost:
            p = rival.fitted.record.copy()
            p[field], p[other] = p[other], 0.0
            if f'{field}_split' in own.fitted.values:   # two equal poles: nearest to a delay
                p[f'{field}_split'] = 0.5
            again = rival.fitted._replace(record=p)
            better[late[field]] = own._replace(fitted=refit(group, own.fitted, [again]))
    return better
