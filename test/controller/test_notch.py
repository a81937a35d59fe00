"""The notch: it is where, as deep and as wide as its parameters say, behind any compensator."""

import math

import control
import numpy as np
import pytest

from asi_common.parameter import ParameterError, Value
from asi_controller.compensator import compensator, design, frequency_response


def with_notch(frequency: float, depth: float, width: float) -> dict[str, Value]:
    return {'notch.frequency': frequency, 'notch.depth': depth, 'notch.width': width}


@pytest.mark.parametrize(('without', 'frequency', 'depth', 'width'), [
    ('lead_lag', 321.0, 0.3, 100.0), ('proportional', 60.0, 0.05, 5.0),
    ('lead4', 200.0, 1.0, 50.0), ('lead_lag', 100.0, 0.5, 500.0)])
def test_notch_divides_the_response_of_the_compensator(
        without: str, frequency: float, depth: float, width: float) -> None:
    def gains(values: dict[str, Value], frequencies: list[float]) -> np.ndarray:
        zeros, poles, gain = design({'compensator': without, 'gain': 5.0, **values})
        system = control.zpk(zeros, poles, 1.0)
        return np.abs(gain / system.dcgain() * system(2j * np.pi * np.array(frequencies)))

    edges = [math.hypot(frequency, 0.5 * width) + side * 0.5 * width for side in (-1, 1)]
    frequencies = [1e-3 * frequency, frequency, *edges, 1e4 * frequency]
    edge = math.sqrt(0.5 * (1.0 + depth**2))
    ratio = gains(with_notch(frequency, depth, width), frequencies) / gains({}, frequencies)
    np.testing.assert_allclose(ratio, [1.0, depth, edge, edge, 1.0], rtol=1e-3)


@pytest.mark.parametrize('without', [
    {'compensator': 'lead_lag'}, {'compensator': 'proportional'},
    {'compensator': 'custom', 'custom.poles': ', '.join(['-5000'] * 16)}])
@pytest.mark.parametrize(('frequency', 'rate'), [(90.0, 5000.0), (300.0, 1000.0),
                                                 (470.0, 1000.0), (2000.0, 5000.0)])
def test_notch_is_there_at_the_control_rate(
        without: dict[str, Value], frequency: float, rate: float) -> None:
    # Without its own prewarping, that at 300 Hz was at 245 Hz.
    depth, width = 0.1, 30.0
    at = np.linspace(1.0, 0.499 * rate, 10**5)
    response, rest = (frequency_response(compensator(each, rate), at, rate)
                      for each in (without | with_notch(frequency, depth, width), without))
    ratio = np.abs(response / rest)
    assert at[ratio.argmin()] == pytest.approx(frequency, abs=0.1)
    assert ratio.min() == pytest.approx(depth, rel=1e-3)
    inside = at[ratio < math.sqrt(0.5 * (1.0 + depth**2))]
    assert np.ptp(inside) == pytest.approx(width, abs=0.1)


@pytest.mark.parametrize('wrong', [with_notch(500.0, 0.3, 100.0), with_notch(200.0, 0.3, 500.0)])
def test_notch_that_the_control_rate_does_not_allow_is_refused(wrong: dict[str, Value]) -> None:
    with pytest.raises(ParameterError, match=r'notch\..* = 500 is not allowed at a control rate '
                                             r'of 1000 Hz'):
        compensator(wrong, 1000.0)
    compensator(wrong, 5000.0)


def test_notch_so_slow_that_it_is_none_is_refused() -> None:
    for frequency in (1e-300, 0.99):
        with pytest.raises(ParameterError, match=r'notch\.frequency = .* at least 1 Hz'):
            design(with_notch(frequency, 0.3, 100.0))
