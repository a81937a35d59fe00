"""Margins: against python-control, and against the simulated loop."""

import control
import numpy as np
import pytest

from asi_analysis.tuning.margins import _of, margins, moved_gain
from asi_controller.additions.gain_schedule import scheduled


@pytest.mark.parametrize(('gain', 'poles'), [(2.0, [1.0, 1.0, 1.0]), (30.0, [0.5, 4.0, 9.0]),
                                             (10.0, [1.0, 1.0, 1.0])])
def test_margins_are_those_of_python_control(gain, poles):
    loop = control.tf(gain * np.prod(poles), np.poly(-np.array(poles)))
    omega = np.geomspace(1e-2, 1e3, 20_000)
    found = _of(omega / (2.0 * np.pi), loop(1j * omega))
    gain_margin, phase_margin, at, _ = control.margin(loop)
    assert found[0] == pytest.approx(gain_margin, rel=1e-3)
    assert found[1] == pytest.approx(at / (2.0 * np.pi), rel=1e-3)
    assert found[2] == pytest.approx(phase_margin, abs=0.1)
    sensitivity = control.feedback(1, loop)
    balanced = 2.0 * sensitivity - 1.0   # S - T
    disk = 2.0 / np.abs(balanced(1j * omega)).max() if gain_margin > 1.0 else 0.0
    assert found[3] == pytest.approx(disk, rel=1e-6)


def test_loop_without_a_crossing_has_no_such_margin():
    omega = np.geomspace(1e-2, 1e3, 1000)
    assert _of(omega, 0.5 / (1j * omega + 1.0))[:3] == (None, None, None)


def test_moved_actuator_answers_the_command_with_more_force():
    """The figures of the docstring of gain_schedule.py."""
    assert [moved_gain({}, velocity) for velocity in (0.0, 0.2, 0.4, 0.6)] == pytest.approx(
        [1.0, 1.65, 1.56, 1.66], rel=0.01)


def test_schedule_gives_back_the_margin_that_the_motion_takes():
    plain = margins({}, {'gain': 3.0}, 5000.0)
    half, least = 0.2, 0.1
    held = margins({}, {'gain': 3.0, 'gain_schedule.velocity': half,
                        'gain_schedule.least': least}, 5000.0)
    assert held[0] == plain[0]
    for one, other in zip(plain[1:], held[1:], strict=True):
        assert one.gain == pytest.approx(other.gain * scheduled(one.velocity_m_s, half, least))
        assert one.gain == pytest.approx(plain[0].gain / moved_gain({}, one.velocity_m_s))


def test_the_integrator_is_not_scheduled():
    """At the crossing of the gain it then takes more of the phase."""
    values = {'gain': 1.0, 'integrator.rate': 60.0}
    still, = margins({}, values, 5000.0)[:1]
    moved = margins({}, values | {'gain_schedule.velocity': 1e-6, 'gain_schedule.least': 0.2},
                    5000.0)
    assert moved[0] == still
    scaled = margins({}, {'gain': 0.2, 'integrator.rate': 60.0}, 5000.0)
    assert moved[1].phase_deg == pytest.approx(scaled[1].phase_deg, abs=0.1)
