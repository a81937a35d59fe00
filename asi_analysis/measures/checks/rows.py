"""The difference equation of a linear controller, one row for each command of a recording."""

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from asi_analysis.arrays import Array

# Order of the difference equation: earlier samples in it, as many as a compensator of this package
# has poles.
ORDER: Final = 8
MOST_FITTED: Final = 5000   # commands to which the equation is fitted, at most
# Largest residual of an exact equation, as a share of the range of the command.
EXACT: Final = 1e-6
# Least number of digits of a recording that is compared; digits beyond which none are counted.
FEWEST_DIGITS: Final = 5
MOST_DIGITS: Final = 12
# Singular values below this share of the largest are rounding errors.
RANK_TOLERANCE: Final = 1e-10
# Digits of a limit, such as a saturation; a recording has two more.
LIMIT_DIGITS: Final = 6


class Rows(NamedTuple):
    """The equations of the fit, one row a command."""

    samples: npt.NDArray[np.intp]   # index of the command
    known: Array                    # n x columns: earlier commands, references, signals
    command: Array
    order: int                      # earlier samples of each signal
    rounding: float                 # of the recorded numbers, as a share of the largest

    def exact(self) -> float:
        """Return the largest residual of an exact equation, in the unit of the command."""
        return max(EXACT, self.rounding) * float(np.ptp(self.command))

    def of_order(self, order: int) -> 'Rows':
        """Return the rows for an equation of a lower order."""
        commands, references, signals = self.groups()
        return Rows(self.samples, np.hstack([commands[:, :order], references[:, :order + 1],
                                              signals[:, :order + 1]]), self.command, order,
                     self.rounding)

    def groups(self) -> list[Array]:
        """Return the columns of the earlier commands, of the references and of the signals."""
        return np.split(self.known, [self.order, 2 * self.order + 1], axis=1)

    def backwards(self) -> 'Rows':
        """Return the rows of the same samples in the reverse order, each from its last one."""
        earlier, references, signals = self.groups()
        commands = np.column_stack([self.command, earlier])[:, ::-1]
        return self._replace(command=commands[:, 0], known=np.hstack(
            [commands[:, 1:], references[:, ::-1], signals[:, ::-1]]))


def rows_of(time: Array, command: Array, reference: Array, signal: Array) -> Rows:
    """Return the rows without missing samples, and without a limited or held command."""
    count = len(time)
    free = np.isfinite(command)
    rounding = max(_rounding(command), _rounding(signal))
    digits = round(min(LIMIT_DIGITS, -np.log10(rounding) - 1.0)) if rounding else LIMIT_DIGITS
    for extreme in (np.nanmax(command), np.nanmin(command)) if free.any() else ():
        if float(f'{extreme:.{digits}g}') == extreme:      # a round number: a limit
            free &= command != extreme
    free[1:] &= command[1:] != command[:-1]
    free[:-1] &= command[1:] != command[:-1]
    # Any linear controller rests at 0: what it does with the first change is known.
    rests = (command == 0.0) & (reference == 0.0) & (signal == 0.0)
    for begin in np.flatnonzero(rests[:-1] & ~rests[1:]):
        part = slice(max(int(begin) + 1 - ORDER, 0), int(begin) + 1)
        free[part] |= rests[part]
    usable = free & np.isfinite(reference) & np.isfinite(signal)
    steps = np.diff(time, prepend=time[0] - 1.0)
    usable &= np.abs(steps - np.median(steps)) < 0.5 * np.median(steps)
    whole = np.convolve(usable, np.ones(ORDER + 1))[:count] > ORDER + 0.5
    samples = np.flatnonzero(whole)
    columns = [command[samples - lag] for lag in range(1, ORDER + 1)]
    columns += [values[samples - lag] for values in (reference, signal)
                for lag in range(ORDER + 1)]
    return Rows(samples, np.stack(columns, axis=1), command[samples], ORDER, rounding)


def _rounding(values: Array) -> float:
    """
    Return the rounding error of a number with as many digits as n samples have, as a share of it.

    0 for few digits: those of a sensor, which the controller had too.
    """
    known = values[np.isfinite(values) & (values != 0.0)]
    known = known[::1 + len(known) // MOST_FITTED]
    exponents = np.floor(np.log10(np.abs(known)))
    for digits in range(1, MOST_DIGITS):
        scaled = known * 10.0 ** (digits - 1 - exponents)
        if (np.abs(scaled - np.round(scaled)) < 1e-3).all():
            return float(10.0 ** (1 - digits)) if digits >= FEWEST_DIGITS else 0.0
    return 0.0


def sizes_of(known: Array) -> Array:
    """Return the largest absolute value of each column, 1 for a column of zeros."""
    sizes = np.abs(known).max(axis=0)
    return np.where(sizes > 0.0, sizes, 1.0)


def fit(known: Array, command: Array) -> Array:
    """Return the coefficients of the columns by least squares."""
    scale = sizes_of(known)
    return np.asarray(np.linalg.lstsq(known / scale, command, rcond=RANK_TOLERANCE)[0] / scale)
