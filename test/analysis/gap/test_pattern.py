"""What a model leaves, if it is a function of what was recorded: something is missing in it."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from asi_analysis.bags.run import Run
from asi_analysis.gap.answer.joint_model import joint_model, node_parameters
from asi_analysis.gap.diagnose import Diagnosis, diagnose
from asi_analysis.gap.findings.pattern import pattern
from asi_analysis.gap.model.joint import joint_groups

PERIOD_S = 0.004
Law = Callable[[float, float], float]
MASS, NOISE_M = 0.5, 1e-4


def joint(more: Law, origin: float = 0.0, unit: float = 1.0) -> Run:
    """Return the recording of a mass with damping and a further force; more: of place, speed."""
    time, rng = PERIOD_S * np.arange(4000), np.random.default_rng(5)
    force = 3.0 * sum(np.sin(2.0 * np.pi * f * time + 3.0 * f) for f in (0.4, 0.9, 1.7, 3.1))
    q, v, place = 0.0, 0.0, []
    for k in range(time.size):
        place.append(q)
        for _ in range(10):
            v += 0.1 * PERIOD_S / MASS * (force[k] - 2.0 * v - 20.0 * q - more(q, v))
            q += 0.1 * PERIOD_S * v
    position = np.array(place) + rng.normal(0.0, NOISE_M, time.size) + origin
    return Run(time, command_n=unit * force, position_m=position, source='joint',
               information={'signals': {'command': 'N', 'position': 'm'}})


def asked(run: Run) -> Diagnosis:
    return diagnose([run], {}, 'joint')


def shares(diagnosis: Diagnosis) -> dict[tuple[str, ...], float]:
    """Return the pattern that each fitted hypothesis leaves."""
    weighed = diagnosis.groups[-1]
    return {names: pattern(weighed.group, 'load', found.fitted.record).share
            for names, found in weighed.candidates.items()}


def hardening(q: float, v: float) -> float:
    return 120.0 * q ** 3


def drag(q: float, v: float) -> float:
    return 1.5 * v ** 3


def friction(q: float, v: float) -> float:
    return 1.2 * float(np.tanh(v / 0.003))


def lubricated(q: float, v: float) -> float:
    return 1.2 * float(np.tanh(v / 0.1))


@pytest.mark.slow   # test_what_has_no_name_may_still_come_closer_as_a_model has another
@pytest.mark.parametrize(('more', 'origin', 'unit'), [
    (drag, 0.0, 1.0), (drag, -7.0, 1000.0), (hardening, 0.0, 1.0)])
@pytest.mark.filterwarnings('ignore')   # a constant force is subtracted, there is a spring
def test_a_law_that_has_no_name_is_unknown(more: Law, origin: float, unit: float) -> None:
    found = asked(joint(more, origin, unit))
    assert found.verdict == ('unknown',) and found.joined[found.verdict] > 0.9
    assert shares(found)[()] > 0.5


@pytest.mark.parametrize('law', [pytest.param(friction, marks=pytest.mark.slow), lubricated])
@pytest.mark.filterwarnings('ignore')
def test_the_right_friction_leaves_no_pattern(law: Law) -> None:
    found = asked(joint(law))
    assert 'unknown' not in found.verdict and len(found.verdict) == 1
    assert shares(found)[()] > 0.5 and shares(found)[found.verdict] < 0.3


@pytest.mark.filterwarnings('ignore')
def test_friction_that_rises_with_the_velocity_is_coulomb_friction() -> None:
    found = asked(joint(lubricated))
    assert found.verdict == ('coulomb_friction',) and found.joined[found.verdict] > 0.85
    assert found.best(found.groups[-1]).fitted.values['friction_creep'] == pytest.approx(0.1, 0.1)
    assert found.best(found.groups[-1]).fitted.values['friction_level'] == pytest.approx(1.2, 0.02)
    # In another simulator it is dry friction, of which no stiffness is known.
    assert joint_model(found).friction == pytest.approx(1.2, 0.02)
    values, said, unsaid = node_parameters(found, {})
    assert values['friction.coulomb'] == pytest.approx(1.2, 0.02)
    assert 'friction.presliding_stiffness' not in values
    assert any('velocity over which' in each for each in unsaid) and said


@pytest.mark.filterwarnings('ignore')
def test_what_has_no_name_may_still_come_closer_as_a_model() -> None:
    """Drag by the square of the speed, the friction that comes closest: no improved model was."""
    found = asked(joint(lambda q, v: 2.0 * v * abs(v)))
    assert 'unknown' in found.verdict and found.best(found.groups[-1]).names
    assert found.shrinks[0].shrink > 0.3


def test_only_one_of_two_recordings_may_hold_the_position() -> None:
    first = joint(lambda q, v: 0.0)
    second = replace(first, position_m=None, information={'signals': {
        'command': 'N', 'velocity': 'm/s'}}, velocity_m_s=np.gradient(first.position_m, PERIOD_S))
    for runs in ([first, second], [second, first]):
        groups, _ = joint_groups(runs, {}, 0.2, [False, False], 'force')
        assert 0.0 <= pattern(groups[-1], 'load', groups[-1].nominal).share <= 1.0
