"""The lead-lag with a notch: the notch is where, as deep and as wide as its parameters say."""

import math

import control
import numpy as np
import pytest

from asi_common.parameter import Value
from asi_controller.compensator import compensator, design, frequency_response

WITHOUT: dict[str, Value] = {'compensator': 'lead_lag', 'gain': 5.0}


def with_notch(frequency: float, depth: float, width: float) -> dict[str, Value]:
    return {'compensator': 'lead_lag_notch', 'gain': 5.0,
            'lead_lag_notch.notch_frequency': frequency, 'lead_lag_notch.notch_depth': depth,
            'lead_lag_notch.notch_width': width}


@pytest.mark.parametrize(('frequency', 'depth', 'width'), [
    (321.0, 0.3, 100.0), (60.0, 0.05, 5.0), (200.0, 1.0, 50.0), (100.0, 0.5, 500.0)])
def test_notch_divides_the_response_of_the_lead_lag(frequency: float, depth: float, width: float
                                                    ) -> None:
    def gains(values: dict[str, Value], frequencies: list[float]) -> np.ndarray:
        zeros, poles, gain = design(values)
        system = control.zpk(zeros, poles, 1.0)
        return np.abs(gain / system.dcgain() * system(2j * np.pi * np.array(frequencies)))

    edges = [math.hypot(frequency, 0.5 * width) + side * 0.5 * width for side in (-1, 1)]
    frequencies = [1e-3 * frequency, frequency, *edges, 1e4 * frequency]
    edge = math.sqrt(0.5 * (1.0 + depth**2))
    ratio = gains(with_notch(frequency, depth, width), frequencies) / gains(WITHOUT, frequencies)
    np.testing.assert_allclose(ratio, [1.0, depth, edge, edge, 1.0], rtol=1e-3)


def test_notch_is_there_at_the_control_rate() -> None:
    deep = with_notch(90.0, 0.1, 30.0)   # where the discrete response is that of the design
    ratio = (frequency_response(compensator(deep, 5000.0), [90.0], 5000.0)
             / frequency_response(compensator(WITHOUT, 5000.0), [90.0], 5000.0))
    assert abs(ratio[0]) == pytest.approx(0.1, rel=1e-6)
