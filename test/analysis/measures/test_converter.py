"""A bit that a converter lacks is told; the codes of one that has all are not accused."""

import numpy as np
import pytest

from asi_analysis.bags.run import Run
from asi_analysis.measures.checks.converter import missing_bit
from asi_analysis.measures.quality import findings

STEP_N = 240.0 / 4096


def codes(shape: str = 'triangle') -> np.ndarray:
    """Return the codes of a converter of 12 bits: a force with noise, 2 s at 1 kHz."""
    t = np.arange(2000) / 1000.0
    t_step = np.maximum(t - 0.3, 0.0)
    force = {'triangle': 100.0 * np.abs((2.0 * t) % 2.0 - 1.0),
             'step': 100.0 * (1.0 - np.exp(-20.0 * t_step) * np.cos(30.0 * t_step))}[shape]
    noise = 0.3 * np.random.default_rng(1).normal(size=len(t))
    return np.round((force + noise) / STEP_N).astype(int) + 2048


@pytest.mark.parametrize(('shape', 'bit'), [
    ('triangle', 2), ('triangle', 5), ('triangle', 8), ('step', 2), ('step', 5)])
@pytest.mark.parametrize('stuck', [0, 1])
@pytest.mark.parametrize('digits', [17, 6])
def test_a_missing_bit_is_found(shape: str, bit: int, stuck: int, digits: int) -> None:
    """Whether it is always 0 or always 1; also in a text file."""
    all_bits = codes(shape)
    altered = all_bits | (1 << bit) if stuck else all_bits & ~(1 << bit)
    for each, expected in ((all_bits, None), (altered, bit)):
        force = np.array([float(f'{value:.{digits}g}') for value in STEP_N * (each - 2048)])
        found = missing_bit(force)
        assert (found and found.bit) == expected
    assert found is not None
    assert found.width == pytest.approx(STEP_N * 2 ** bit, rel=1e-3)


@pytest.mark.parametrize('values', [
    np.random.default_rng(2).normal(size=2000),                         # no converter
    np.repeat([0.0, 5.0, 10.0, 15.0], 100),                             # a staircase
    np.round(np.linspace(0.0, 50.0, 500)) * 16,                         # its lowest bits unused
    np.round(1e3 * np.exp(-np.arange(300) / 20.0)),                     # gaps where it is fast
    np.where(np.arange(900) % 9 < 5, 0.0, 1.0) + np.arange(900) % 2 * 8,    # two levels
    np.zeros(100), np.array([1.0, 2.0])])
def test_other_gaps_are_no_missing_bit(values: np.ndarray) -> None:
    assert missing_bit(values) is None


@pytest.mark.parametrize(('bit', 'severities'), [
    (None, []), (3, ['note']), (8, ['doubtful'])])
def test_a_missing_bit_is_doubtful_if_it_is_large(bit: int | None, severities: list[str]) -> None:
    lacking = codes() if bit is None else codes() & ~(1 << bit)
    run = Run(np.arange(len(lacking)) / 1000.0, None, None, STEP_N * (lacking - 2048))
    assert [each.severity for each in findings(run) if each.kind == 'bit'] == severities
