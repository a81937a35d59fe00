"""The initial guess of a load behind a spring."""

import numpy as np
import pytest

from asi_analysis.bags.run import Run
from asi_analysis.gap.diagnose import diagnose
from asi_analysis.gap.model.coupling import guessed_coupling
from asi_analysis.gap.prepare import prepare

PERIOD_S = 0.002
MOTOR, LOAD, SPRING = 0.07, 0.05, 38.0


def two_masses(spring: float = SPRING, noise: float = 5e-5) -> Run:
    """Return the recording of a motor and a load behind a spring under a chirp, 0.5 to 12 Hz."""
    time = PERIOD_S * np.arange(8000)
    torque = np.sin(2.0 * np.pi * (0.5 * time + 0.36 * time ** 2))
    state, place = np.zeros(4), []   # angle and speed of the motor, and of the load
    for k in range(time.size):
        place.append(state[0])
        for _ in range(8):
            pull = spring * (state[0] - state[2]) + 0.08 * (state[1] - state[3])
            state[1] += PERIOD_S / 8 / MOTOR * (torque[k] - 0.1 * state[1] - pull)
            state[3] += PERIOD_S / 8 / LOAD * (pull - 0.02 * state[3])
            state[[0, 2]] += PERIOD_S / 8 * state[[1, 3]]
    position = np.array(place) + np.random.default_rng(3).normal(0.0, noise, time.size)
    return Run(time, command_n=torque, position_m=position, source='two masses',
               information={'signals': {'command': 'Nm', 'position': 'rad'}})


def test_a_load_behind_a_spring_is_guessed_from_the_response() -> None:
    guess = guessed_coupling(prepare([two_masses()], 'force', [False]))
    assert guess is not None
    assert guess.compliance == pytest.approx(1.0 / SPRING, rel=0.5)
    assert guess.mass == pytest.approx(MOTOR + LOAD, rel=0.5)
    assert guess.share == pytest.approx(MOTOR / (MOTOR + LOAD), rel=0.5)


@pytest.mark.slow
@pytest.mark.filterwarnings('ignore')
def test_a_compliance_in_the_middle_of_a_chirp_is_named_with_its_size() -> None:
    answer = diagnose([two_masses()], {}, 'joint')
    assert answer.verdict == ('load_compliance',)
    found = answer.groups[-1].candidates[answer.verdict].fitted.values
    assert found['compliance'] == pytest.approx(1.0 / SPRING, rel=0.02)
