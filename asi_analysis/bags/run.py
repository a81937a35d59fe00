"""A recording as named arrays: what every analysis works on."""

from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from asi_analysis.errors import InputError

Array = npt.NDArray[np.float64]


class StateChange(NamedTuple):
    """The state that the actuator's node is in from a time on, and why, '' if it need not say."""

    time_s: float
    state: str      # disabled, enabled or fault
    reason: str


class Signal(NamedTuple):
    """One signal of a run: its name in tables and mappings, its field of `Run`, its unit."""

    name: str
    field: str
    unit: str


SIGNALS = (
    Signal('reference', 'reference_n', 'N'),
    Signal('command', 'command_n', 'N'),
    Signal('force', 'force_n', 'N'),
    Signal('valve_position', 'valve_position_m', 'm'),
    Signal('position', 'position_m', 'm'),
    Signal('velocity', 'velocity_m_s', 'm/s'),
)


# What a reference in a unit asks for; of a joint that turns, in N m, rad and rad/s.
CONTROLLED = {'N': 'force', 'Nm': 'force', 'm': 'position', 'rad': 'position', 'm/s': 'velocity',
              'rad/s': 'velocity'}


@dataclass(frozen=True)
class Run:
    """
    A recording: arrays of n samples on one time base.

    An absent signal is None, a missing sample is NaN. Command k is the answer to
    state k, and acts from it to the next. Time counts from the first state. What was imported may
    be in other units (the reference of a position servo in metres, a joint that turns in rad and
    N m, a command in volts): ask `unit`.
    """

    time_s: Array
    reference_n: Array | None = None
    command_n: Array | None = None
    force_n: Array | None = None
    valve_position_m: Array | None = None
    position_m: Array | None = None
    velocity_m_s: Array | None = None
    source: str = ''
    information: dict[str, Any] = field(default_factory=dict)
    states: tuple[StateChange, ...] = ()

    def __post_init__(self) -> None:
        for name, values in self.signals().items():
            if values.shape != self.time_s.shape:
                raise ValueError(f'{name} has shape {values.shape}, time {self.time_s.shape}')

    def __len__(self) -> int:
        return len(self.time_s)

    def __getitem__(self, part: slice) -> 'Run':
        """Return the samples of a slice, as a run."""
        cut: dict[str, Any] = {f.name: value[part] for f in fields(self)
                               if isinstance(value := getattr(self, f.name), np.ndarray)}
        return replace(self, **cut)

    def between(self, start_s: float, end_s: float) -> 'Run':
        """Return the samples with start_s <= time < end_s; their times stay as they are."""
        return self[slice(*np.searchsorted(self.time_s, [start_s, end_s]))]

    def signals(self) -> dict[str, Array]:
        """Return the signals that are there, by name ('force', not 'force_n')."""
        return {signal.name: values for signal in SIGNALS
                if (values := getattr(self, signal.field)) is not None}

    def signal(self, name: str) -> Array:
        """Return a signal by name; raises InputError if the run does not hold it."""
        try:
            return self.signals()[name]
        except KeyError:
            raise InputError(f'{self.source}: no {name} in this run; it holds '
                             f'{", ".join(self.signals()) or "nothing"}') from None

    def unit(self, name: str) -> str:
        """Return the unit of a signal: that of `information['signals']`, or the usual one."""
        usual = {signal.name: signal.unit for signal in SIGNALS}
        return self.information.get('signals', {}).get(name, usual[name])

    def controlled(self) -> str:
        """Return the name of the signal that the reference asks for, by the reference's unit."""
        return CONTROLLED[self.unit('reference')]

    @property
    def period_s(self) -> float:
        """The time between two samples: the median, to the nanosecond of the stamps."""
        return round(float(np.median(np.diff(self.time_s))), 9) if len(self) > 1 else np.nan

    @property
    def rate_hz(self) -> float:
        """Samples a second."""
        return 1.0 / self.period_s

    @property
    def duration_s(self) -> float:
        """The time that the samples stand for: the last one lasts a period too."""
        return float(self.time_s[-1] - self.time_s[0]) + self.period_s if len(self) > 1 else 0.0

    def __str__(self) -> str:
        lines = [f'{self.source or "run"}: {len(self)} samples, {self.rate_hz:g} Hz, '
                 f'{self.duration_s:.6g} s',
                 f'{"signal":<16}{"unit":<6}{"smallest":>12}{"mean":>12}{"largest":>12}'
                 f'{"missing":>9}']
        present = self.signals()
        for name, values in present.items():
            known = values[~np.isnan(values)]
            figures = (known.min(), known.mean(), known.max()) if len(known) else (np.nan,) * 3
            lines.append(f'{name:<16}{self.unit(name):<6}'
                         + ''.join(f'{figure:>12.5g}' for figure in figures)
                         + f'{len(values) - len(known):>9}')
        absent = [signal.name for signal in SIGNALS if signal.name not in present]
        if absent:
            lines.append('absent: ' + ', '.join(absent))
        return '\n'.join(lines)
