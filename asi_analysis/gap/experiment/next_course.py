"""Choose the input course that best separates the hypotheses about a static characteristic."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from scipy.signal import sawtooth

from asi_analysis.arrays import Array
from asi_analysis.gap.course import rates
from asi_analysis.gap.experiment.next_experiment import pairs_of, separation
from asi_analysis.gap.inference.hypotheses import Weighed
from asi_analysis.gap.inference.probability import Names
from asi_analysis.gap.model.effects import UNKNOWN
from asi_analysis.gap.model.group import Group
from asi_analysis.gap.prepare import Recording

SAMPLES: Final = 2000
CYCLES: Final = 3
LEAST_SEPARATION: Final = 2.0   # rms difference of two predictions, in error floors


def _triangle(turns: Array) -> Array:
    return np.asarray(sawtooth(2.0 * np.pi * (turns + 0.25), 0.5))


def _stairs(turns: Array) -> Array:
    return np.round(5.0 * _triangle(turns)) / 5.0


def _growing(turns: Array) -> Array:
    return _triangle(turns) * (1.0 + np.floor(turns)) / CYCLES


# A course as a function of the cycles passed, and its rate as a multiple of the recording's.
CATALOGUE: Final[dict[str, tuple[Callable[[Array], Array], float]]] = {
    'the same range four times as fast': (_triangle, 4.0),
    'the same range at a quarter of the rate': (_triangle, 0.25),
    'triangles of growing size': (_growing, 1.0),
    'a staircase of ten steps up and down, with rests': (_stairs, 1.0),
    'the same again': (_triangle, 1.0)}


def choose_course(groups: Sequence[Weighed], ambiguous: list[Names]) -> dict[str, object] | None:
    """
    Return the course of the catalogue that separates most pairs of the hypotheses `ambiguous`.

    Among courses that separate equally many, the one with the largest separation of its worst
    pair. None if there is nothing to separate.
    """
    pairs = pairs_of(list(groups), ambiguous) if len(ambiguous) > 1 else []
    if not pairs:
        return None
    apart = {name: [separation(group, course(group, name), a, b) for group, a, b in pairs]
             for name in CATALOGUE}
    worst = {name: min(each) for name, each in apart.items()}

    def separated(name: str) -> int:
        return sum(each >= LEAST_SEPARATION for each in apart[name])

    best = max(CATALOGUE, key=lambda name: (separated(name), worst[name]))
    count = separated(best)
    advice = ('no course of this input separates them' if not count else
              f'record this in addition: {best}' + ('' if count == len(pairs) else
                                                  ', which separates some of them'))
    if any(UNKNOWN in names for names in ambiguous) and count < len(pairs):
        advice += '; measure what may also act on the output (temperature, supply, load)'
    return {'excitation': best, 'separation': worst[best], 'separations': worst,
            'command': None, 'separates': count == len(pairs), 'advice': advice}


def course(group: Group, name: str) -> Recording:
    """Return a recording of a course of the catalogue, over the range of the first recording."""
    known = group.recordings[0]
    shape, faster = CATALOGUE[name]
    reach, middle = 0.5 * float(np.ptp(known.input)), 0.5 * float(
        known.input.min() + known.input.max())
    found = rates(known)
    rate = faster * (float(np.median(found)) if found.size else reach / known.period_s / SAMPLES)
    period = CYCLES * 4.0 * reach / rate / SAMPLES
    given = middle + reach * shape(np.linspace(0.0, CYCLES, SAMPLES))
    used = np.ones(SAMPLES, bool)
    return replace(known, command=given, valve_position=given, period_s=period, number=0,
                   fit=used, held_out=~used, report=~used, cache={})
