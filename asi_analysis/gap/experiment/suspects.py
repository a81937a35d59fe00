"""
The expected probability of each likely effect ("suspect") of a joint, if a motion is recorded.

Each suspect in turn is added to the nominal joint; the others are fitted to the simulated
recording, as in a diagnosis (`LinearScreen`), which also gives the probabilities.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from asi_analysis.gap.experiment.next_experiment import separation
from asi_analysis.gap.inference.fit import LinearScreen, at_start, fit_null, fit_variants, polish
from asi_analysis.gap.inference.probability import Evidence, Names, probabilities
from asi_analysis.gap.model.effects import (
    GRAVITY,
    PARAMETER,
    Effects,
    Free,
    Variant,
    parameter_error,
)
from asi_analysis.gap.model.group import Group, Values
from asi_analysis.gap.model.predict import predict
from asi_analysis.gap.prepare import Recording

# Of a joint that a force moves, and of one that follows a reference.
MOVED: Final = ('coulomb_friction', 'stiction', 'friction_asymmetry', 'viscous_friction',
                'backlash', 'load_compliance', 'transport_delay', 'valve_lag', 'gravity',
                f'{PARAMETER}load.stiffness', f'{PARAMETER}load.mass')
FOLLOWS: Final = ('transport_delay', 'valve_lag', 'backlash')
SIZES: Final = 2     # so many sizes of a suspect: the smallest initial guesses of its fit
FITTED: Final = 3    # so many alternatives are fitted, not only screened: those that fit best
SPRING: Final[Effects] = {f'{PARAMETER}load.stiffness': (
    Variant((Free('load_stiffness', 0.0, 2.0, (0.05, 0.3), 'stiffness', 'N/m'),), ('load',)),)}


class Suspect(NamedTuple):
    """An effect of a group of channels, its assumed form, and the start that is its size."""

    name: str
    group: int
    variant: Variant
    size: int = 0


class Told(NamedTuple):
    """
    The expected result of a motion for a suspect.

    left: mean square residual of the best fit of each other hypothesis, in error floors, by its
    effects; evidence: from which its probabilities follow.
    """

    left: dict[Names, float]
    evidence: Evidence

    def expected(self, runs: int = 1) -> dict[Names, float]:
        """Return the expected probabilities of the hypotheses after so many runs."""
        e = self.evidence
        return probabilities(e._replace(
            held_out_s=runs * e.held_out_s,
            independent={channel: runs * count for channel, count in e.independent.items()}))


def with_suspects(groups: Sequence[Group], given: Mapping[str, object], tolerance: float,
                  turns: bool) -> list[Group]:
    """Return the groups of a joint with gravity, a spring and a wrong mass as effects."""
    found = []
    for group in groups:
        effects = {name: forms for name, forms in group.effects.items()
                   if not any(free.scale.startswith('residual_') for form in forms
                              for free in form.free)}
        if group.channels == ('load',):
            scale = group.scale
            group = replace(group, scale=scale | {
                'stiffness': scale['force'] / scale['position']})
            effects |= GRAVITY if turns else {}
            effects |= SPRING if 'load.stiffness' not in given else {}
            effects |= parameter_error('load_mass', 'high', (
                1.0 - tolerance, 1.0 + tolerance), ('load',))
        found.append(replace(group, effects=effects))
    return found


def suspects_of(groups: Sequence[Group]) -> list[Suspect]:
    """Return the suspects of groups in each of their sizes, each in the first group it acts on."""
    found: dict[str, Suspect] = {}
    for number, group in enumerate(groups):
        usual = MOVED if group.channels == ('load',) or len(groups) > 1 else FOLLOWS
        for name, variants in _applicable(group).items():
            if name in usual:
                found.setdefault(name, Suspect(name, number, variants[0]))
    return [found[name]._replace(size=size) for name in dict.fromkeys((*MOVED, *FOLLOWS))
            if name in found for size in _sizes(found[name].variant)]


def _sizes(variant: Variant) -> list[int]:
    """Return the numbers of the start values of a form that are its smallest sizes."""
    starts = variant.free[0].starts
    first = {abs(start): number for number, start in reversed(list(enumerate(starts)))}
    return [first[size] for size in sorted(first)[:SIZES]]


def _applicable(group: Group) -> dict[str, list[Variant]]:
    """Return the forms of each effect that apply to a group, alone and without a guess."""
    known = {*group.scale, 'nominal', '', *(group.nominal.dtype.names or ())}
    found = {name: [form for form in forms
                    if not form.joined and set(form.channels) & set(group.channels)
                    and form.applies(group.nominal)
                    and {free.scale for free in form.free} <= known]
             for name, forms in group.effects.items()}
    return {name: forms for name, forms in found.items() if forms}


def size_of(suspect: Suspect, groups: Sequence[Group]) -> np.void:
    """Return the record of the nominal joint with a suspect of its assumed size."""
    return at_start(groups[suspect.group], suspect.variant, suspect.size)


def _recorded(group: Group, p: np.void) -> Group:
    """Return a group whose recordings are the predictions of a record, without noise."""
    def recorded(r: Recording) -> Recording:
        if group.channels != ('load',):
            return replace(r, valve_position=predict(r, group.channels[0], p))
        r = replace(r, motion=r.moved.without_halts())
        return replace(r, force_judged=predict(r, 'load', p))

    return replace(group, recordings=[recorded(r) for r in group.recordings])


def _beside_position(group: Group, suspect: Suspect) -> Group:
    """
    Return a group with gravity and spring as nuisance parameters, unless they are the suspect.

    A diagnosis identifies them first: a motion in which they resemble another effect identifies
    neither.
    """
    by_position = [name for name in group.effects if name in GRAVITY | SPRING]
    if suspect.name in by_position:
        return group
    free = tuple(each._replace(low=-2.0, high=2.0, starts=(0.0,)) for name in by_position
                 for each in group.effects[name][0].free)
    return replace(group, nuisance=(*group.nuisance, *free), effects={
        name: forms for name, forms in group.effects.items() if name not in by_position})


def told(suspect: Suspect, group: Group, p: np.void, fitted: int = 0) -> Told:
    """
    Return the expected result of the recordings of a group, if a suspect is the truth.

    p: record with the suspect; fitted: so many of the other hypotheses are fitted, not only
    screened, and compared by `separation`.
    """
    group = _recorded(_beside_position(group, suspect), p)
    null = fit_null(group)
    screen, count = LinearScreen(null), sum(int(r.fit.sum()) for r in group.recordings)
    forms: dict[Names, list[Variant]] = {
        (name,): variants for name, variants in _applicable(group).items()}
    left: dict[Names, float] = {(): 2.0 * null.cost / count}
    left |= {
        names: max(2.0 * min(screen.cost(group, (each,)) for each in variants) / count, 0.0)
        for names, variants in forms.items() if names != (suspect.name,)}
    for names in sorted(left, key=lambda names: left[names])[:fitted]:
        left[names] = min(
            separation(group, group.recordings[0], p, polish(group, each).record
                       if each is not null else each.record) ** 2
            for each in ([fit_variants(group, screen, (form,)) for form in forms[names]]
                         if names else [null]))
    return Told(left, _evidence(group, suspect, left, forms))


def _evidence(group: Group, suspect: Suspect, left: Mapping[Names, float],
              forms: Mapping[Names, Sequence[Variant]]) -> Evidence:
    """Return the expected evidence, with noise and error floor of the group."""
    channel = group.channels[0]
    floor, noise = group.error_floor[channel], group.noise[channel] ** 2
    held_out = sum(int((r.held_out | r.report).sum()) for r in group.recordings)
    motion = group.recordings[0].motion
    share = 1.0 if motion is None else float(np.mean(motion.judge ** 2))
    residual: dict[Names, Values] = {names: {channel: noise + floor * max(each, 0.0)}
                                     for names, each in left.items()}
    residual[suspect.name,] = {channel: noise}
    return Evidence({channel: noise}, {channel: floor}, {channel: group.formulation[channel]},
                    {channel: max(share * held_out, 1.0)}, group.held_out_s, residual,
                    {names: len(forms[names][0].free) if names else 0 for names in residual})
