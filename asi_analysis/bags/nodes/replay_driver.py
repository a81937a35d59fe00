"""Driver `replay`: the recorded states of a bag, to test a controller on recorded data."""

import sys
import warnings
from collections.abc import Mapping
from typing import Final

import numpy as np

from asi_actuator.driver import Health
from asi_actuator.model.actuator import Measurement
from asi_analysis.bags.bag import read_bag
from asi_analysis.bags.run import hold_last
from asi_analysis.errors import InputError
from asi_common.parameter import ParameterError, Value

# Largest relative difference between the periods of the bag and of the node.
SAME_PERIOD: Final = 0.01


class ReplayedActuator:
    """States 1 to n of a bag, whatever the controller commands; see `asi_actuator.driver`."""

    hardware = False
    health = Health()

    def __init__(self, values: Mapping[str, Value], period_s: float):
        """Read the bag. Raises ParameterError if it cannot be played at this rate."""
        path = str(values['replay.bag'])
        try:
            with warnings.catch_warnings(record=True) as damages:
                run = read_bag(path)
        except InputError as error:
            raise ParameterError(f'replay.bag = {path!r} cannot be played: {error}') from error
        for damage in damages:
            print(damage.message, file=sys.stderr)
        if run.force_n is None or run.time_s.size < 2:
            raise ParameterError(f'replay.bag = {path!r} cannot be played: it holds no force')
        recorded_s = float(np.median(np.diff(run.time_s)))
        if abs(recorded_s / period_s - 1.0) > SAME_PERIOD:
            raise ParameterError(f'rate_hz = {1.0 / period_s:g} is not allowed with replay.bag = '
                                 f'{path!r}: it takes {1.0 / recorded_s:.6g}, as recorded')
        zero = np.zeros(run.time_s.size)
        signals = (run.force_n, run.valve_position_m, run.position_m, run.velocity_m_s)
        self._states = np.column_stack([zero if s is None else hold_last(s) for s in signals])
        self.last_tick = len(self._states)
        self._place = 0

    def open(self) -> None:
        pass

    def exchange(self, command_n: float, enabled: bool, periods: int) -> Measurement:
        """Return the state recorded `periods` later; at the end the last one."""
        self._place = min(self._place + periods, len(self._states) - 1)
        force, valve, position, velocity = map(float, self._states[self._place])
        return force, valve, position, velocity

    def configure(self, values: Mapping[str, Value]) -> None:
        pass

    def reset(self) -> None:
        """Play from the start."""
        self._place = 0

    def close(self) -> None:
        pass


