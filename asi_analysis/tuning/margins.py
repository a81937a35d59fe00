"""
Margins of the linear loop, at rest and moved: gain, phase and disk.

The hysteresis is left out: a command that moves in one direction is not delayed by the play. The
piston is locked; in motion the gain is the slope of the force over the valve command at which the
moved actuator gives no force (`asi_controller/additions/gain_schedule.py`). The disk margin is the
balanced one of Seiler, Packard and Gahinet, An Introduction to Disk Margins, IEEE Control Systems
Magazine 40, 2020.
"""

import math
from typing import Final, NamedTuple

import numpy as np
from scipy import optimize

from asi_actuator.model.hydraulic_damping import hydraulic_damping
from asi_actuator.parameters import as_record
from asi_analysis.arrays import Array, Complex
from asi_analysis.experiments.step_tests import LOCKED
from asi_analysis.loop import linear_model as linear
from asi_analysis.loop.simulation import Values, loop_of
from asi_controller.additions.gain_schedule import scheduled

VELOCITIES_M_S: Final = (0.0, 0.1, 0.2, 0.5)
LOWEST_HZ: Final = 1.0
FREQUENCIES: Final = 20_000
SMALL: Final = 1e-3   # change of the opening, for the slope


class Margins(NamedTuple):
    """
    Margins at a velocity (m/s): of the gain, of the phase (degrees), and of a disk.

    gain below 1, or phase below 0: the loop is unstable, and the disk is 0; None: it has no such
    crossing.
    """

    velocity_m_s: float
    gain: float | None
    gain_frequency_hz: float | None
    phase_deg: float | None
    disk: float


def moved_gain(actuator: Values, velocity: float) -> float:
    """
    Return the slope of the force over the static valve force, moved at a velocity (m/s).

    At the opening at which the actuator gives no force, the largest if none does: 1 at rest.
    """
    p = as_record(actuator)
    largest = float(p['valve_characteristic_maximum_force'])

    def force(opening: float) -> float:
        return largest * opening - float(hydraulic_damping(velocity, opening, p))

    open_ = 1.0 - SMALL
    still = optimize.brentq(force, -open_, open_) if force(open_) > 0.0 > force(-open_) else open_
    return float(force(still + SMALL) - force(still - SMALL)) / (2.0 * SMALL * largest)


def margins(actuator: Values, controller: Values, rate_hz: float) -> list[Margins]:
    """Return the margins of a loop at each of VELOCITIES_M_S; parameters by name."""
    loop = loop_of({**actuator, **LOCKED}, controller, rate_hz)
    p, c = loop.plant, loop.compensator
    frequency = np.geomspace(LOWEST_HZ, 0.499 * rate_hz, FREQUENCIES)
    plant = linear.plant(p, loop.period_s, linear.damping_slope(p), seals_stuck=True)(frequency)
    # The gain schedule applies to the compensator, not to the integrator in parallel.
    z = np.exp(2j * np.pi * frequency / rate_hz)
    integral = float(c['integrator_rate']) / rate_hz / (z - 1.0)
    direct = loop.compensated(frequency) - integral
    schedule = float(c['gain_schedule_velocity']), float(c['gain_schedule_least'])
    return [Margins(velocity, *_of(frequency, plant * moved_gain(actuator, velocity)
                                   * (direct * scheduled(velocity, *schedule) + integral)))
            for velocity in VELOCITIES_M_S]


def _of(frequency: Array, loop: Complex
        ) -> tuple[float | None, float | None, float | None, float]:
    """Return gain margin and its frequency (Hz), phase margin (degrees) and disk margin."""
    steps = np.arange(len(loop))
    gain, at = min(((1.0 / -float(np.interp(k, steps, loop.real)),
                     float(np.interp(k, steps, frequency))) for k in _crossings(loop.imag)
                    if np.interp(k, steps, loop.real) < 0.0), default=(None, None))
    phase = min((math.degrees(np.angle(-np.interp(k, steps, loop)))
                 for k in _crossings(np.abs(loop) - 1.0)), key=abs, default=None)
    if (gain or 1.0) < 1.0 or (phase or 0.0) < 0.0:
        return gain, at, phase, 0.0
    return gain, at, phase, float(2.0 * np.abs((1.0 + loop) / (1.0 - loop)).min())


def _crossings(values: Array) -> Array:
    """Return where n values cross 0, as positions between samples."""
    before = np.flatnonzero(values[:-1] * values[1:] < 0.0)
    return before + values[before] / (values[before] - values[before + 1])
