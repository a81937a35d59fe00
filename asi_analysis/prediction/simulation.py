"""Cycles of the simulated loop: to begin harmonic balance from, and to judge it by."""

import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from asi_actuator.parameters import Value, as_record
from asi_analysis.closed_loop import LoopRun, simulate_loop, simulate_loops
from asi_analysis.limit_cycle.sinusoid import Oscillation, fit
from asi_analysis.prediction.harmonic_balance import Balance, Loop
from asi_controller.compensator import compensator
from asi_controller.parameters import REFERENCE_PARAMETERS

Values = Mapping[str, Value]
# A step is watched so long, and the cycle is measured over the last part.
WATCHED_S: Final = 1.0
MEASURED_S: Final = 0.35
# A cycle keeps this share of its amplitude over the measured part, and is larger than this.
KEEPS: Final = 0.97
LEAST_N: Final = 0.5


def loop_of(actuator: Values, controller: Values, rate_hz: float) -> Loop:
    """Return what harmonic balance needs, from parameters by name."""
    names = {parameter.name for parameter in REFERENCE_PARAMETERS}
    gains = {name: value for name, value in controller.items() if name not in names}
    reference = (float(controller.get('reference.amplitude', 100.0))
                 + float(controller.get('reference.offset', 0.0)))
    return Loop(as_record(actuator), compensator(gains, rate_hz), 1.0 / rate_hz, reference)


def step_run(actuator: Values, controller: Values, rate_hz: float,
             duration_s: float = WATCHED_S) -> LoopRun:
    """Return the loop's answer to a step of its reference."""
    return simulate_loop(actuator, _stepped(controller), duration_s, rate_hz)


def step_swings(actuators: Sequence[Values], controllers: Sequence[Values], rate_hz: float
                ) -> list[Oscillation | None]:
    """Return the oscillation that a step leaves in each loop, None where it dies out."""
    runs = simulate_loops(actuators, [_stepped(each) for each in controllers], WATCHED_S, rate_hz)
    return [sustained(run) for run in runs]


def _stepped(controller: Values) -> dict[str, Value]:
    return {'reference.start': 0.01, **controller, 'reference.shape': 'step'}


def sustained(run: LoopRun) -> Oscillation | None:
    """Return the oscillation that is left at the end of a run; None if it dies out."""
    last = run.time_s > run.time_s[-1] - MEASURED_S
    time_s, force = run.time_s[last], run.force_n[last]
    half = len(force) // 2
    if not np.isfinite(force).all() or np.ptp(force[half:]) < 2.0 * LEAST_N:
        return None
    if np.ptp(force[half:]) < KEEPS * np.ptp(force[:half]):
        return None
    return fit(time_s, force)


def as_balance(run: LoopRun, oscillation: Oscillation, gain: float, harmonics: int) -> Balance:
    """Return a simulated cycle as harmonics of command, velocity and force."""
    last = run.time_s > run.time_s[-1] - MEASURED_S
    time_s, f = run.time_s[last], oscillation.frequency_hz

    def project(values: np.ndarray) -> np.ndarray:
        angle = 2.0 * math.pi * f * time_s[:, None] * np.arange(1, harmonics + 1)
        columns = np.hstack([np.ones((len(time_s), 1)), np.cos(angle), np.sin(angle)])
        found = np.linalg.lstsq(columns, values[last], rcond=None)[0]
        return np.concatenate([[found[0]],
                               found[1:harmonics + 1] - 1j * found[harmonics + 1:]])

    command, velocity, force = map(project, (run.command_n, run.velocity_m_s, run.force_n))
    # Time counts from where the command's fundamental has its peak.
    turn = np.exp(-1j * np.angle(command[1]) * np.arange(harmonics + 1))
    velocity[0] = 0.0
    return Balance(gain, f, command * turn, velocity * turn, force * turn)
