"""What drives a recording from outside: its reference, and what its bag says of the load."""

from typing import NamedTuple

import numpy as np

from asi_actuator.parameters import ACTUATOR_PARAMETERS
from asi_analysis.arrays import Array
from asi_analysis.bags.run import Run
from asi_common.parameter import defaults


class Drive(NamedTuple):
    """
    A drive: its name, and its course at the samples of the run.

    exact: it is computed from the metadata, in any unit; otherwise it was recorded, with noise.
    """

    name: str
    values: Array
    exact: bool = True


def drives(run: Run) -> list[Drive]:
    """Return the drives of a run: the reference, a prescribed motion, an external sine."""
    found = [] if run.reference_n is None else [Drive('the reference', run.reference_n, False)]
    load = {**defaults(ACTUATOR_PARAMETERS), **run.information.get('actuator', {})}

    def sine(name: str) -> Array:
        return np.sin(2.0 * np.pi * float(load[name]) * run.time_s)

    if load['load.type'] == 'prescribed' and load['load.velocity'] and load['load.frequency']:
        found.append(Drive('the prescribed motion', sine('load.frequency')))
    if load['load.external_force'] and load['load.external_force_frequency']:
        # Whenever it begins and ends: the time of a bag need not be that of the actuator.
        found.append(Drive('the external force', sine('load.external_force_frequency')))
    return found
