"""Free parameters: vector and dictionary are each other's inverse; bounds."""

import numpy as np
import pytest

from asi_analysis.free_parameter import FreeParameter, Scale, to_values, to_vector

SOME = (FreeParameter('a', 2.0, 1.0, 100.0, Scale.LOG),
        FreeParameter('b', -1.0, -3.0, 5.0))


def test_vector_and_values_are_inverse():
    vector = np.array([0.25, 0.75])
    values = to_values(SOME, vector)
    assert values == pytest.approx({'a': 100.0**0.25, 'b': 3.0})
    assert to_vector(SOME, values) == pytest.approx(vector)


def test_outside_the_bounds_and_missing():
    assert to_vector(SOME, {'a': 0.5}) == pytest.approx([0.0, 0.25])
    assert to_values(SOME, np.array([-1.0, 2.0])) == {'a': 1.0, 'b': 5.0}
