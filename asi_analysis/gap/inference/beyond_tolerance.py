"""A nominal model that only fits with a parameter beyond its tolerance is not `no_gap`."""

from collections.abc import Callable

from asi_analysis.gap.inference.hypotheses import Weighed
from asi_analysis.gap.inference.uncertainty import interval, likelihood
from asi_analysis.gap.model.effects import Effect, Variant
from asi_analysis.gap.model.group import Group


def with_null_named(weighed: Weighed, tolerance: Callable[[str], float]) -> Weighed:
    """
    Return a group whose null hypothesis keeps to the tolerances: its normal priors do not.

    Where the 95 % interval of a nominal parameter of the null fit lies beyond its tolerance, what
    is fitted is the hypothesis of that parameter: it takes over the fit and its probability.
    tolerance: of a field.
    """
    null, group, chance = weighed.candidates[()], weighed.group, weighed.probability
    if chance[()] == 0.0 or not null.fitted.at_limit:
        return weighed
    found: dict[str, Variant] = {}
    known = likelihood(null.fitted)
    for field in null.fitted.at_limit:
        nominal = float(null.fitted.problem.group.nominal[field])
        low, high = (end / nominal - 1.0 for end in interval(null.fitted, known, field))
        if low > tolerance(field) or high < -tolerance(field):
            effect, variant = _of_the_field(group, field)
            found[effect.name] = variant
    names = tuple(sorted(found))
    if not names:
        return weighed
    candidates = dict(weighed.candidates)
    if chance[()] > chance.get(names, 0.0):
        candidates[names] = null._replace(names=names,
                                          variants=tuple(found[name] for name in names))
    return weighed._replace(candidates=candidates, probability=chance | {
        (): 0.0, names: chance.get(names, 0.0) + chance[()]})


def _of_the_field(group: Group, field: str) -> tuple[Effect, Variant]:
    """Return the effect, and its form, that frees one nominal parameter alone."""
    return next((effect, variant) for effect in group.effects for variant in effect.variants
                if [free.field for free in variant.free] == [field])
