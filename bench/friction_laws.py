"""
How well the simulator's friction can follow friction that others formulate.

The examiner's friction (asi_examiner/plant.py: Maxwell slip of six elements whose force follows a
Stribeck curve, or Dahl's law with an exponent) is computed for a given motion; the parameters of
the simulator's are fitted to it, with more and more of its choices. What is left (rms) is the
least that a diagnosis can reach with that choice.

`slip` alone is a single bristle, from Dupont's law to Dahl's.

    python -m bench.friction_laws
"""

from typing import Final

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.table import Table
from scipy.optimize import least_squares

from asi_actuator.model.friction import SEALS_SHAPE, friction, settle
from asi_actuator.parameters import as_record
from asi_common.jit import jit
from asi_common.record import field_name
from asi_examiner.plant import SLIPS, maxwell_slip

Array = npt.NDArray[np.float64]

PERIOD_S: Final = 1e-4
TIME_S: Final = np.arange(20000) * PERIOD_S
# Velocity (m/s): tones of no common period, so that reversals within reversals occur.
VELOCITY: Final = 0.01 * sum(np.sin(2.0 * np.pi * f * TIME_S + f) for f in (1.3, 4.1, 11.7))
# Friction of others: Coulomb friction and breakaway, each ahead and back (N), Stribeck velocity
# (m/s), slip distance (m), exponent of Dahl's law (0: Maxwell slip).
OTHERS: Final = {
    'Coulomb, Maxwell slip': (40.0, 40.0, 40.0, 40.0, 0.005, 5e-5, 0.0),
    "Coulomb, Dahl's law, exponent 0.5": (40.0, 40.0, 40.0, 40.0, 0.005, 5e-5, 0.5),
    "Coulomb, Dahl's law, exponent 2": (40.0, 40.0, 40.0, 40.0, 0.005, 5e-5, 2.0),
    'with stiction, Maxwell slip': (7.0, 7.0, 27.0, 15.0, 0.005, 1.2e-4, 0.0),
    'asymmetric Coulomb, Maxwell slip': (56.0, 24.0, 56.0, 24.0, 0.005, 5e-5, 0.0),
}
SIZES: Final = {'friction.coulomb': (1.0, 100.0), 'friction.stiction_push': (1.0, 100.0),
                'friction.stiction_pull': (1.0, 100.0),
                'friction.stribeck_velocity': (1e-3, 0.05),
                'friction.presliding_stiffness': (1e4, 1e7),
                'friction.presliding_damping': (1e-2, 1e4)}
SLIP, EXPONENT, RATIO, SOFTENING = ({'friction.presliding_slip': (0.0, 1.0)},
                                    {'friction.presliding_exponent': (0.5, 3.0)},
                                    {'friction.element_ratio': (1.0, 6.0)},
                                    {'friction.softening': (0.0, 1.0)})
ASYMMETRY: Final = {'friction.coulomb_asymmetry': (-0.9, 0.9)}
CHOICES: Final = {'slip': SLIP, 'exponent': EXPONENT, 'elements': SLIP | RATIO,
                  'softening': SLIP | SOFTENING, 'elements, softening': SLIP | RATIO | SOFTENING}
STARTS: Final = (0.2, 0.6)   # shares of the range of a choice


@jit
def others_friction(velocity, law, out):
    """Fill in the friction (N) of others at velocities (m/s), in steps ten times shorter."""
    elements = np.zeros(SLIPS)
    coulomb_ahead, coulomb_back, ahead, back, stribeck, distance, dahl = law
    for k in range(1, velocity.size):
        for j in range(10):
            v = velocity[k - 1] + (j + 1.0) / 10.0 * (velocity[k] - velocity[k - 1])
            out[k] = maxwell_slip(elements, v, coulomb_ahead, coulomb_back, ahead, back,
                                  stribeck, distance, dahl, 0.1 * PERIOD_S)


@jit
def own_friction(velocity, p, out):
    """Fill in the friction (N) of the simulator at velocities (m/s)."""
    seals = np.zeros(SEALS_SHAPE)
    for k in range(1, velocity.size):
        mean = 0.5 * (velocity[k - 1] + velocity[k])
        out[k] = friction(seals, mean, velocity[k], p, PERIOD_S).force
        settle(seals, 0.0, p)


def least_left(truth: Array, choice: dict[str, tuple[float, float]]) -> float:
    """Return the rms (N) that the best fit of sizes and of a choice leaves of a friction (N)."""
    ranges = SIZES | ASYMMETRY | choice
    # A law that begins to slide by its exponent is Dahl's.
    p = as_record({'friction.model': 'full', 'friction.presliding_slip': 1.0})

    def residual(shares: Array) -> Array:
        for (name, (low, high)), share in zip(ranges.items(), shares, strict=True):
            p[field_name(name)] = (low * (high / low) ** share if name in SIZES
                                   else low + share * (high - low))
        out = np.zeros(truth.size)
        own_friction(VELOCITY, p, out)
        return out - truth

    guesses = {'friction.coulomb': 20.0, 'friction.stiction_push': 25.0,
               'friction.stiction_pull': 25.0, 'friction.stribeck_velocity': 5e-3,
               'friction.presliding_stiffness': 5e5, 'friction.presliding_damping': 10.0}
    begin = [np.log(guesses[name] / low) / np.log(high / low)
             for name, (low, high) in SIZES.items()]
    fits = [least_squares(residual, [*begin, 0.5, *(start for _ in choice)], bounds=(0.0, 1.0),
                          diff_step=1e-4, max_nfev=60) for start in STARTS]
    return float(np.sqrt(2.0 * min(fit.cost for fit in fits) / truth.size))


def main() -> None:
    """Print what is left of each friction of others, as a share of it, for each choice."""
    table = Table('left of the friction, rms', *CHOICES)
    for name, law in OTHERS.items():
        truth = np.zeros(VELOCITY.size)
        others_friction(VELOCITY, law, truth)
        table.add_row(name, *(f'{100.0 * least_left(truth, choice) / truth.std():.2g} %'
                              for choice in CHOICES.values()))
    Console().print(table)


if __name__ == '__main__':
    main()
