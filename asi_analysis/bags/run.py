"""`Run`: a recording as named arrays, the input of every analysis."""

from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from asi_analysis.arrays import Array
from asi_analysis.errors import InputError
from asi_analysis.reporting.result import Table, as_html, as_text, frame, shown

if TYPE_CHECKING:
    import pandas
    from matplotlib.axes import Axes


class StateChange(NamedTuple):
    """A new state of the actuator's node; reason: of a fault, else ''."""

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
    Signal('pressure', 'pressure_pa', 'Pa'),
)


# Signal that is controlled, by the unit of the reference; N m, rad and rad/s of a rotary joint.
CONTROLLED = {'N': 'force', 'Nm': 'force', 'm': 'position', 'rad': 'position', 'm/s': 'velocity',
              'rad/s': 'velocity', 'Pa': 'pressure'}
# Signals that may be measured where no reference says which is controlled.
OUTPUTS = ('force', 'position', 'velocity', 'pressure', 'valve_position', 'command')
# Steps of the time are even if they differ from the median by less than this share of it.
EVEN = 0.01


@dataclass(frozen=True, repr=False)
class Run:
    """
    A recording: arrays of n samples on one time base.

    A signal that was not recorded is None, a missing sample is NaN. Command k is computed from
    state k and acts until the next one. Time starts at 0 with the first state. An imported
    recording may have other units than the names say (a position servo has its reference in
    metres, a rotary joint in rad and N m, a command may be in volts): `unit` returns them.

    A slice of whole numbers is one of samples, a slice with a decimal number one of time (s):

    >>> import asi_analysis as asi
    >>> run = asi.simulate({}, {'reference.amplitude': 100.0}, 0.4)
    >>> len(run), len(run[:10]), len(run[0.1:0.3])
    (2000, 10, 1000)
    >>> float(run[0.1:].time_s[0])
    0.1
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
    pressure_pa: Array | None = None
    problems: tuple[str, ...] = ()      # sentences on what could not be read, or was lost
    lacking: int = 0    # samples of a run in lock-step that its file does not hold

    def __post_init__(self) -> None:
        for name, values in self.signals().items():
            if values.shape != self.time_s.shape:
                raise ValueError(f'{name} has shape {values.shape}, time {self.time_s.shape}')

    def __len__(self) -> int:
        return len(self.time_s)

    def __getitem__(self, part: slice) -> 'Run':
        """Return a slice: of time (s) if a bound is a float, of samples otherwise."""
        if isinstance(part.start, float) or isinstance(part.stop, float):
            return self.between(-np.inf if part.start is None else part.start,
                                np.inf if part.stop is None else part.stop)
        cut: dict[str, Any] = {f.name: value[part] for f in fields(self)
                               if isinstance(value := getattr(self, f.name), np.ndarray)}
        return replace(self, **cut)

    def between(self, start_s: float, end_s: float) -> 'Run':
        """Return the samples with start_s <= time < end_s; time is not shifted."""
        return self[slice(*np.searchsorted(self.time_s, [start_s, end_s]))]

    def signals(self) -> dict[str, Array]:
        """Return the recorded signals by name ('force', not 'force_n')."""
        return {signal.name: values for signal in SIGNALS
                if (values := getattr(self, signal.field)) is not None}

    def signal(self, name: str) -> Array:
        """Return a signal by name; raises InputError if it was not recorded."""
        try:
            return self.signals()[name]
        except KeyError:
            raise InputError(f'{self.source}: no {name} in this run; it has '
                             f'{", ".join(self.signals()) or "nothing"}') from None

    def unit(self, name: str) -> str:
        """Return the unit of a signal: from `information['signals']`, else that of SIGNALS."""
        usual = {signal.name: signal.unit for signal in SIGNALS}
        return self.information.get('signals', {}).get(name, usual[name])

    def controlled(self) -> str:
        """
        Return the name of the controlled signal, which has the unit of the reference.

        Raises InputError for a reference in a unit that no signal has.
        """
        unit = self.unit('reference')
        if unit not in CONTROLLED:
            raise InputError(f'{self.source}: reference is in {unit!r}; it takes '
                             f'{", ".join(CONTROLLED)}')
        return CONTROLLED[unit]

    def output(self, name: str | None = None) -> str:
        """
        Return the name of the signal to measure: `name`, else the controlled one, else of OUTPUTS.

        Raises InputError for a name that was not recorded; 'force' if nothing was.
        """
        present = self.signals()
        if name is not None:
            self.signal(name)
            return name
        first = [] if self.reference_n is None else [self.controlled()]
        return next((each for each in (*first, *OUTPUTS) if each in present), 'force')

    def followed(self, name: str | None = None) -> Array | None:
        """Return the values of `output(name)` if the reference is that signal's, else None."""
        output = self.output(name)
        return (self.signals().get(output)
                if self.reference_n is not None and output == self.controlled() else None)

    @property
    def period_s(self) -> float:
        """Sampling period: the usual time between two samples, rounded to 1 ns."""
        return round(usual_step(self.time_s), 9) if len(self) > 1 else np.nan

    @property
    def rate_hz(self) -> float:
        """Sampling rate."""
        return 1.0 / self.period_s

    @property
    def duration_s(self) -> float:
        """Length of the recording: that of its samples times the period."""
        return float(self.time_s[-1] - self.time_s[0]) + self.period_s if len(self) > 1 else 0.0

    def columns(self) -> dict[str, Array]:
        """Return time and signals by name and unit, such as force_n."""
        return {'time_s': self.time_s} | {
            f'{name}_{self.unit(name).replace("/", "_").lower()}': values
            for name, values in self.signals().items()}

    def to_frame(self) -> 'pandas.DataFrame':
        """Return `columns` as a pandas DataFrame; raises InputError without pandas."""
        return frame(self.columns())

    def plot(self) -> 'list[Axes]':
        """Draw the signals over time in a pyplot figure; return its axes, one for each unit."""
        from asi_analysis.reporting.figures import recording
        return shown(recording(self.time_s, {
            name: (values, self.unit(name)) for name, values in self.signals().items()}))

    def parts(self) -> Iterator[str | Table]:
        """Yield the recording for people: its length and a table of its signals."""
        yield (f'{self.source or "run"}: {len(self)} samples, {self.rate_hz:g} Hz, '
               f'{self.duration_s:.6g} s')
        columns = ('signal', 'unit', 'smallest', 'mean', 'largest', 'missing')
        present, rows = self.signals(), []
        for name, values in present.items():
            known = values[~np.isnan(values)]
            figures = (known.min(), known.mean(), known.max()) if len(known) else (np.nan,) * 3
            rows.append((name, self.unit(name), *(f'{figure:.5g}' for figure in figures),
                         str(len(values) - len(known))))
        yield Table(columns, rows, right=columns[2:])
        absent = [signal.name for signal in SIGNALS
                  if signal.name not in present and signal.name != 'pressure']   # never of ours
        if absent:
            yield 'absent: ' + ', '.join(absent)

    def __str__(self) -> str:
        return as_text(self.parts())

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return as_html(self.parts())


def usual_step(time_s: Array) -> float:
    """
    Return the median step of n times; of even ones their mean.

    Seconds since 1970 have a resolution of 0.24 us: at 1 kHz the median is then off by 7e-5.
    """
    steps = np.diff(time_s)
    usual = float(np.median(steps)) if steps.size else np.nan
    even = float(np.abs(steps - usual).max(initial=0.0)) < EVEN * usual
    return float(steps.mean()) if even else usual


def hold_last(values: Array) -> Array:
    """Return a signal with missing samples replaced by the last one before (or the first)."""
    known = np.isfinite(values)
    if not known.any():
        return np.zeros_like(values)
    last = np.maximum.accumulate(np.where(known, np.arange(values.size), 0))
    return values[np.maximum(last, np.argmax(known))]
