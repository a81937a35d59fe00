"""Open-loop measurements, quasi-static or at a given speed: Figs. 3 to 5 and the friction."""

from typing import Final, NamedTuple

import numpy as np

from asi_actuator.model.actuator import rest, simulate
from asi_actuator.parameters import as_record
from asi_analysis.arrays import Array
from asi_analysis.loop.bench import RATE_HZ, Values, open_loop
from asi_analysis.paper.facts.conditions import LOCKED

# The family of Fig. 3: valve positions as shares of full opening, up to a speed.
OPENINGS: Final = (-1.0, -0.5, 0.0, 0.5, 1.0)
FASTEST_M_S: Final = 1.0
RAMP_S: Final = 3.0
TRIANGLE_S: Final = 2.0
# Velocities over the Stribeck velocity: slow, and so fast that only Coulomb friction remains.
SLOW: Final = 0.02
FAST: Final = 4.0
NO_FRICTION: Final = {'friction.model': 'off'}


class Curve(NamedTuple):
    """A measured characteristic: n values of x and y; x in the unit of its axis, y in N."""

    x: Array
    y: Array


def static_characteristic(actuator: Values, refinement: int = 1) -> Curve:
    """Return the thrust against the valve position (m), piston locked, by a slow ramp (Fig. 4)."""
    plant = as_record({**actuator, **LOCKED, **NO_FRICTION})
    full = plant['valve_characteristic_maximum_force'] / plant['valve_characteristic_gain']
    up = np.linspace(0.0, 1.3 * full, int(refinement * RAMP_S * RATE_HZ))
    sides = [open_loop(plant, sign * up) for sign in (-1.0, 1.0)]
    return Curve(np.concatenate([sides[0].valve_position_m[::-1], sides[1].valve_position_m]),
                 np.concatenate([sides[0].force_n[::-1], sides[1].force_n]))


def hysteresis_loop(actuator: Values, amplitude_n: float, sine_hz: float = 0.0,
                    refinement: int = 1) -> Curve:
    """
    Return force against valve command over a period of a triangle, or of a sine (Fig. 5).

    Piston locked, open loop; the second of two periods.
    """
    plant = as_record({**actuator, **LOCKED})
    period = 1.0 / sine_hz if sine_hz else refinement * TRIANGLE_S
    periods = np.arange(round(2 * period * RATE_HZ)) / (period * RATE_HZ)
    wave = np.sin(2.0 * np.pi * periods) if sine_hz else 1.0 - 4.0 * np.abs(
        (periods + 0.25) % 1.0 - 0.5)
    run = open_loop(plant, amplitude_n * wave)
    half = periods.size // 2
    return Curve(run.command_n[half:], run.force_n[half:])


def loop_half_width(loop: Curve) -> float:
    """Return half the distance (N of force) between the two branches of a loop at x = 0."""
    rising = np.gradient(loop.x) > 0.0
    up, down = (np.interp(0.0, loop.x[branch][order], loop.y[branch][order])
                for branch in (rising, ~rising)
                for order in [np.argsort(loop.x[branch])])
    return 0.5 * float(down - up)


def _moved(plant: np.void, velocity: float, duration_s: float) -> Array:
    """Return the force (N) while the piston is moved at a velocity (m/s), valve closed."""
    plant = plant.copy()
    plant['load_velocity'] = velocity
    return simulate(plant, np.zeros(int(duration_s * RATE_HZ)), 1.0 / RATE_HZ).force_n


def breakaway(actuator: Values, direction: int, refinement: int = 1) -> float:
    """Return the largest force (N) of a slow motion of the piston: +1 extends, -1 retracts."""
    plant = as_record({**actuator, 'load.type': 'prescribed'})
    velocity = SLOW / refinement * plant['friction_stribeck_velocity']
    limit = max(plant['friction_stiction_push'], plant['friction_stiction_pull']) / plant[
        'friction_presliding_stiffness']
    return float(np.abs(_moved(plant, direction * velocity, 2.0 * limit / velocity)).max())


def coulomb(actuator: Values, refinement: int = 1) -> float:
    """
    Return the sliding friction (N): mean of both directions.

    The force of the same motion without friction, the hydraulic damping, is subtracted.
    """
    plant = as_record({**actuator, 'load.type': 'prescribed'})
    frictionless = as_record({**actuator, **NO_FRICTION, 'load.type': 'prescribed'})
    velocity = FAST * plant['friction_stribeck_velocity']
    limit = plant['friction_stiction_push'] / plant['friction_presliding_stiffness']
    duration = refinement * (4.0 * limit / velocity + 0.02)
    return float(np.mean([
        abs(_moved(plant, v, duration)[-1] - _moved(frictionless, v, duration)[-1])
        for v in (velocity, -velocity)]))


def damping_sweep(actuator: Values, opening: float, velocities: Array) -> Curve:
    """
    Return the damping force (N) against the velocity (m/s) of a back-driven piston (Fig. 3).

    opening: valve position, -1 to 1, held by a constant command. The damping is the force at rest
    minus that of the moving piston; friction is off, as the paper plots it separately.
    """
    plant = as_record({**actuator, **NO_FRICTION, 'load.type': 'prescribed'})
    full = plant['valve_characteristic_maximum_force'] / plant['valve_characteristic_gain']
    state = rest()
    # Plus half the width of the hysteresis loop; 0.3 s are several time constants of the coil.
    command = opening * full + np.sign(opening) * plant['valve_hysteresis_radius']
    at_rest = simulate(plant, np.full(int(0.3 * RATE_HZ), command), 1.0 / RATE_HZ,
                       state).force_n[-1]
    forces = []
    for velocity in velocities:
        plant['load_velocity'] = velocity
        moved = simulate(plant, np.full(int(0.02 * RATE_HZ), command), 1.0 / RATE_HZ,
                         state.copy())
        forces.append(at_rest - moved.force_n[-1])
    return Curve(velocities, np.array(forces))
