"""Bandwidth and delay where a record begins and ends amid the motion of its reference."""

import numpy as np
import pytest
from scipy import signal

from asi_analysis.bags.run import Run
from asi_analysis.measures.analysis import analyze
from asi_analysis.measures.correlation import correlation_delay
from asi_analysis.measures.frequency_response import estimate

RATE_HZ = 500.0
CUT_HZ = 8.0


def first_order(x):
    """Return the response of a lag with a bandwidth of CUT_HZ that rested at the first value."""
    fine = np.interp(np.arange(8 * x.size) / 8.0, np.arange(x.size), x)
    pole = np.exp(-2.0 * np.pi * CUT_HZ / RATE_HZ / 8.0)
    return signal.lfilter([1.0 - pole], [1.0, -pole], fine, zi=[pole * fine[0]])[0][::8]


def sweep(first_hz, last_hz, phase_deg=0.0, seconds=20.0):
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    return signal.chirp(t, first_hz, seconds, last_hz, phi=phase_deg)


@pytest.mark.parametrize('first_hz, last_hz', [(0.5, 40.0), (40.0, 0.5), (0.5, 25.0)])
@pytest.mark.parametrize('phase_deg', [0.0, -90.0, 130.0])
@pytest.mark.parametrize('late', [0, 10])
def test_a_chirp_may_begin_and_end_at_any_phase(first_hz, last_hz, phase_deg, late):
    # By the spectrum of the record as if it repeated, the bandwidth was up to 20 % off.
    x = sweep(first_hz, last_hz, phase_deg)
    y = 3.0 + np.concatenate([np.full(late, x[0]), first_order(x)])[:x.size]
    found = estimate(x, y, 1.0 / RATE_HZ)
    assert found.bandwidth_hz == pytest.approx(CUT_HZ, rel=0.05)
    angular = 2.0 * np.pi * found.frequency_hz[found.frequency_hz < CUT_HZ]
    lag = np.sum(angular * np.arctan(angular / (2.0 * np.pi * CUT_HZ))) / np.sum(angular ** 2)
    assert found.delay_s == pytest.approx(lag + late / RATE_HZ, abs=0.5 / RATE_HZ)


def test_a_bandwidth_from_frequencies_that_are_not_low_is_doubtful():
    x = sweep(4.0, 40.0)
    found = analyze(Run(np.arange(x.size) / RATE_HZ, reference_n=x, force_n=first_order(x)))
    assert found.reliable['bandwidth_hz'] is False
    assert any('the lowest frequencies that are excited' in each for each in found.notes)


def test_a_lag_that_suits_a_later_repetition_is_no_delay():
    # It was 306 samples for 7, as these tones nearly repeat after 300.
    t, rng = np.arange(6000) / 1000.0, np.random.default_rng(3)
    tones = (5.0 + 4.0 * np.arange(60)) / 1.2
    x = sum(np.sin(2.0 * np.pi * hz * t + phase)
            for hz, phase in zip(tones, rng.uniform(0.0, 6.28, tones.size), strict=True))
    y = signal.lfilter(*signal.butter(1, 30.0, fs=1000.0), np.append(np.zeros(6), x)[:x.size])
    y += 0.05 * y.std() * rng.standard_normal(y.size)
    assert 1000.0 * correlation_delay(x, y, 1e-3) == pytest.approx(7.5, abs=0.5)
