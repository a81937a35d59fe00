"""
Z-width: the impedances that a loop can give, by its gain, while it stays passive.

Of a force loop the least is what a user feels at its highest passive gain, the largest that at its
lowest (Colgate and Brown, Factors affecting the Z-width of a haptic display, IEEE International
Conference on Robotics and Automation, 1994).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from asi_analysis.loop.closed_loop import Values
from asi_analysis.tuning.figures import IMPEDANCE_HZ, impedance
from asi_controller.compensators import COMPENSATORS


class AtGain(NamedTuple):
    """
    The impedance at a factor of gain and integrator.

    size_n_s_m: at each of IMPEDANCE_HZ, the mean size over IMPEDANCE_M_S.
    """

    factor: float
    least_re_z_n_s_m: float
    passive: bool
    size_n_s_m: tuple[float, ...]


class ZWidth(NamedTuple):
    """
    The impedance over the gain, and the width (dB) at each of IMPEDANCE_HZ.

    width_db: the largest over the least size at passive gains; None if none is passive.
    """

    gains: Sequence[AtGain]
    width_db: tuple[float, ...] | None


def z_width(actuator: Values, controller: Values, factors: Sequence[float], rate_hz: float
            ) -> ZWidth:
    """
    Return the impedance of a loop at several gains.

    actuator, controller: parameters by name, the rest at their defaults; factors: of gain and
    integrator, above 0; rate_hz: control rate. Passive is a real part of at least 0 wherever it is
    taken. Raises ParameterError for a gain that is not allowed.

    >>> found = z_width({}, {'gain': 3.0}, [0.5, 1.0], 2000.0)  # doctest: +SKIP
    """
    name = str(controller.get('compensator', 'proportional'))
    gain = float(controller.get('gain', 0.0)) or COMPENSATORS[name].gain
    gains = []
    for factor in factors:
        scaled = {**controller, 'gain': factor * gain,
                  'integrator.rate': factor * float(controller.get('integrator.rate', 0.0))}
        found = impedance(actuator, scaled, rate_hz)
        least = float(found.real.min())
        gains.append(AtGain(factor, least, least >= 0.0,
                            tuple(map(float, np.abs(found).mean(axis=0)))))
    sizes = np.array([each.size_n_s_m for each in gains if each.passive])
    width = (tuple(map(float, 20.0 * np.log10(sizes.max(axis=0) / sizes.min(axis=0))))
             if len(sizes) else None)
    return ZWidth(gains, width)


def rows(controller: str, found: ZWidth) -> list[dict[str, object]]:
    """Return a row for each frequency of IMPEDANCE_HZ and gain."""
    return [{'controller': controller, 'factor': each.factor, 'frequency_hz': frequency,
             'size_n_s_m': size, 'least_re_z_n_s_m': each.least_re_z_n_s_m,
             'passive': each.passive,
             'width_db': found.width_db[k] if found.width_db else None}
            for each in found.gains
            for k, (frequency, size) in enumerate(zip(IMPEDANCE_HZ, each.size_n_s_m,
                                                      strict=True))]
