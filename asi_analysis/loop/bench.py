"""Simulated test bench: the actuator under one controller, run in successive pieces."""

import math
from collections.abc import Callable
from typing import Final

import numpy as np

from asi_actuator.model.actuator import Trajectory, rest, simulate
from asi_analysis.arrays import Array
from asi_analysis.experiments.experiment import Experiment
from asi_analysis.loop.closed_loop import LoopRun, Values, close_loop, simulate_loop
from asi_common.record import record_of
from asi_controller.compensator import compensator
from asi_controller.parameters import REFERENCE_PARAMETERS
from asi_controller.reference import SINE, STEP

RATE_HZ: Final = 5000.0
# Time at rest before a step.
BEFORE_S: Final = 0.1

Runner = Callable[[Experiment], LoopRun]


class Bench:
    """
    A closed loop that keeps its state from one `run` to the next.

    plant: record of ACTUATOR_DTYPE; controller: parameters by name, the rest at their defaults.
    """

    def __init__(self, plant: np.void, controller: Values) -> None:
        self.plant = plant.copy()
        self.compensator = compensator(controller, RATE_HZ)
        self.reference = record_of({'reference.start': 0.0}, REFERENCE_PARAMETERS)
        self.state = rest()
        self.samples = 0

    def change(self, controller: Values) -> None:
        """Replace the compensator of the running loop, as the node does on a changed parameter."""
        self.compensator = compensator(controller, RATE_HZ, self.compensator)

    def run(self, duration_s: float, amplitude_n: float, frequency_hz: float = 0.0,
            push_n: float = 0.0) -> LoopRun:
        """Run with a constant or sinusoidal reference and a constant external force (N)."""
        self.reference['reference_shape'] = SINE if frequency_hz else STEP
        self.reference['reference_amplitude'] = amplitude_n
        self.reference['reference_frequency'] = frequency_hz
        self.plant['load_external_force'] = push_n
        out = np.empty((6, math.ceil(duration_s * RATE_HZ - 1e-9)))
        close_loop(self.state, self.plant, self.compensator, self.reference, 1.0 / RATE_HZ, 0, out)
        time = (self.samples + np.arange(out.shape[1])) / RATE_HZ
        self.samples += out.shape[1]
        return LoopRun(time, *out)


def open_loop(plant: np.void, commands: Array) -> Trajectory:
    """Return the response of the actuator to valve commands (N) at RATE_HZ."""
    return simulate(plant, commands, 1.0 / RATE_HZ)


def step_experiment(actuator: Values, controller: Values, amplitude_n: float, duration_s: float,
                    from_n: float = 0.0) -> Experiment:
    """Return the experiment of `asi run --step`: a step after BEFORE_S at `from_n`."""
    reference: Values = {'reference.shape': 'step', 'reference.offset': from_n,
                         'reference.amplitude': amplitude_n - from_n,
                         'reference.start': BEFORE_S}
    return Experiment(actuator, {**controller, **reference}, duration_s, rate_hz=RATE_HZ)


def in_process(experiment: Experiment) -> LoopRun:
    """Return the run of the nodes, computed in this process."""
    return simulate_loop(experiment.actuator, experiment.controller, experiment.duration_s,
                         experiment.rate_hz)
