"""
Z-width: the impedances that a loop can give, by its gain, while it stays passive.

The smallest impedance is felt at the highest passive gain, the largest at the lowest (Colgate and
Brown, Factors affecting the Z-width of a haptic display, IEEE International Conference on Robotics
and Automation, 1994).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from asi_analysis.loop.closed_loop import Values
from asi_analysis.tuning.figures import IMPEDANCE_HZ, impedance
from asi_controller.compensators import COMPENSATORS


def z_width(actuator: Values, controller: Values, factors: Sequence[float], rate_hz: float
            ) -> list[dict[str, Any]]:
    """
    Return the impedance of a loop at several gains: a row for each gain and IMPEDANCE_HZ.

    actuator, controller: parameters by name, the rest at their defaults; factors: of gain and
    integrator, above 0; rate_hz: control rate. Sizes are the mean over IMPEDANCE_M_S. Passive is a
    real part of at least 0 wherever it is taken; width_db: the largest over the least size at
    passive gains, None if none is passive. Raises ParameterError for a gain that is not allowed.

    >>> found = z_width({}, {'gain': 3.0}, [0.5, 1.0], 2000.0)
    >>> [(each['factor'], each['passive']) for each in found if each['frequency_hz'] == 1.0]
    [(0.5, True), (1.0, True)]
    """
    name = str(controller.get('compensator', 'proportional'))
    gain = float(controller.get('gain', 0.0)) or COMPENSATORS[name].gain
    found = [impedance(actuator, {
        **controller, 'gain': factor * gain,
        'integrator.rate': factor * float(controller.get('integrator.rate', 0.0))}, rate_hz)
        for factor in factors]
    sizes = [np.abs(each).mean(axis=0) for each in found]
    passive = [bool(each.real.min() >= 0.0) for each in found]
    kept = np.array([size for size, of in zip(sizes, passive, strict=True) if of])
    width = (20.0 * np.log10(kept.max(axis=0) / kept.min(axis=0))).tolist() if len(kept) else None
    return [{'factor': factor, 'frequency_hz': frequency, 'size_n_s_m': float(sizes[k][place]),
             'least_re_z_n_s_m': float(found[k].real.min()), 'passive': passive[k],
             'width_db': width[place] if width else None}
            for k, factor in enumerate(factors) for place, frequency in enumerate(IMPEDANCE_HZ)]
