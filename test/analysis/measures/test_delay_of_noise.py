"""A reference of noise with jumps: its delayed answer is no damaged recording."""

import numpy as np
import pytest
from scipy import signal

from asi_analysis.bags.run import Run
from asi_analysis.measures.analysis import analyze


@pytest.mark.parametrize('seed, jumps, lag', [(7, 2, 0), (8, 2, 0), (10, 2, 0), (26, 40, 0),
                                              (19, 40, 5)])
def test_the_delay_behind_noise_with_jumps_is_told(seed, jumps, lag):
    # It was withheld: the position jumps, or changes before its reference.
    rng, count, late = np.random.default_rng(seed), 4000, 25
    x = signal.sosfilt(signal.butter(2, 0.02, output='sos'), rng.standard_normal(count))
    x = x / x.std() + np.repeat(rng.uniform(-3.0, 3.0, jumps + 1), count // jumps)[:count]
    y = np.append(np.full(late, x[0]), x)[:count]
    if lag:
        pole = np.exp(-1.0 / lag)
        y = signal.lfilter([1.0 - pole], [1.0, -pole], y, zi=[pole * y[0]])[0]
    y += 0.01 * y.std() * rng.standard_normal(count)
    found = analyze(Run(np.arange(count) / 1000.0, reference_n=x, position_m=y,
                        information={'signals': {'reference': 'm'}}))
    assert not found.quality
    assert 1000.0 * found.correlation_delay_s == pytest.approx(late + lag, abs=2.0)
    assert found.reliable['delay_s'] and found.reliable['correlation_delay_s']


def test_a_jump_of_the_signal_alone_is_still_told():
    rng, count, late = np.random.default_rng(7), 4000, 25
    x = signal.sosfilt(signal.butter(2, 0.02, output='sos'), rng.standard_normal(count))
    x = x / x.std() + np.repeat(rng.uniform(-3.0, 3.0, 3), 2000)[:count]
    y = np.append(np.full(late, x[0]), x)[:count] + 0.01 * rng.standard_normal(count)
    y[1200:] += 3.0
    found = analyze(Run(np.arange(count) / 1000.0, reference_n=x, position_m=y,
                        information={'signals': {'reference': 'm'}}))
    assert any(each['kind'] == 'jump' for each in found.quality)
