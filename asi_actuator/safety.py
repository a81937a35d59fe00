"""
Safety of the valve: states of the node, watchdogs, and limits of the command.

Independent of ROS. A command of the controller reaches the actuator only through `command`, which
returns 0 unless the state is enabled.
"""

import math
from collections import deque
from collections.abc import Callable, Mapping
from enum import StrEnum
from typing import Final

from asi_actuator.driver import Health
from asi_actuator.joint_parameters import TURNING
from asi_actuator.model.actuator import Measurement
from asi_common.parameter import Value

# Most commands per control period: one, with a margin for a busy machine.
MOST_COMMANDS: Final = 1.5


class State(StrEnum):
    """State of the actuator's node; FAULT lasts until it is reset."""

    DISABLED = 'disabled'
    ENABLED = 'enabled'
    FAULT = 'fault'


class Safety:
    """Decides which command the valve gets; the first watchdog that trips shuts it."""

    def __init__(self, values: Mapping[str, Value], period_s: float, power_up: State,
                 changed: Callable[[], None]):
        """
        Begin in the state `power_up`.

        values: the parameters of the node by name; changed() is called after each change of state.
        """
        self.state = self._power_up = power_up
        self.enabled = power_up is State.ENABLED
        self.reason = ''
        self._period_s = period_s
        self._changed = changed
        self._command_n = 0.0
        self._last_force_n: float | None = None
        self._disagreement = 0.0
        # Of the last second.
        self._links: deque[Health] = deque(maxlen=max(2, round(1.0 / period_s)))
        self.configure(values)

    def configure(self, values: Mapping[str, Value]) -> None:
        """Take new limits."""
        def number(name: str) -> float:
            return float(values[name])

        self._command_limit_n = number('command_limit')
        self._command_step_n = number('limit.command_rate') * self._period_s
        self._command_age_s = number('command_timeout')
        self._force_n = number('limit.force')
        self._force_rate = number('limit.force_rate')
        self._valve_m = number('limit.valve_position')
        self._velocity = number('limit.velocity')
        self._disagreement_m = number('limit.valve_disagreement')
        self._disagreement_weight = -math.expm1(
            -self._period_s / number('limit.valve_disagreement_time'))
        self._state_age_s = number('limit.state_age')
        self._lost_states = number('limit.lost_states')
        self._bad_frames = number('limit.bad_frames')
        self._turns = values.get('joint.type') == 'revolute'
        # A joint has no valve, whose position could disagree.
        self._full_opening_m, self._valve_gain = math.inf, 0.0
        if 'valve_characteristic.gain' in values:
            self._full_opening_m = number('valve_characteristic.full_opening')
            self._valve_gain = (number('valve_characteristic.gain') * self._full_opening_m
                                / number('valve_characteristic.maximum_force'))

    def enable(self) -> str:
        """Enable commands; return the reason of a refusal, or ''."""
        if self.state is State.FAULT:
            return f'in fault, reset first: {self.reason}'
        self._go(State.ENABLED)
        return ''

    def disable(self) -> None:
        """Close the valve; a fault stays a fault."""
        if self.state is State.ENABLED:
            self._go(State.DISABLED)

    def reset(self) -> None:
        """Clear a fault; the state is that after power-up."""
        self._forget()
        self._go(self._power_up)

    def trip(self, reason: str) -> None:
        """Close the valve until the reset. The first reason is kept: others are its effects."""
        if self.state is not State.FAULT:
            self._go(State.FAULT, reason)

    def command(self, wanted_n: float) -> float:
        """Return the valve command (N) that is nearest to the wanted one and allowed."""
        last_n, step_n, limit_n = self._command_n, self._command_step_n, self._command_limit_n
        if not self.enabled:
            wanted_n = 0.0
        elif not (last_n - step_n <= wanted_n <= last_n + step_n
                  and -limit_n <= wanted_n <= limit_n):
            if math.isfinite(wanted_n):
                near_n = _within(wanted_n, last_n - step_n, last_n + step_n)
                wanted_n = _within(near_n, -limit_n, limit_n)
            else:
                self.trip(f'valve_command = {wanted_n} N is not a finite number')
                wanted_n = 0.0
        self._command_n = wanted_n
        return wanted_n

    def watch_command(self, age_s: float) -> None:
        """Check the age (s) of the newest command."""
        if self.enabled and age_s > self._command_age_s:
            self._exceeded('age of valve_command', age_s, 's', 'command_timeout',
                           self._command_age_s,
                           ': the controller is silent, or the machine too busy for this limit')

    def watch_number_of_commands(self, commands: int, periods: int) -> None:
        """Check the number of commands in a number of control periods, about a second."""
        if self.enabled and commands > MOST_COMMANDS * periods:
            self.trip(f'{commands} valve_commands in {periods} control periods: do two '
                      'controllers run, or one with another rate_hz?')

    def watch_link(self, health: Health) -> None:
        """Check the link to the actuator; once a period."""
        if health.problem:
            self.trip(health.problem)
        if health.state_age_s > self._state_age_s:
            self._exceeded('age of the newest state', health.state_age_s, 's', 'limit.state_age',
                           self._state_age_s)
        self._links.append(health)
        lost = health.lost_states - self._links[0].lost_states
        bad = health.bad_frames - self._links[0].bad_frames
        if lost > self._lost_states:
            self._exceeded('states lost within 1 s', lost, '', 'limit.lost_states',
                           self._lost_states)
        if bad > self._bad_frames:
            self._exceeded('bad frames within 1 s', bad, '', 'limit.bad_frames', self._bad_frames)

    def watch_state(self, measured: Measurement, periods: int) -> None:
        """Check a state that came `periods` control periods after the one before."""
        force, valve, position, velocity = measured
        rate = 0.0
        if self._last_force_n is not None and periods > 0:
            rate = (force - self._last_force_n) / (periods * self._period_s)
        self._last_force_n = force
        disagreement = self._mean_disagreement(valve)
        # Formulated so that nan trips too.
        if not (abs(force) <= self._force_n and abs(valve) <= self._valve_m
                and abs(velocity) <= self._velocity and abs(rate) <= self._force_rate
                and abs(disagreement) <= self._disagreement_m and math.isfinite(position)):
            self._trip_for_state(measured, rate, disagreement)

    def _trip_for_state(self, measured: Measurement, rate: float, disagreement: float) -> None:
        """Trip with the first limit that a state exceeds."""
        force, valve, position, velocity = measured
        if not math.isfinite(position):
            self.trip(f'position = {position} m is not a finite number')
        for signal, value, unit, name, limit in (
                ('force', force, 'N', 'limit.force', self._force_n),
                ('valve_position', valve, 'm', 'limit.valve_position', self._valve_m),
                ('velocity', velocity, 'm/s', 'limit.velocity', self._velocity),
                ('rate of the force', rate, 'N/s', 'limit.force_rate', self._force_rate),
                ('valve_position less that of the command', disagreement, 'm',
                 'limit.valve_disagreement', self._disagreement_m)):
            if not abs(value) <= limit:
                self._exceeded(signal, value, TURNING[unit] if self._turns else unit, name, limit)

    def _mean_disagreement(self, valve_m: float) -> float:
        """
        Return the mean difference (m) between the valve position and that of the static model.

        The static model (valve_characteristic.*) gives the position for the command. Dynamics and
        hysteresis, which differ from one valve to the next, average out over time.
        """
        full, expected = self._full_opening_m, self._valve_gain * self._command_n
        if not -full <= expected <= full:
            expected = _within(expected, -full, full)
        if not -full <= valve_m <= full:
            valve_m = _within(valve_m, -full, full)
        mean = self._disagreement
        self._disagreement = mean = mean + self._disagreement_weight * (valve_m - expected - mean)
        return mean

    def _exceeded(self, signal: str, value: float, unit: str, limit_name: str, limit: float,
                  advice: str = '') -> None:
        unit = f' {unit}' if unit else ''
        self.trip(f'{signal} = {value:.6g}{unit} exceeds {limit_name} = {limit:g}{unit}{advice}')

    def _forget(self) -> None:
        self._command_n = 0.0
        self._last_force_n = None
        self._disagreement = 0.0
        self._links.clear()

    def _go(self, state: State, reason: str = '') -> None:
        if state is not self.state or reason != self.reason:
            self.state, self.reason = state, reason
            self.enabled = state is State.ENABLED
            self._changed()


def _within(value: float, low: float, high: float) -> float:
    """Return a value limited to a range; faster than min and max, and nan stays nan."""
    return low if value < low else high if value > high else value
