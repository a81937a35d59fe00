"""
Effects that are a special case of another hypothesis, fitted from its values; no friction at all.

Coulomb friction is a special case of stiction, a single effect of a pair. Fitted from elsewhere,
it may end in a local minimum; then the more general hypothesis would be the more probable one.
Friction whose seals are too soft to slide is a spring, which imitates other effects.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

from asi_actuator.model.friction import elements, held_friction, sliding
from asi_analysis.gap.inference.posterior import most_probable
from asi_analysis.gap.inference.simulated.fits import converged
from asi_analysis.gap.inference.simulated.found import Found, freed_fields, with_values_of
from asi_analysis.gap.model.effects import Variant, fields_of
from asi_analysis.gap.model.start import actuator_of

LITTLE = 0.1   # share of a motion that slides, below which a friction is a spring


def alone_of(null: Found, found: Found, variant: Variant) -> Found:
    """Return the fit of one effect of a hypothesis alone, in the form that it has there."""
    values, own = found.problem.record(found.best.theta), variant.fields
    gone = {field for other in found.variants if other != variant for field, _ in other.fixed}
    fixed = tuple(each for each in found.problem.fixed
                  if each[0] not in gone or each in (*variant.fixed, *null.problem.fixed))
    problem = replace(found.problem, fixed=fixed, free=(
        *(free for free in null.problem.free if free.field not in own), *variant.free))
    name, = (name for name, forms in problem.group.effects.items() if variant in forms)
    return converged(Found((name,), (variant,), problem, most_probable(
        problem, problem.theta(values))))


def simpler_forms(found: Found, goal: float) -> Iterator[Found]:
    """
    Yield fits with one effect in a form with fewer free parameters, of those that it has.

    A nominal parameter among the others has its prior again. goal: a fit that cannot reach this
    cost is given up.
    """
    problem, values = found.problem, found.problem.record(found.best.theta)
    for number, form in enumerate(found.variants):
        own, others = form.fields, (*found.variants[:number], *found.variants[number + 1:])
        for forms in problem.group.effects.values():
            for variant in forms if form in forms else ():
                held = own - variant.fields
                if (not variant.fields < own or variant.fixed != form.fixed
                        or any(held & other.fields for other in others)):
                    continue
                free = (*(each for each in problem.free if each.field not in held),
                        *(each for each in problem.group.nuisance if each.field in held))
                simpler = replace(problem, free=free)
                best = most_probable(simpler, simpler.theta(values), goal=goal)
                if best.cost < goal:
                    yield converged(found._replace(
                        variants=(*found.variants[:number], variant,
                                  *found.variants[number + 1:]), problem=simpler, best=best))


def special_cases(found: Found, forms: Sequence[Found]) -> list[Found]:
    """Return those forms of other effects that have some of the parameters of a fit's effect."""
    return list({form.variants: form for form in forms if form.names != found.names
                 and freed_fields(form)[1] < freed_fields(found)[1]
                 and form.variants[:-1] == found.variants[:-1]}.values())


def from_values_of(found: Found, form: Found, goal: float) -> Found:
    """Return the fit of a form from the values of another fit, corrected as that is."""
    problem = replace(form.problem, group=found.problem.group)
    start = with_values_of(form, found, freed_fields(form)[0])
    return converged(form._replace(problem=problem, best=most_probable(
        problem, start, goal=goal)), goal)


def never_slides(found: Found) -> bool:
    """
    Return whether the seals of a free friction are too soft to slide in a direction.

    That is: where the piston has moved by half of its range, hardly any of the motion slides.
    """
    if not {'friction_coulomb', 'friction_presliding_stiffness'} <= fields_of(found.variants):
        return False
    p = actuator_of(found.problem.record(found.best.theta))
    _, reach = elements(p)
    moved = found.problem.group.scale['position']
    held = max(held_friction(forward, p) for forward in (True, False))
    limit = reach * held / p['friction_presliding_stiffness']
    return bool(moved < limit and sliding(moved / limit, p) * moved / limit < LITTLE)
