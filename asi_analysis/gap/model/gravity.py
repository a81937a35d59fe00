"""
Gravity, spring and constant force of a joint: identified by least squares, and subtracted.

Gravity acts on a joint that turns, m g l sin q; a spring c q on any joint. Both depend on the
position, inertia and friction on the motion; all are identified together.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from scipy.optimize import lsq_linear

from asi_analysis.arrays import Array
from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError
from asi_analysis.gap.model.group import RIGID_ERROR
from asi_analysis.gap.model.rattling import Rattling, load_motion
from asi_analysis.gap.motion import judged
from asi_analysis.gap.prepare import Recording
from asi_common.jit import jit

BIASED: Final = 0.5        # a mean force above this multiple of its standard deviation is removed
# Gravity or spring is accepted if the residual power is below this share of that without it.
ACCEPTED_RESIDUAL: Final = 0.7
INDEPENDENT: Final = 0.1   # least share of their force (rms) that is independent of other terms
# Regressors of friction: Coulomb friction, fully developed from this share of the rms speed on;
# breakaway below it; elements of a Maxwell slip model, whose slip is this share of the range.
CREEP: Final = 0.05
SLIP_RANGES: Final = (0.002, 0.02, 0.1)
GRAVITY_SHAPES, SPRING = ('sine', 'cosine'), ('spring',)
SIGNED: Final = ('rate', 'constant', *GRAVITY_SHAPES)   # coefficients of the others are positive


class ByPosition(NamedTuple):
    """
    Forces that depend on a joint's position: gravity sine sin q + cosine cos q (N m), a spring.

    given: the stiffness (N/m or N m/rad) was given; residual_share: residual power with them, as
    a share of that without; ambiguous: a spring alone fits about as well.
    """

    sine: float = 0.0
    cosine: float = 0.0
    stiffness: float = 0.0
    given: bool = False
    residual_share: float = 1.0
    ambiguous: bool = False


def turns_measured(recordings: Sequence[Recording], runs: Sequence[Run]) -> bool:
    """Return whether the joint turns and its angle, on which gravity depends, was measured."""
    return not any(run.position_m is None or run.unit('position') != 'rad'
                   or r.force_judged is None or r.motion is None
                   for run, r in zip(runs, recordings, strict=True))


def by_position(recordings: Sequence[Recording], runs: Sequence[Run],
                stiffness: float | None = None, rattling: Rattling | None = None) -> ByPosition:
    """
    Return the gravity of a joint that turns, and the spring of any.

    stiffness: of the spring, if that is given; rattling: the backlash behind which they act.

    Gravity is a sin q + b cos q, a spring c q; a, b and c are identified together with inertia,
    damping, friction and offset, by least squares on the fitted parts. They are accepted if they
    lower the residual power of the held-out parts below ACCEPTED_RESIDUAL of that without them
    (which must exceed that of RIGID_ERROR), by a force that is independent of the other terms: in
    a single sine wave, a spring cannot be distinguished from an inertia. Of several choices that
    fit about as well, the simplest is returned.
    """
    turns, unknown = turns_measured(recordings, runs), stiffness is None
    if not any(r.held_out.any() for r in recordings) or any(
            run.position_m is None or r.force_judged is None or r.motion is None
            for run, r in zip(runs, recordings, strict=True)):
        return ByPosition(stiffness=stiffness or 0.0, given=not unknown)
    shapes = [_shapes(r, run, turns, stiffness or 0.0, rattling)
              for run, r in zip(runs, recordings, strict=True)]

    def stacked(part: str, names: Sequence[str]) -> Array:
        return np.vstack([np.column_stack([each[name] for name in names])[getattr(r, part)]
                          for each, r in zip(shapes, recordings, strict=True)])

    # A given stiffness may be slightly wrong.
    sought = {'force', *GRAVITY_SHAPES, *SPRING * (not stiffness)}
    always = [name for name in shapes[0] if name not in sought]

    def fitted(more: tuple[str, ...]) -> tuple[float, dict[str, float]] | None:
        names = [*always, *more]
        force, columns = np.split(stacked('fit', ['force', *names]), [1], axis=1)
        size = np.sqrt(np.mean(columns ** 2, axis=0)) + 1e-30
        low = [-np.inf if name in SIGNED or (name in SPRING and stiffness) else 0.0
               for name in names]
        values = lsq_linear(columns / size, force[:, 0], (low, np.inf), method='bvls').x / size
        for kind in (kind for kind in (GRAVITY_SHAPES, SPRING) if kind[0] in more):
            own = np.isin(names, kind)
            added, others = columns[:, own] @ values[own], columns[:, ~own] / size[~own]
            alone = added - others @ np.linalg.lstsq(others, added)[0]
            if alone.std() < INDEPENDENT * added.std():
                return None
        force, columns = np.split(stacked('held_out', ['force', *names]), [1], axis=1)
        residual = float(np.mean((force[:, 0] - columns @ values) ** 2))
        return residual, dict(zip(names, map(float, values), strict=True))

    # The simplest first: nothing, gravity, a spring, both.
    choices = ((), *[GRAVITY_SHAPES] * turns, *[SPRING] * unknown,
               *[GRAVITY_SHAPES + SPRING] * (turns and unknown))
    found = {more: each for more in choices if (each := fitted(more)) is not None}
    without = found[()][0]
    least = RIGID_ERROR ** 2 * float(np.var(stacked('held_out', ['force'])))
    most = ACCEPTED_RESIDUAL * without
    needed = {more: each for more, each in found.items()
              if each[0] < most and without > least} or {(): found[()]}
    least = min(residual for residual, _ in needed.values())
    close = [more for more, (residual, _) in needed.items()
             if not least < ACCEPTED_RESIDUAL * residual]
    residual, values = found[close[0]]
    spring = stiffness or (values['spring'] if SPRING[0] in close[0] else 0.0)
    sine, cosine = (values.get(name, 0.0) for name in GRAVITY_SHAPES)
    share = residual / without if close[0] else 1.0
    return ByPosition(sine, cosine, spring, not unknown, share, SPRING in close)


def without_gravity(recordings: list[Recording], runs: Sequence[Run], found: ByPosition
                    ) -> tuple[list[Recording], list[str]]:
    """Return recordings of a joint without its gravity, and notes of that and of a spring."""
    leaves = (f'with it the model leaves {100.0 * found.residual_share:.2g} % of the power of the '
              'error that it has without')
    notes = [f'a spring holds the joint: {leaves}'] * bool(
        found.stiffness and not found.given)
    if not found.sine and not found.cosine:
        return recordings, notes
    taken = []
    for run, r in zip(runs, recordings, strict=True):
        if run.position_m is None or r.motion is None or r.force is None or r.force_judged is None:
            raise InputError(f'{run.source}: without the position the gravity of the joint '
                             'cannot be subtracted')
        angle = r.motion.position + float(np.nanmean(run.signal('position')))
        torque = (found.sine * np.sin(angle) + found.cosine * np.cos(angle))[r.motion.inner]
        taken.append(replace(r, force=r.force - torque,
                             force_judged=r.force_judged - judged(torque, r.motion),
                             taken={'gravity_sine': found.sine,
                                    'gravity_cosine': found.cosine}))
    return taken, [f'the joint has gravity: {leaves}'
                   + ('; a spring in its place would leave about as little' if found.ambiguous
                      and not found.stiffness else ''), *notes]


def from_one_origin(recordings: Sequence[Recording], runs: Sequence[Run], stiffness: float
                     ) -> list[Recording]:
    """
    Return recordings whose spring is relaxed at the middle of the first one's motion.

    The position of each recording is relative to its own middle.
    """
    if not stiffness:
        return list(recordings)
    middles = [float(np.nanmean(run.signal('position'))) if run.position_m is not None else 0.0
               for run in runs]
    return [r if r.force is None or r.force_judged is None or middle == middles[0] else
            replace(r, force=r.force - more, force_judged=r.force_judged - more,
                    taken={**r.taken, 'constant': more})
            for r, middle in zip(recordings, middles, strict=True)
            for more in [stiffness * (middle - middles[0])]]


@jit
def _slip(position: Array, reach: float) -> Array:
    """Return the deflection (-1 to 1) of a Maxwell slip element that slides after a reach."""
    out = np.zeros(position.size)
    for k in range(1, position.size):
        out[k] = min(max(out[k - 1] + (position[k] - position[k - 1]) / reach, -1.0), 1.0)
    return out


def _shapes(recording: Recording, run: Run, turns: bool, stiffness: float,
            rattling: Rattling | None) -> dict[str, Array]:
    """
    Return the force of a joint without that of a given spring (N/m), and its regressors, by name.

    The rate of the force stands for a short delay or lag, which would otherwise bias gravity.
    rattling: position and damping are those of the load behind that backlash.
    """
    motion, force = recording.moved, recording.force_judged
    assert force is not None
    angle = motion.position + float(np.nanmean(run.signal('position')))
    speed, usual = motion.velocity, float(motion.velocity.std()) + 1e-30
    behind = {}
    if rattling is not None:
        load, speed = load_motion(motion, recording.period_s, rattling)
        angle = angle + load - motion.position
        behind = {'inertia_behind': np.gradient(speed, recording.period_s)}
    slips = [_slip(angle, share * float(np.ptp(angle)) + 1e-30) for share in SLIP_RANGES]
    shapes = {name: judged(each[motion.inner], motion) for name, each in {
        'inertia': motion.acceleration, **behind, 'damping': speed,
        'friction': np.tanh(speed / (CREEP * usual)),
        **{f'friction_{n}': each for n, each in enumerate(slips)},
        'breakaway': slips[0] * np.exp(-np.abs(speed) / (CREEP * usual)),
        'constant': np.ones_like(angle), 'sine': np.sin(angle), 'cosine': np.cos(angle),
        'spring': angle}.items()}
    shapes |= {'force': force - stiffness * shapes['spring'],
               'rate': np.gradient(force, recording.period_s)}
    if not turns and recording.fit.any():   # each recording may have a constant force of its own
        shapes = {name: each - each[recording.fit].mean() for name, each in shapes.items()}
    return shapes


def without_bias(recordings: list[Recording], of: Sequence[Recording]
                  ) -> tuple[list[Recording], list[str]]:
    """
    Return recordings without a large mean force (pressure, gravity), and notes.

    The model error is relative to the varying part of the force. The mean of `of` is subtracted;
    each recording's own, if those of `of` differ by more than twice the standard deviation.
    of: the healthy recordings, if there are any, else the same ones.
    """
    def means(each: Sequence[Recording]) -> list[float]:
        return [float(r.force[r.valid].mean()) for r in each if r.force is not None]

    common, deviation = means(of), min(float(r.force.std()) for r in of if r.force is not None)
    if max(map(abs, common), default=0.0) < BIASED * deviation:
        return recordings, []
    similar = max(common) - min(common) < 2.0 * deviation
    taken = [float(np.mean(common))] * len(recordings) if similar else means(recordings)
    shifted = [replace(r, force=r.force - mean, force_judged=r.force_judged - mean,
                       taken={**r.taken, 'constant': r.taken.get('constant', 0.0) + mean,
                              'mean': mean})
               if r.force is not None and r.force_judged is not None else r
               for r, mean in zip(recordings, taken, strict=True)]
    return shifted, ['a constant force is subtracted, load_offset is relative to it: '
                     + _listed(dict.fromkeys(taken))]


def _listed(values: Iterable[float]) -> str:
    """Return values as text."""
    return ', '.join(f'{value:.4g}' for value in values)
