"""Step responses of the simulated loop, until the motion has settled to a cycle or to rest."""

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from asi_analysis.loop.closed_loop import LoopRun, Loops, Values, close_many, loops_of, records
from asi_analysis.loop.harmonic_balance import HARMONICS, Balance, Loop, valve_forces
from asi_analysis.measures.oscillation import FLOOR_N, Oscillation, of_samples

# First duration of the simulation, which is doubled until the motion has settled, and the longest.
# Close to its fold a cycle settles slowly.
FIRST_WATCHED_S: Final = 1.0
WATCHED_S: Final = 32.0
MEASURED_S: Final = 0.35
# A motion has settled if its amplitude changes by less than this share a period.
SETTLED: Final = 1e-4


def loop_of(actuator: Values, controller: Values, rate_hz: float) -> Loop:
    """Return the loop for harmonic balance, from parameters by name."""
    plant, compensator, reference = records(actuator, controller, rate_hz)
    held_n = float(reference['reference_amplitude'] + reference['reference_offset'])
    return Loop(plant, compensator, 1.0 / rate_hz, held_n)


def step_run(actuator: Values, controller: Values, rate_hz: float, watched_s: float = WATCHED_S,
             first_s: float = FIRST_WATCHED_S) -> LoopRun:
    """Return the last MEASURED_S of the settled step response of a loop."""
    return step_runs([actuator], [controller], rate_hz, watched_s, first_s)[0]


def step_runs(actuators: Sequence[Values], controllers: Sequence[Values], rate_hz: float,
              watched_s: float = WATCHED_S, first_s: float = FIRST_WATCHED_S) -> list[LoopRun]:
    """
    Return the last MEASURED_S of the settled step responses of loops, on all cores.

    The step is that of the controllers' reference (from its offset, by its amplitude).
    """
    stepped = [{'reference.start': 0.01, **each, 'reference.shape': 'step'}
               for each in controllers]
    return run_until_settled(loops_of(actuators, stepped, rate_hz), watched_s, first_s)


def run_until_settled(loops: Loops, watched_s: float = WATCHED_S,
                      first_s: float = FIRST_WATCHED_S) -> list[LoopRun]:
    """
    Run loops until their oscillation has settled or decayed; return their last MEASURED_S.

    On all cores, for `watched_s` s at most. The reference must be constant after the first
    `first_s`, the shortest simulation.
    """
    rate_hz = 1.0 / loops.period_s
    found: dict[int, LoopRun] = {}
    moving = np.arange(len(loops.states))
    piece_s, elapsed_s = min(first_s, watched_s), 0.0
    while len(moving):
        signals = close_many(loops, piece_s, MEASURED_S)
        elapsed_s += piece_s
        # The time of the next piece starts at 0, after the step.
        loops.references['reference_start'] = 0.0
        time_s = elapsed_s + np.arange(-signals.shape[2], 0) / rate_hz
        found |= {int(k): LoopRun(time_s, *each) for k, each in zip(moving, signals, strict=True)}
        piece_s = min(elapsed_s, watched_s - elapsed_s)
        if piece_s < MEASURED_S:
            break
        unsettled = np.flatnonzero([not _settled(each[2], rate_hz) for each in signals])
        moving, loops = moving[unsettled], loops.subset(unsettled)
    return [found[k] for k in range(len(found))]


def _settled(force: np.ndarray, rate_hz: float) -> bool:
    found = of_samples(force, rate_hz)
    return not found.amplitude_n > FLOOR_N or (
        abs(found.growth_1_s) < SETTLED * found.frequency_hz)


def sustained(run: LoopRun) -> Oscillation | None:
    """Return the oscillation at the end of a run; None if it is not sustained."""
    rate_hz = (len(run.time_s) - 1) / (run.time_s[-1] - run.time_s[0])
    found = of_samples(run.force_n[-round(MEASURED_S * rate_hz):], rate_hz)
    return found if found.sustained and math.isfinite(found.amplitude_n) else None


def _projected(run: LoopRun, values: np.ndarray, frequency_hz: float, harmonics: int
               ) -> np.ndarray:
    """Return the harmonics 0 to `harmonics` of a signal over the measured part."""
    last = run.time_s > run.time_s[-1] - MEASURED_S
    angle = 2.0 * math.pi * frequency_hz * run.time_s[last, None] * np.arange(1, harmonics + 1)
    columns = np.hstack([np.ones((len(angle), 1)), np.cos(angle), np.sin(angle)])
    found = np.linalg.lstsq(columns, values[last], rcond=None)[0]
    return np.concatenate([[found[0]], found[1:harmonics + 1] - 1j * found[harmonics + 1:]])


def with_mean_friction(loop: Loop, run: LoopRun, frequency_hz: float) -> Loop:
    """Return the loop with the mean friction of a simulated cycle."""
    static, damping = valve_forces(run.valve_position_m, run.velocity_m_s, loop.plant)
    friction = static - damping - (run.force_n - loop.plant['force_sensor_offset'])
    return loop._replace(friction_n=float(
        _projected(run, friction, frequency_hz, HARMONICS)[0].real))


def as_balance(run: LoopRun, oscillation: Oscillation, gain: float, harmonics: int) -> Balance:
    """Return a simulated cycle as harmonics of command, velocity and force."""
    f = oscillation.frequency_hz
    command, velocity, force = (_projected(run, values, f, harmonics) for values in (
        run.command_n, run.velocity_m_s, run.force_n))
    # Time 0 is at a peak of the command's fundamental.
    turn = np.exp(-1j * np.angle(command[1]) * np.arange(harmonics + 1))
    velocity[0] = 0.0
    return Balance(gain, f, command * turn, velocity * turn, force * turn)
