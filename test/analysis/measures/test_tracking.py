"""Tracking error, command and impedance of signals whose figures are known."""

import numpy as np
import pytest

from asi_analysis.bags.run import Run
from asi_analysis.loop.closed_loop import simulate_loop
from asi_analysis.measures.analysis import analyze
from asi_analysis.measures.tracking import tracking

T = np.arange(4000) / 1000.0


def test_error_of_a_late_sine():
    reference = 50.0 + 100.0 * np.sin(2.0 * np.pi * 5.0 * T)
    force = 50.0 + 100.0 * np.sin(2.0 * np.pi * 5.0 * T - 0.2)
    found = tracking(Run(T, reference_n=reference, force_n=force, command_n=reference))
    share = 2.0 * np.sin(0.1)   # of two phasors that are 0.2 rad apart
    assert found.tracking_error_percent == pytest.approx(100.0 * share, rel=1e-6)
    assert found.tracking_error_rms_n == pytest.approx(100.0 / np.sqrt(2.0) * share, rel=1e-6)
    assert found.tracking_error_peak_n == pytest.approx(100.0 * share, rel=1e-3)
    assert found.command_rms_n == pytest.approx(np.sqrt(50.0 ** 2 + 5000.0), rel=1e-6)


def test_a_reference_that_stands_still_has_no_share():
    found = tracking(Run(T, reference_n=np.full(T.size, 80.0), force_n=np.full(T.size, 79.0)))
    assert found.tracking_error_rms_n == pytest.approx(1.0)
    assert found.tracking_error_percent is None and found.impedance_hz is None


def test_impedance_of_a_mass_and_a_damper():
    w = 2.0 * np.pi * 2.0
    velocity = 0.1 * np.sin(w * T)
    force = -(300.0 * velocity + 2.0 * 0.1 * w * np.cos(w * T))   # against the motion
    found = tracking(Run(T, reference_n=np.zeros(T.size), force_n=force, velocity_m_s=velocity))
    assert found.impedance_hz == pytest.approx(2.0)
    assert found.impedance_real == pytest.approx(300.0, rel=1e-3)
    assert found.impedance_imaginary == pytest.approx(2.0 * w, rel=1e-3)


def test_impedance_of_the_driven_back_actuator_is_its_damping():
    moved = {'load.type': 'prescribed', 'load.velocity': 0.02, 'load.frequency': 2.0}
    run = Run(**simulate_loop(moved, {'gain': 1e-6, 'compensator': 'proportional',
                                      'reference.shape': 'step', 'reference.amplitude': 0.0},
                              3.0, 1000.0)._asdict())
    found = analyze(run)
    assert found.impedance_real > 300.0   # against the motion, as any damping
    assert found.tracking_error_peak_n == pytest.approx(np.abs(run.force_n).max())


def test_nothing_recorded_nothing_told():
    assert tracking(Run(T, force_n=np.ones(T.size))) == (None,) * 7


def test_a_command_of_missing_samples_has_no_size() -> None:
    missing = np.full(50, np.nan)
    run = Run(np.arange(50) / 100.0, np.ones(50), missing, np.ones(50))
    assert analyze(run).command_rms_n is None


def test_a_velocity_of_few_digits_is_told_once_and_rounding_errors_at_rest_are_not() -> None:
    steps = np.round(9.0 * np.sin(2.0 * np.pi * 2.0 * T))
    force = 50.0 * np.sin(2.0 * np.pi * 2.0 * T) + np.random.default_rng(1).normal(size=T.size)
    for resolution, told in ((0.01, 1), (2.465e-32, 0)):
        found = analyze(Run(T, reference_n=np.zeros(T.size), force_n=force,
                            velocity_m_s=resolution * steps))
        said = [note for note in found.notes if 'different values' in note]
        assert len(said) == told, said
