"""The controller without ROS: reference, compensator, and when they begin."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from asi_actuator.parameters import Parameter, Value, as_record
from asi_controller.compensator import compensate, compensator
from asi_controller.parameters import COMPENSATOR_PARAMETERS, REFERENCE_PARAMETERS
from asi_controller.reference import reference_force


class Answer(NamedTuple):
    """The answer to a state: desired force and valve command, N."""

    reference_n: float
    command_n: float


def _of(table: tuple[Parameter, ...], values: Mapping[str, Value]) -> dict[str, Value]:
    return {parameter.name: values[parameter.name] for parameter in table}


class Controller:
    """Answers measured forces with valve commands, one a control period."""

    def __init__(self, values: Mapping[str, Value], rate_hz: float, lockstep: bool):
        """
        Begin with parameters by name: those of compensator and reference.

        lockstep: stamps are whole control periods, and time is counted in them, so that it has
        the same bits as in `asi_analysis.closed_loop`. Raises ParameterError for parameters that
        are not allowed.
        """
        self.rate_hz = rate_hz
        self.lockstep = lockstep
        self.enabled = True
        self.topic_n = 0.0
        self.begin(values)
        # Compiled now, not in the first tick.
        self.answer(0, 0.0)
        self.begin(values)

    @staticmethod
    def check(values: Mapping[str, Value], rate_hz: float) -> None:
        """Raise ParameterError if the parameters do not go together."""
        chosen = _of(COMPENSATOR_PARAMETERS, values)
        compensator(chosen, rate_hz)
        # Its texts are refused when they are given, not when it is chosen.
        compensator(chosen | {'compensator': 'custom'}, rate_hz)

    def begin(self, values: Mapping[str, Value]) -> None:
        """Begin anew: nothing remembered, and the reference starts at the next answer."""
        self._compensator = compensator(_of(COMPENSATOR_PARAMETERS, values), self.rate_hz)
        self._start_reference(values)

    def change(self, values: Mapping[str, Value], changed: set[str]) -> None:
        """Take new parameters, of which `changed` are new, without a step of the command."""
        if changed & {parameter.name for parameter in COMPENSATOR_PARAMETERS}:
            self._compensator = compensator(
                _of(COMPENSATOR_PARAMETERS, values), self.rate_hz, self._compensator)
        if changed & {parameter.name for parameter in REFERENCE_PARAMETERS}:
            self._start_reference(values)

    def _start_reference(self, values: Mapping[str, Value]) -> None:
        self._reference: np.void = as_record(
            _of(REFERENCE_PARAMETERS, values), REFERENCE_PARAMETERS)
        self.generates = values['reference.shape'] != 'topic'
        self._start_ns: int | None = None

    def enable(self, enabled: bool, values: Mapping[str, Value]) -> None:
        """Close the loop, from a command of 0 and without a step, or open it: command 0."""
        if enabled and not self.enabled:
            self._compensator['command'] = 0.0
            self._compensator = compensator(
                _of(COMPENSATOR_PARAMETERS, values), self.rate_hz, self._compensator)
            self._compensator['fresh'] = 1
        self.enabled = enabled

    def answer(self, stamp_ns: int, force_n: float) -> Answer:
        """Return the answer to the force (N) that was measured at a stamp."""
        if self._start_ns is None:
            self._start_ns = stamp_ns
        reference = self.topic_n
        if self.generates:
            time_s = (stamp_ns - self._start_ns) * 1e-9
            if self.lockstep:
                time_s = round(time_s * self.rate_hz) * (1.0 / self.rate_hz)
            reference = reference_force(time_s, self._reference)
        command = compensate(self._compensator, reference, force_n) if self.enabled else 0.0
        return Answer(reference, command)

    @property
    def saturated(self) -> bool:
        """Whether the last command was at its limit."""
        return bool(abs(self._compensator['command']) >= self._compensator['saturation'])
