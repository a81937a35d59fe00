"""The examiner's refit: a load that drifts is explained by the parameters that it has."""

import numpy as np
import pytest

from asi_examiner.refit import refitted

PERIOD_S, COUNT = 1e-2, 800


def drifted(factors, share):
    """Return the position of a driven mass over a share of the time, in multiples of its noise."""
    thrust, damping, friction = np.array([1.0, 0.5, 0.1]) * factors
    count = int(share * COUNT)
    drive = np.sign(np.sin(0.1 * np.arange(count))) + 0.3 * np.sin(0.037 * np.arange(count))
    position = np.zeros(count)
    speed = 0.0
    for k in range(1, count):
        rubbing = friction * np.tanh(50.0 * speed)
        speed += PERIOD_S * (thrust * drive[k] - damping * speed - rubbing)
        position[k] = position[k - 1] + PERIOD_S * speed
    return position / 1e-5


@pytest.mark.parametrize('true', [(1.15, 0.85, 1.1), (0.82, 1.1, 0.9)])
def test_parameters_within_the_tolerance_explain_a_drift(true):
    def missed(factors, share):
        return drifted(factors, share) - drifted(np.array(true), share)

    found = refitted(missed, 3, 0.2)
    np.testing.assert_allclose(found, true, rtol=1e-4)
    assert np.sqrt(np.mean(missed(found, 1.0) ** 2)) < 0.1


def test_a_parameter_beyond_the_tolerance_is_not_explained():
    def missed(factors, share):
        return drifted(factors, share) - drifted(np.array([1.0, 1.0, 3.0]), share)

    found = refitted(missed, 3, 0.2)
    assert np.all((found >= 0.8) & (found <= 1.2))
    assert np.sqrt(np.mean(missed(found, 1.0) ** 2)) > 100.0
