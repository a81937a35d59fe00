"""The forms of the effects within a servo of second order."""

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from asi_analysis.gap.model.effects import Free, Variant
from asi_analysis.gap.model.servo.identification import LEAST_SPLIT, Servo
from asi_analysis.gap.prepare import Recording

# Of dry friction, over the stiffness of the loop, as a share of the motion; of the Stribeck
# velocity, as a share of the fastest motion; of the frequency of a load on its compliance, as a
# multiple of the servo's, and its damping ratio: more would be a lag of two poles.
FRICTIONS: Final = (0.003, 0.01, 0.03, 0.1)
LEAST_FRICTION: Final = 1e-4
STRIBECKS: Final = (0.01, 0.05, 0.2)
FAST: Final = 0.99
LOAD_FREQUENCIES: Final = (0.6, 1.0, 1.7, 3.0)
LOAD_DAMPINGS: Final = (0.0, 0.15, 0.4)
# Where a limit of the reference may be, as shares of its distance from the mean: bounds, guesses.
LIMITED: Final = (0.2, 1.3)
REACHED: Final = (0.95, 0.8, 0.6)
INTEGRALS: Final = (0.0, 0.3, 2.0)   # rate of the integral action over the natural frequency
MOST_LEAD: Final = 6.0   # of a servo, as a multiple of its damping over its stiffness
MOST_LAG: Final = 1.5    # of integral action, as a multiple of the lead


def initial_state(recordings: Sequence[Recording]) -> tuple[Free, ...]:
    """
    Return the free state of the drive where a recording begins amid a motion.

    In every fit: in that of a compliance alone, it would be evidence for one.
    """
    if not any(r.begins for r in recordings):
        return ()
    amplitude, speed = _motion(recordings)
    return (Free('servo_ahead', -amplitude, amplitude, (0.0,)),
            Free('servo_faster', -2.0 * speed, 2.0 * speed, (0.0,)))


def _motion(recordings: Sequence[Recording]) -> tuple[float, float]:
    """Return range and speed of a servo's motion."""
    return (max(float(np.ptp(r.output[r.valid])) for r in recordings),
            max(float(np.quantile(np.abs(np.diff(r.output)), FAST)) / r.period_s
                for r in recordings))


def forms_of(servo: Servo, recordings: Sequence[Recording]) -> dict[str, tuple[Variant, ...]]:
    """Return the forms of the effects within a servo of second order, by name."""
    amplitude, speed = _motion(recordings)
    low, start, high = STRIBECKS
    friction = (
        Free('servo_friction', LEAST_FRICTION * amplitude, amplitude, tuple(
            each * amplitude for each in FRICTIONS), '', 'm'),
        Free('servo_integral', 0.0, INTEGRALS[-1] * servo.pulsation, tuple(
            each * servo.pulsation for each in INTEGRALS[:-1]), '', '1/s'))
    sticking = (Free('servo_breakaway', 0.25, 6.0, (1.0,)),
                Free('servo_stribeck', low * speed, high * speed, (start * speed,), '', 'm/s'))
    frequency = servo.pulsation / (2.0 * math.pi)
    compliance = (
        Free('servo_load_frequency', 0.3 * frequency, 20.0 * frequency, tuple(
            each * frequency for each in LOAD_FREQUENCIES), '', 'Hz'),
        Free('servo_load_damping', LOAD_DAMPINGS[0], LOAD_DAMPINGS[-1], (LOAD_DAMPINGS[1],)))
    return {name: (Variant(free, ('valve',)),) for name, free in (
        ('coulomb_friction', friction), ('stiction', (*friction, *sticking)),
        ('load_compliance', compliance))}


def limited_reference(recordings: Sequence[Recording]) -> Variant:
    """
    Return the form of a reference that a position servo follows within two limits only.

    Two, since the origin of a reference is arbitrary: what is symmetric to one is not to another.
    """
    reference = np.concatenate([r.input[r.valid] for r in recordings])
    middle = float(reference.mean())
    free = []
    for name, end in (('upper', float(reference.max())), ('lower', float(reference.min()))):
        low, high = sorted(middle + share * (end - middle) for share in LIMITED)
        free.append(Free(f'servo_{name}', low, high, tuple(
            middle + share * (end - middle) for share in REACHED), '', 'm'))
    return Variant(tuple(free), ('valve',), (('servo_limited', 1.0),))


def swapped(servos: Sequence[Servo]) -> list[Servo]:
    """
    Return servos of second order with the poles of the two lags in series with each that has them.

    Then the load on its compliance may be what has the poles of that servo.
    """
    return [Servo(1.0 / (each.lag * math.sqrt(each.split * (1.0 - each.split))),
                  0.5 / math.sqrt(each.split * (1.0 - each.split)))
            for each in servos if each.lag > 0.0 and each.split >= LEAST_SPLIT]


def loop_of(servo: Servo, leads: Sequence[float]) -> tuple[Free, Free]:
    """
    Return the lead of a servo, and the lag of its integral action as a share of that.

    leads: initial guesses, s; beside each the lag is as long, so that both have no effect.
    """
    most = max(MOST_LEAD * 2.0 * servo.damping / servo.pulsation, *(2.0 * each for each in leads))
    return (Free('servo_lead', 0.0, most, tuple(leads), '', 's', anew=True),
            Free('servo_lag_share', 0.0, MOST_LAG, (1.0,) * len(leads), anew=True))
