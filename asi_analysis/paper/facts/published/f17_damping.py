"""F17: the family of damping curves (Fig. 3)."""

from typing import Final

import numpy as np

from asi_actuator.model.hydraulic_damping import damping_curve, damping_force
from asi_analysis.arrays import Array
from asi_analysis.paper.facts.fact import INFINITE, Fact, Measured, Role, Row, Setup, Stage
from asi_analysis.paper.facts.static import FASTEST_M_S, OPENINGS, damping_sweep

POINTS: Final = 60


def _exponent(speeds: Array, force: Array) -> float:
    return float((np.diff(np.log(np.maximum(force, 1e-9))) / np.diff(np.log(speeds))).max())


def measure(setup: Setup) -> Measured:
    speeds = np.geomspace(0.01, FASTEST_M_S, POINTS * setup.refinement)
    if setup.fitted_only:
        # Computed by the block alone: the same result, faster.
        p = setup.record()
        curve = damping_curve(0.0, p)
        return {'damping_exponent': _exponent(
            speeds, np.array([damping_force(speed, curve, p)[0] for speed in speeds]))}
    family = {opening: damping_sweep(setup.actuator, opening, speeds) for opening in OPENINGS}
    closed = family[0.0].y
    slope = np.diff(closed) / np.diff(speeds)
    middle = [float(np.interp(0.5 * y.max(), y, speeds)) for _, y in family.values()]
    return {'damping_largest_n': max(float(np.abs(y).max()) for _, y in family.values()),
            'damping_exponent': _exponent(speeds, closed),
            'damping_taper': float(slope[-1] / slope.max()),
            'damping_spread': max(middle) / min(middle)}


FACT = Fact(
    'F17',
    (Row('damping_largest_n', 'largest damping force of the family', '4.1, Fig. 3', 1200.0, 'N',
         960.0, 1200.0, Role.HELD_OUT),
     Row('damping_exponent', 'damping rises as this power of the velocity, valve closed',
         '2.2, Fig. 3', 1.0, '', 1.2, INFINITE),
     Row('damping_taper', 'slope at 1 m/s over the steepest', '2.2, Fig. 3', 0.0, '', 0.0, 0.5,
         Role.HELD_OUT),
     Row('damping_spread', 'velocity of half the damping, largest over least of the family',
         '2.2, Fig. 3', 1.0, '', 1.1, INFINITE, Role.HELD_OUT)),
    measure,
    lambda _: ('piston moved at prescribed speeds up to 1 m/s at five valve positions, friction '
               'off'),
    'force lost against that at rest', Stage.PREDICTION)
