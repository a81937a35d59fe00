"""The declaration of a published fact: its rows, their measurement and conditions."""

import math
from collections.abc import Callable, Mapping
from enum import StrEnum
from typing import Final, NamedTuple

import numpy as np

from asi_actuator.parameters import as_record
from asi_analysis.loop.bench import Bench, Runner, Values, in_process
from asi_analysis.paper.facts.conditions import Conditions
from asi_common.parameter import Value

Measured = dict[str, float]
INFINITE: Final = math.inf


class Role(StrEnum):
    """Role of a row in the fit: input of the model, fitted, or held out for validation."""

    GIVEN = 'given'
    FITTED = 'fitted'
    HELD_OUT = 'held out'


class Stage(StrEnum):
    """Order in which a search measures the facts: the cheapest for their information first."""

    PREDICTION = 'describing function, damping'
    TABLE_1 = 'Table 1'
    CYCLE = 'cycle'
    BANDWIDTH = 'bandwidths, loop'
    ONSET = 'onsets'


class Setup(NamedTuple):
    """
    The actuator and conditions on which facts are measured.

    measured: values measured before on this set-up, by name. runner: makes a closed-loop run, in
    this process or with the nodes. refinement: factor on every resolution; 2 halves steps and
    doubles durations. fitted_only: measure only what the fitted rows need.
    """

    actuator: Values
    conditions: Conditions
    measured: Measured
    runner: Runner = in_process
    refinement: int = 1
    fitted_only: bool = False

    def record(self, *changes: Mapping[str, Value]) -> np.void:
        """Return the actuator's record, with changed parameters."""
        values = dict(self.actuator)
        for change in changes:
            values.update(change)
        return as_record(values)

    def proportional(self, gain: float) -> Values:
        """Return the parameters of the proportional controller with the feed-forward."""
        return {'compensator': 'proportional', 'gain': gain,
                'feedforward': self.conditions.feedforward}

    def loop(self, plant: np.void, gain: float) -> Bench:
        """Return a plant at rest under the proportional controller."""
        return Bench(plant, self.proportional(gain))

    def refined(self, refinement: int) -> 'Setup':
        """Return the set-up at a finer resolution, without measured values."""
        conditions = self.conditions
        return self._replace(
            actuator={**self.actuator, 'maximum_substep':
                      float(self.record()['maximum_substep']) / refinement},
            conditions=conditions._replace(
                onset_accuracy=conditions.onset_accuracy / refinement,
                ratio_accuracy=conditions.ratio_accuracy / refinement,
                onset_watched_s=conditions.onset_watched_s * refinement,
                describing_samples=conditions.describing_samples * refinement),
            measured={}, refinement=refinement)


class Row(NamedTuple):
    """One published figure: met if low <= simulated <= high. name: that of the measured value."""

    name: str
    quantity: str
    section: str
    published: float
    unit: str
    low: float
    high: float
    role: Role = Role.FITTED

    @property
    def tolerance(self) -> str:
        """Describe in words which values meet the row."""
        if self.low == self.high:
            return f'exactly {self.low:g}'
        if math.isinf(self.high):
            return f'at least {self.low:.4g}'
        if math.isinf(self.low) or (self.low == 0.0 and self.high > self.low):
            return f'at most {self.high:.4g}'
        return f'{self.low:.4g} to {self.high:.4g}'

    @property
    def one_sided(self) -> bool:
        """Return whether the row has one limit only: a minimum, or a maximum from 0."""
        return math.isinf(self.high) or self.low == 0.0

    def met(self, value: float) -> bool:
        """Return whether a value meets the row."""
        return bool(self.low <= value <= self.high)


class Fact(NamedTuple):
    """
    A published fact, declared as FACT by a file of `published`.

    measure: returns the value of each row by its name. conditions: describes the conditions.
    stage: None if no row is fitted. over_ros: the part of `measure` that consists of single
    closed-loop runs, which the nodes can make too. notes: remarks on measured rows, by name.
    """

    id: str
    rows: tuple[Row, ...]
    measure: Callable[[Setup], Measured]
    conditions: Callable[[Setup], str]
    method: str
    stage: Stage | None = None
    over_ros: Callable[[Setup], Measured] | None = None
    notes: Callable[[Setup], dict[str, str]] | None = None


def around(name: str, quantity: str, section: str, published: float, unit: str, share: float,
           role: Role = Role.FITTED) -> Row:
    """Return a row that is met within plus or minus a share of the published value."""
    return Row(name, quantity, section, published, unit, published * (1.0 - share),
               published * (1.0 + share), role)
