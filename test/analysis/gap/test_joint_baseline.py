"""What has changed in a joint: one band for all recordings."""

from dataclasses import replace

import numpy as np
import pytest
from test_baseline import rigid
from test_gap_joint import PENDULUM, TIME_S, TWO_WAVES, WITH_RESTS, _soft_joint, joint

from asi_analysis.bags.run import Run
from asi_analysis.gap.answer.command import diagnose
from asi_analysis.gap.diagnose import diagnose as diagnosis_of
from asi_analysis.gap.motion import steady_band


def test_a_single_line_far_above_the_motion_is_no_band():
    time_s = 0.002 * np.arange(7000)
    wave = sum(np.sin(2.0 * np.pi * hz * time_s) / hz for hz in range(1, 14))
    noise = np.random.default_rng(1).normal(0.0, 0.01, time_s.size)
    assert steady_band(wave + noise, 0.01, 0.002) == pytest.approx(13.0, abs=1.0)
    line = 0.003 * np.sin(2.0 * np.pi * 90.0 * time_s)
    assert steady_band(wave + noise + line, 0.01, 0.002) == pytest.approx(13.0, abs=1.0)


def test_healthy_and_new_recordings_are_compared_in_one_band():
    quiet, noisy = rigid(0.02, 1), rigid(0.02, 2)
    noise = np.random.default_rng(1).normal(0.0, 1e-3, len(noisy))
    noisy = replace(noisy, position_m=noisy.position_m + noise)
    for new, known in ((quiet, noisy), (noisy, quiet)):
        healthy = diagnosis_of([known], {}, 'joint')
        answer = diagnosis_of([new], {}, 'joint', healthy=healthy)
        edges = {recording.motion.edge_hz for each in (answer, answer.healthy)
                 for recording in each.groups[-1].group.recordings}
        assert max(edges) < 1.05 * min(edges)
        assert answer.verdict == ()


def geared(gap: float, course: np.ndarray) -> Run:
    """Return 8 s of a motor that turns an arm by a gear with this half clearance (rad)."""
    out = np.empty((2, course.size))
    _soft_joint(course, 0.0, 2000.0, gap, out)
    count = 2.0 * np.pi / 2 ** 16
    return Run(TIME_S[:course.size], command_n=out[0], information=PENDULUM, source='gear',
               position_m=count * np.round(out[1] / count))


@pytest.mark.slow
@pytest.mark.filterwarnings('ignore')
def test_a_gear_that_has_worn_is_no_compliance():
    half = TIME_S.size // 2
    answer = diagnose([geared(0.03, WITH_RESTS[:half])], plant='joint',
                      baseline=[geared(1e-9, WITH_RESTS[half:])])
    assert 'backlash' in answer.verdict and 'load_compliance' not in answer.verdict
    assert any('rattles' in note for note in answer.notes)


@pytest.mark.parametrize(('push', 'seen', 'verdict', 'size'), [
    pytest.param(0.7, 1.0, 'drive_gain', 0.3, marks=pytest.mark.slow),
    (1.0, 1.3, 'position_gain', 0.3)])
@pytest.mark.filterwarnings('ignore:the joint has gravity', 'ignore:a constant')
def test_one_factor_of_the_command_or_the_motion_is_one_change(push, seen, verdict, size):
    """Inertia, friction and gravity all seem to have changed by it."""
    healthy = joint(friction=0.1, gravity=0.5, course=TWO_WAVES).between(0.0, 6.0)
    new = joint(friction=0.1, gravity=0.5).between(0.0, 6.0)
    new = replace(new, command_n=new.command_n / push, position_m=new.position_m * seen)
    answer = diagnose([new], plant='joint', baseline=[healthy])
    assert answer.verdict == verdict and answer.probability > 0.9
    value, = answer.which[0]['parameters'].values()
    assert value == pytest.approx(size, abs=0.03)
    assert f'gain of the {verdict.split("_")[0]}' in str(answer)


def test_a_band_ends_where_nothing_is_above_the_noise_not_at_the_first_gap():
    time = 0.004 * np.arange(4000)
    noise = 1e-3 * np.random.default_rng(1).standard_normal(time.size)
    slow = 0.6 * np.sin(2.0 * np.pi * 0.4 * time)
    assert steady_band(slow + noise, 1e-3, 0.004) < 8.0
    assert 12.0 < steady_band(
        slow + 0.03 * np.sin(2.0 * np.pi * 12.0 * time) + noise, 1e-3, 0.004) < 14.0
    assert steady_band(slow[:6], 1e-3, 0.004) >= 0.0
