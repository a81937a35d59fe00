"""The controller without ROS: reference generator and compensator."""

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from asi_common.jit import compiled_for, jit
from asi_common.parameter import Parameter, Value
from asi_common.record import record_of
from asi_controller.compensator import REST, compensate, compensator
from asi_controller.compensators import COMPENSATORS
from asi_controller.parameters import COMPENSATOR_PARAMETERS, REFERENCE_PARAMETERS
from asi_controller.reference import TOPIC, check_frequencies, reference_force


@jit
def _answer(references, compensators, enabled, time, topic, measured, velocity):
    """
    Return desired force, valve command, and whether the command is saturated.

    references, compensators: arrays of one record.
    """
    signal, c = references[0], compensators[0]
    reference = topic if signal.reference_shape == TOPIC else reference_force(time, signal)
    command = compensate(c, reference, measured, velocity) if enabled else 0.0
    return reference, command, abs(command) >= c.saturation


def _of(table: tuple[Parameter, ...], values: Mapping[str, Value]) -> dict[str, Value]:
    """Return those of the values that are parameters of a table."""
    return {parameter.name: values[parameter.name] for parameter in table}


class Controller:
    """Computes a valve command from the measured force in each control period."""

    def __init__(self, values: Mapping[str, Value], rate_hz: float, lockstep: bool):
        """
        Start with parameters by name: those of compensator and reference.

        lockstep: stamps are whole control periods, and time is computed from their number, for the
        same bits as in `asi_analysis.loop.closed_loop`. Raises ParameterError for
        parameters that are not allowed.
        """
        self.rate_hz = rate_hz
        self._period_s = 1.0 / rate_hz
        self.lockstep = lockstep
        self.enabled = True
        self.topic_n = 0.0
        self.begin(values)
        self._answer = compiled_for(
            _answer, self._references, self._compensators, True, 0.0, 0.0, 0.0, 0.0)

    @staticmethod
    def check(values: Mapping[str, Value], rate_hz: float) -> None:
        """Raise ParameterError if a combination of parameters is not allowed."""
        chosen = _of(COMPENSATOR_PARAMETERS, values)
        compensator(chosen, rate_hz)
        check_frequencies(values, rate_hz)
        for each in COMPENSATORS.values():
            # A wrong text is refused when it is set, not when its compensator is selected.
            if any(isinstance(parameter.default, str) for parameter in each.parameters):
                compensator(chosen | {'compensator': each.name}, rate_hz)

    def begin(self, values: Mapping[str, Value]) -> None:
        """Restart: memory cleared, and the reference starts with the next answer."""
        self._start_compensator(values)
        self._start_reference(values)

    def change(self, values: Mapping[str, Value], changed: set[str]) -> None:
        """Apply parameters, of which `changed` are new, with bumpless transfer."""
        if changed & {parameter.name for parameter in COMPENSATOR_PARAMETERS}:
            self._start_compensator(values, self._compensators[0])
        if changed & {parameter.name for parameter in REFERENCE_PARAMETERS}:
            self._start_reference(values)

    def _start_compensator(self, values: Mapping[str, Value],
                           running: np.void | None = None) -> None:
        self._compensators = np.array([
            compensator(_of(COMPENSATOR_PARAMETERS, values), self.rate_hz, running)])

    def _start_reference(self, values: Mapping[str, Value]) -> None:
        self._references: npt.NDArray[np.void] = np.array([
            record_of(_of(REFERENCE_PARAMETERS, values), REFERENCE_PARAMETERS)])
        self.generates = values['reference.shape'] != 'topic'
        self._start_ns: int | None = None

    def enable(self, enabled: bool, values: Mapping[str, Value]) -> None:
        """Close the loop, with bumpless transfer from a command of 0, or open it: command 0."""
        if enabled and not self.enabled:
            self._compensators['command'] = 0.0
            self._start_compensator(values, self._compensators[0])
            self._compensators['fresh'] = REST
        self.enabled = enabled

    def answer(self, stamp_ns: int, force_n: float, velocity_m_s: float
               ) -> tuple[float, float, bool]:
        """
        Return desired force (N), command (N) and whether it is saturated.

        force_n, velocity_m_s: measured force (N) and velocity of the piston (m/s) at the stamp
        (ns).
        """
        if self._start_ns is None:
            self._start_ns = stamp_ns
        time_s = (stamp_ns - self._start_ns) * 1e-9
        if self.lockstep:
            time_s = round(time_s * self.rate_hz) * self._period_s
        answer: tuple[float, float, bool] = self._answer(
            self._references, self._compensators, self.enabled, time_s, self.topic_n, force_n,
            velocity_m_s)
        return answer
