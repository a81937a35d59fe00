"""
The last part of the demo: an effect that the model lacks is found, put in, and the gap shrinks.

A machine with the effect, its nominal model and the improved one follow the same reference.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from asi_actuator.model.effects import EFFECT
from asi_analysis.bags.run import Run
from asi_analysis.experiments.experiment import Experiment, read_parameters
from asi_analysis.gap.answer.command import diagnose
from asi_analysis.gap.answer.result import Gap
from asi_analysis.terminal import Progress, silent
from asi_common.parameter import Value

HIDDEN: Final = EFFECT['valve_hysteresis']
NOMINAL: Final[Mapping[str, Value]] = {'load.type': 'spring'}
NOISE: Final[Mapping[str, Value]] = {'force_sensor.noise': 1.0}
CONTROLLER: Final[Mapping[str, Value]] = {
    'gain': 3.0, 'reference.shape': 'multisine', 'reference.amplitude': 200.0,
    'reference.frequency': 0.5, 'reference.end_frequency': 60.0}
DURATION_S: Final = 4.0
RATE_HZ: Final = 1000.0
SHOWN_S: Final = (1.0, 1.5)   # part of the runs in the pictures


class FoundEffect(NamedTuple):
    """The diagnosis; the runs: machine, nominal, improved; errors of the models (N, rms)."""

    gap: Gap
    has_model: bool   # whether the answer has an improved model, with the effect
    runs: dict[str, Run]
    error_n: dict[str, float]

    @property
    def shrink(self) -> float:
        """Return by how much the error of the loop's force is smaller with the improved model."""
        return 1.0 - self.error_n['improved'] / self.error_n['nominal']


def find_hidden_effect(record: Callable[[str, Experiment], Run], out: Path,
                       progress: Progress = silent) -> FoundEffect:
    """
    Record a machine with HIDDEN, diagnose it by its signals, and run the improved model.

    record: makes the run of an experiment, by name; out: gets the report of the diagnosis and
    improved.yaml.
    """
    def of(actuator: Mapping[str, Value]) -> Experiment:
        return Experiment(actuator, CONTROLLER, DURATION_S, rate_hz=RATE_HZ)

    machine = record('machine', of({**NOMINAL, **HIDDEN.example, **NOISE}))
    # A bag holds all parameters of its run: the diagnosis is given only the nominal ones.
    withheld = replace(machine, information={
        name: value for name, value in machine.information.items() if name != 'actuator'})
    gap = diagnose([withheld], NOMINAL, progress=progress)
    gap.write_report(out)
    path = out / 'improved.yaml'
    has_model = path.exists()
    improved = read_parameters(path, 'actuator') if has_model else NOMINAL
    runs = {'machine': machine, 'nominal': record('nominal', of(NOMINAL)),
            'improved': record('improved', of(improved))}
    return FoundEffect(gap, has_model, runs, {
        name: float(np.sqrt(np.mean((runs[name].signal('force') - machine.signal('force')) ** 2)))
        for name in ('nominal', 'improved')})
