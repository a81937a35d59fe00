"""The second-order sections against those of scipy."""

import numpy as np
import pytest
from scipy import signal

from asi_controller.sections import second_order_sections


def roots(rng: np.random.Generator, count: int) -> list[complex]:
    """Return roots within the unit circle: pairs, real ones, and some of these twice."""
    found: list[complex] = []
    while len(found) < count:
        x, y = rng.uniform(-0.7, 0.7, 2)
        kinds = [[x + 1j * y, x - 1j * y], [x], [x, x]]
        found += kinds[rng.integers(3)] if len(found) + 1 < count else [x]
    return found


@pytest.mark.parametrize('poles', range(1, 12))
def test_sections_are_those_of_scipy_to_the_last_bit(poles: int) -> None:
    rng = np.random.default_rng(poles)
    for zeros in range(poles + 1):
        z, p = roots(rng, zeros) + [-1.0] * (poles - zeros), roots(rng, poles)
        np.testing.assert_array_equal(second_order_sections(z, p), signal.zpk2sos(z, p, 1.0))


@pytest.mark.parametrize('poles', [[0.5 + 0.1j, 0.5], [0.5 + 0.1j, 0.5 - 0.2j]])
def test_a_root_without_its_conjugate_is_refused(poles: list[complex]) -> None:
    with pytest.raises(ValueError, match='conjugate'):
        second_order_sections([-1.0, -1.0], poles)
