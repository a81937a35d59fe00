"""Cycles of the simulated loop: to begin harmonic balance from, and to judge it by."""

import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from asi_analysis.loop.closed_loop import LoopRun, records, simulate_loops
from asi_analysis.loop.harmonic_balance import HARMONICS, Balance, Loop, valve_forces
from asi_analysis.measures.sinusoid import Oscillation, fit
from asi_common.parameter import Value

Values = Mapping[str, Value]
# A step is watched so long, again longer until what it leaves has settled or died out, and the
# cycle is measured over the last part. Close to its fold a cycle is slow to settle.
WATCHED_S: Final = (1.0, 4.0, 12.0)
MEASURED_S: Final = 0.35
# The second half of the measured part is as large as the first within the first share if the
# motion has settled; it is no cycle if it has fallen by more than the second.
SETTLED: Final = 0.003
FALLEN: Final = 0.03
LEAST_N: Final = 0.5


def loop_of(actuator: Values, controller: Values, rate_hz: float) -> Loop:
    """Return what harmonic balance needs, from parameters by name."""
    plant, compensator, reference = records(actuator, controller, rate_hz)
    held_n = float(reference['reference_amplitude'] + reference['reference_offset'])
    return Loop(plant, compensator, 1.0 / rate_hz, held_n)


def step_run(actuator: Values, controller: Values, rate_hz: float) -> LoopRun:
    """Return the loop's answer to a step of its reference, until what it leaves has settled."""
    return step_runs([actuator], [controller], rate_hz)[0]


def step_runs(actuators: Sequence[Values], controllers: Sequence[Values], rate_hz: float
              ) -> list[LoopRun]:
    """Return `step_run` of each actuator with its controller, on all cores."""
    stepped = [{'reference.start': 0.01, **each, 'reference.shape': 'step'}
               for each in controllers]
    runs = simulate_loops(actuators, stepped, WATCHED_S[0], rate_hz)
    for duration in WATCHED_S[1:]:
        moving = [k for k, run in enumerate(runs) if not _settled(*_swings(run))]
        longer = simulate_loops([actuators[k] for k in moving], [stepped[k] for k in moving],
                                duration, rate_hz) if moving else []
        for k, run in zip(moving, longer, strict=True):
            runs[k] = run
    return runs


def _swings(run: LoopRun) -> tuple[float, float]:
    """Return the force's swing (N, peak to peak) in both halves of the measured part."""
    force = run.force_n[run.time_s > run.time_s[-1] - MEASURED_S]
    first, second = np.array_split(force, 2)
    return float(np.ptp(first)), float(np.ptp(second))


def _settled(before: float, after: float) -> bool:
    return not after >= 2.0 * LEAST_N or abs(after / before - 1.0) < SETTLED


def sustained(run: LoopRun) -> Oscillation | None:
    """Return the oscillation that is left at the end of a run; None if it dies out."""
    before, after = _swings(run)
    if not after >= 2.0 * LEAST_N or after < (1.0 - FALLEN) * before:
        return None
    last = run.time_s > run.time_s[-1] - MEASURED_S
    return fit(run.time_s[last], run.force_n[last])


def _projected(run: LoopRun, values: np.ndarray, frequency_hz: float, harmonics: int
               ) -> np.ndarray:
    """Return the harmonics 0 to `harmonics` of a signal over the measured part."""
    last = run.time_s > run.time_s[-1] - MEASURED_S
    angle = 2.0 * math.pi * frequency_hz * run.time_s[last, None] * np.arange(1, harmonics + 1)
    columns = np.hstack([np.ones((len(angle), 1)), np.cos(angle), np.sin(angle)])
    found = np.linalg.lstsq(columns, values[last], rcond=None)[0]
    return np.concatenate([[found[0]], found[1:harmonics + 1] - 1j * found[harmonics + 1:]])


def remembering(loop: Loop, run: LoopRun, frequency_hz: float) -> Loop:
    """Return the loop with the mean friction of a simulated cycle: what its seals remember."""
    static, damping = valve_forces(run.valve_position_m, run.velocity_m_s, loop.plant)
    rub = static - damping - (run.force_n - loop.plant['force_sensor_offset'])
    return loop._replace(friction_n=float(_projected(run, rub, frequency_hz, HARMONICS)[0].real))


def as_balance(run: LoopRun, oscillation: Oscillation, gain: float, harmonics: int) -> Balance:
    """Return a simulated cycle as harmonics of command, velocity and force."""
    f = oscillation.frequency_hz
    command, velocity, force = (_projected(run, values, f, harmonics) for values in (
        run.command_n, run.velocity_m_s, run.force_n))
    # Time counts from where the command's fundamental has its peak.
    turn = np.exp(-1j * np.angle(command[1]) * np.arange(harmonics + 1))
    velocity[0] = 0.0
    return Balance(gain, f, command * turn, velocity * turn, force * turn)
