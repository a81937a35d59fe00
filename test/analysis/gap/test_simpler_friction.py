"""Friction whose name promises more than its size: it is the simpler friction."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from asi_analysis.gap.inference import simpler
from asi_analysis.gap.inference.related import Candidate
from asi_analysis.gap.inference.simpler import as_simple_friction
from asi_analysis.gap.model.effects import UNKNOWN, Free

SIZES = {'stiction': Free('friction_breakaway', 0.25, 6.0, (1.0,)),
         'friction_asymmetry': Free('friction_asymmetry', -1.0, -0.15, (-0.4,))}


def found(names: tuple[str, ...], share: float = 0.5, constant: float = 0.0) -> Candidate:
    """Return a fit with the size of its friction at a share of its range."""
    free = tuple(SIZES[name] for name in names if name in SIZES)
    problem = SimpleNamespace(group=SimpleNamespace(recordings=[SimpleNamespace(taken={})]))
    fitted: Any = SimpleNamespace(
        free=free, theta=np.full(len(free), share), problem=problem,
        values={'friction_level': 1.0, 'load_offset': constant})
    return Candidate(names, (), fitted)


@pytest.mark.parametrize(('name', 'share', 'constant', 'reached', 'kept'), [
    ('stiction', 0.0, 0.0, False, 0.5),                # no more to break away than the least
    ('stiction', 0.3, 0.0, True, 0.5),
    ('stiction', 0.3, 0.0, False, 1.0),
    ('friction_asymmetry', 1.0, -0.5, False, 0.5),
    ('friction_asymmetry', 0.5, -0.5, False, 1.0),
    ('friction_asymmetry', 0.5, 0.05, False, 0.5)])    # its constant force is not there
def test_what_is_left_to_a_friction_of_its_probability(name, share, constant, reached, kept,
                                                       monkeypatch):
    monkeypatch.setattr(simpler, 'likelihood', lambda fitted: None)
    monkeypatch.setattr(simpler, 'end', lambda known, theta, number, bound: (
        bound if reached else 0.5))
    chance = {(name,): 0.6, (name, UNKNOWN): 0.3, ('coulomb_friction',): 0.1, (): 0.0}
    moved = as_simple_friction(chance, {
        (): found(()), (name,): found((name,), share),
        ('coulomb_friction',): found(('coulomb_friction',), constant=constant)})
    assert sum(moved.values()) == pytest.approx(1.0)
    assert moved[name,] == pytest.approx(0.6 * kept)
    assert moved.get(('coulomb_friction', UNKNOWN), 0.0) == pytest.approx(0.3 * (1.0 - kept))


def test_without_the_simpler_one_nothing_is_moved():
    chance = {('stiction',): 0.9, (): 0.1}
    assert as_simple_friction(chance, {(): found(()), ('stiction',): found(
        ('stiction',), 0.0)}) == chance
