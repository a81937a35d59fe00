"""The recordings of a joint as they are given: what is doubtful of them, and what is mended."""

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from asi_analysis.arrays import Array
from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError
from asi_analysis.gap.model.joint import drive_of

TURN: Final = 2.0 * np.pi
# How far a single-sample jump of a wrapped angle may be from a turn, beside the usual motion.
NEAR_TURN: Final = 0.05


def unwrapped(run: Run) -> tuple[Run, list[str]]:
    """Return a run of a joint whose angle does not jump by whole turns; a note, if it did."""
    if run.position_m is None or run.unit('position') != 'rad':
        return run, []
    position, jumps = _without_turns(run.position_m)
    if not jumps:
        return run, []
    changed = replace(run, position_m=position)
    if run.reference_n is not None and run.unit('reference') == 'rad':
        turns = np.round((run.reference_n - position) / TURN)   # to the nearest one
        changed = replace(changed, reference_n=run.reference_n - TURN * turns)
    return changed, [f'{run.source}: position jumps by whole turns, {jumps} times: it is taken as '
                     'an angle that wraps, and unwrapped']


def _without_turns(angle: Array) -> tuple[Array, int]:
    """Return an angle (rad) without jumps of a turn, and their number; 0: it has others too."""
    known = np.flatnonzero(np.isfinite(angle))
    steps = np.diff(angle[known])
    jumps = np.abs(steps) > 0.5 * TURN
    usual = float(np.abs(steps[~jumps]).max(initial=0.0))
    off = np.abs(np.abs(steps[jumps]) - TURN)
    if not jumps.any() or usual > 0.25 * TURN or off.max() > NEAR_TURN * TURN + usual:
        return angle, 0
    whole = angle.copy()
    whole[known] = np.unwrap(angle[known])
    return whole, int(jumps.sum())


def units_not_given(run: Run) -> list[str]:
    """Return a note if a motion was imported without a unit: it is taken in metres."""
    notes = []
    for text in run.information.get('imported', {}).get('mapping', ()):
        name = text.partition('=')[0].strip()
        unit = {'position': 'm', 'velocity': 'm/s'}.get(name)
        if unit and name in run.signals() and run.unit(name) == unit and not (
                text.rstrip().endswith(']')):
            turning = unit.replace('m', 'rad')
            notes.append(f'{run.source}: {name} was imported without a unit and is taken in '
                         f'{unit}; gravity is looked for in rad only: if the joint turns, import '
                         f'it with {text}[{turning}] or [deg{unit[1:]}]')
    return notes


def without_repeats(runs: Sequence[Run], others: Sequence[Run] = ()
                    ) -> tuple[list[Run], list[str]]:
    """Return the runs that differ from those before them and from `others`; notes of the rest."""
    kept: list[Run] = []
    notes = []
    for run in runs:
        same = next((each for each in (*others, *kept) if _alike(each, run)), None)
        if same is None:
            kept.append(run)
        else:
            notes.append(f'{run.source}: holds the same samples as {same.source}, and is left out')
    return kept, notes


def against_healthy(runs: Sequence[Run], healthy: Sequence[Run], drive: str | None) -> list[str]:
    """
    Return notes of new recordings that are healthy ones too: nothing can have changed.

    drive: as for `diagnose`; None: that of the healthy recordings. Raises InputError if the others
    do not hold its signals.
    """
    notes = []
    for before, run in itertools.product(healthy, runs):
        driving = ['reference'] if (drive or drive_of(healthy)) == 'position' else [
            'command', 'force']
        held = [[name in each.signals() for name in driving] for each in (before, run)]
        if held[0] != held[1]:
            raise InputError(
                f'{run.source}: the healthy recordings hold other signals: here '
                f'{" and ".join(run.signals())}, in {before.source} '
                f'{" and ".join(before.signals())}')
        if _alike(before, run):
            notes.append(f'{run.source}: holds the same samples as the healthy recording '
                         f'{before.source}, and is compared with itself')
    return notes


def _alike(one: Run, other: Run) -> bool:
    """Return whether two runs hold the same samples, in the same units."""
    a, b = one.signals(), other.signals()
    return len(one) == len(other) and a.keys() == b.keys() and all(
        np.array_equal(a[name], b[name], equal_nan=True) and one.unit(name) == other.unit(name)
        for name in a)
