"""A nominal model that fits only with a parameter beyond its tolerance is not `no_gap`."""

from asi_analysis.gap.inference.hypotheses import Weighed
from asi_analysis.gap.inference.uncertainty import interval, likelihood
from asi_analysis.gap.model.effects import UNKNOWN, Effect, Variant
from asi_analysis.gap.model.group import Group

MOST_PARAMETERS = 2   # beyond their tolerance, to be named as the cause; more: `unknown`


def with_null_named(weighed: Weighed) -> Weighed:
    """
    Return a group whose null hypothesis keeps all parameters within their tolerances.

    Normal priors let the null fit leave them. If the 95 % interval of a nominal parameter lies
    beyond its tolerance, that fit and its probability belong to the hypothesis of this parameter.
    If it takes more than MOST_PARAMETERS of them, the cause is `unknown`.
    """
    null, group, chance = weighed.candidates[()], weighed.group, weighed.probability
    if chance[()] == 0.0 or not null.fitted.at_limit:
        return weighed
    known, found = likelihood(null.fitted), dict[str, Variant]()
    for free in null.fitted.free:
        nominal = float(group.nominal[free.field])
        if free.field in null.fitted.at_limit and all(
                abs(end / nominal - 1.0) > 2.0 * free.prior
                for end in interval(null.fitted, known, free.field)):
            effect, variant = form_of(group, free.field)
            found[effect.name] = variant
    names = tuple(sorted(found))
    if not names:
        return weighed
    candidates = dict(weighed.candidates)
    if len(names) > MOST_PARAMETERS:
        names = (UNKNOWN,)
    elif chance[()] > chance.get(names, 0.0):
        candidates[names] = null._replace(names=names,
                                          variants=tuple(found[name] for name in names))
    return weighed._replace(candidates=candidates, probability=chance | {
        (): 0.0, names: chance.get(names, 0.0) + chance[()]})


def form_of(group: Group, field: str) -> tuple[Effect, Variant]:
    """Return the effect, and its form, in which a parameter is free with the fewest others."""
    return min(((effect, variant) for effect in group.effects for variant in effect.variants
                if field in {free.field for free in variant.free}),
               key=lambda found: len(found[1].free))
