"""
Whether the command is the answer of one linear controller to reference and controlled signal.

A digital controller computes each command from the samples of reference and signal that it has
received, and from its own earlier commands. Where a recording holds these samples, the relation is
exact to rounding errors, whatever the plant does and however large the noise is; a sample that was
altered later breaks it. A recording without such a relation (a nonlinear controller, some of its
samples, one that is not synchronised) tells nothing.
"""

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import linalg

from asi_analysis.arrays import Array, Mask

# Earlier samples that a command is computed from: the poles of the compensators of this package.
ORDER: Final = 8
LEAST_ROWS: Final = 20 * ORDER      # of commands that a relation is fitted to
# Rows that the relation is fitted to at most; parts of the recording from which a fit begins.
MOST: Final = 5000
PARTS: Final = 8
REFITS: Final = 5
# Largest residual of an exact relation, as a share of the range of the command; share of the rows
# that must obey, and of those that do not, which makes it the relation of another controller.
EXACT: Final = 1e-6
OBEY: Final = 0.5
# A residual that is a break, as a share of the range of the command.
BREAK: Final = 1e-3
# Least share of the signal in the range of the command that is an answer.
LEAST: Final = 1e-3
# Rows between two breaks, at least.
APART: Final = ORDER
# Breaks at most, more are another controller; altered samples of one break at most.
MOST_BREAKS: Final = 20
LONGEST: Final = 400
LEAST_MEMORY: Final = 3     # samples of a signal in a relation that tell altered ones
MOST_ROWS: Final = 0.9      # share of the samples that are compared: nearly all
MOST_LOST: Final = 2    # places with lost rows, more are what a nonlinear controller does
# Singular values below this share of the largest are rounding errors.
SMALL: Final = 1e-10
# Share of a row that the rows of the fit may not hold.
DETERMINED: Final = 1e-6
# Factors of a wrong sign or unit of force: N in mN, kN, lbf, kgf; shares of the reference that
# controllers pass on beside the answer to the error; rows that tell them apart.
FACTORS: Final = (1.0, -1.0, 1e3, 1e-3, 4.4482216, 1.0 / 4.4482216, 9.80665, 1.0 / 9.80665)
FEEDFORWARD: Final = (1.0, 0.0)
FEW: Final = 500
# Least difference of a factor from 1 that is another scale (a disturbance observer has one too),
# and largest condition of its fit.
OTHER_SCALE: Final = 0.3
CONDITION: Final = 1e4
# Largest condition of the samples themselves: of few sines without noise any relation is exact.
EXCITED: Final = 1e5
# Samples by which a signal may be recorded late; lags that are tried.
LATEST: Final = 400
TRIED: Final = 4


class Break(NamedTuple):
    """First and last sample of a part in which the command answers something else."""

    first: int
    last: int
    # If the rest of the relation holds there: measured signal = factor * recorded + offset.
    factor: float | None
    offset: float | None
    lost: bool      # it may be rows that are lost or repeated: so many commands lack their past


class Answer(NamedTuple):
    """
    The relation of the command to the samples of reference and signal.

    reference, signal: change of the command with that of the same sample, NaN where the recording
    does not tell, or the command hardly answers the signal; factor: by which the signal is larger
    than what the controller has compared with the reference, None where the recording does not
    tell; breaks: where the relation does not hold.
    """

    reference: float
    signal: float
    factor: float | None
    breaks: tuple[Break, ...]
    everywhere: bool    # it holds for all samples that were compared
    of_all: bool        # these are nearly all of the recording


class _Rows(NamedTuple):
    samples: npt.NDArray[np.intp]   # sample of the command of each row
    known: Array                    # n x columns: earlier commands, references, signals
    command: Array
    order: int                      # earlier samples of each

    def of_order(self, order: int) -> '_Rows':
        """Return the rows with fewer earlier samples."""
        commands, references, signals = self.groups()
        return _Rows(self.samples, np.hstack([commands[:, :order], references[:, :order + 1],
                                              signals[:, :order + 1]]), self.command, order)

    def groups(self) -> list[Array]:
        """Return the columns of the earlier commands, of the references and of the signals."""
        return np.split(self.known, [self.order, 2 * self.order + 1], axis=1)


def answer(time: Array, command: Array, reference: Array, signal: Array) -> Answer | None:
    """Return the relation of n samples at one rate; None if there is none that is exact."""
    rows = _rows(time, command, reference, signal)
    if len(rows.samples) < LEAST_ROWS:
        return None
    span = float(np.ptp(rows.command))
    if not span > 0.0:
        return None
    obeys = _obeying(rows, span)
    if obeys is None:
        return None
    rows, factors = _shortest(rows, obeys, span)
    space = _Space(rows.known[obeys])
    residual = np.where(space.holds(rows.known), rows.command - rows.known @ factors, 0.0)
    known = space.holds(np.eye(len(factors)))
    direct = [float(factors[k]) if known[k] else np.nan for k in (rows.order, 2 * rows.order + 1)]
    if not abs(direct[1]) * float(np.nanstd(signal)) > LEAST * span:
        direct = [np.nan, np.nan]
    factor = _factor(rows, obeys, span)
    if factor is None:
        factor = _scale(rows, obeys, span, factors, known)
    breaks = _breaks(rows, factors, residual, span, _remembers(rows, obeys, span))
    if factor is None or len(_lost(breaks)) > MOST_LOST:    # of few sines any relation is exact
        breaks = [each for each in breaks if each not in _lost(breaks)]
    return Answer(direct[0], direct[1], factor, tuple(breaks),
                  bool(np.abs(residual).max() < BREAK * span),
                  len(rows.samples) > MOST_ROWS * len(time))


def delayed_signal(time: Array, command: Array, reference: Array, signal: Array
                   ) -> tuple[str, int]:
    """
    Return which of 'reference' and 'signal' was recorded late, and by how many samples.

    '', 0 unless the command answers exactly to samples that come later.
    """
    change = np.diff(np.nan_to_num(command), 2, prepend=[0.0, 0.0])
    # A part with the largest change tells most lags that are none, in less time.
    begin = max(int(np.argmax(np.abs(change[2:]))) - ORDER, 0)
    part = slice(begin, begin + LEAST_ROWS + 4 * ORDER)
    for name, values in (('signal', signal), ('reference', reference)):
        other = np.diff(np.nan_to_num(values), 2, prepend=[0.0, 0.0])
        size = 2 ** int(np.ceil(np.log2(2 * len(change))))
        product = np.fft.irfft(np.fft.rfft(other, size) * np.conj(np.fft.rfft(change, size)))
        most = min(LATEST, len(change) // 4)
        likely = np.argsort(-np.abs(product[1:most]))[:TRIED] + 1
        for lag in (*likely, *range(1, min(ORDER, most) + 1)):
            moved = np.append(values[lag:], np.full(lag, np.nan))
            pair = (reference, moved) if name == 'signal' else (moved, signal)
            first = answer(time[part], command[part], *(each[part] for each in pair))
            if first is None or not first.everywhere:
                continue
            found = answer(time, command, *pair)
            sure = found is not None and found.everywhere and (
                name == 'signal' or found.factor == 1.0)
            if found and sure and abs(getattr(found, name)) > 0.0:
                return name, int(lag)
    return '', 0


def _rows(time: Array, command: Array, reference: Array, signal: Array) -> _Rows:
    """Return the rows whose samples are all there, and whose commands are not limited or held."""
    count = len(time)
    free = np.isfinite(command)
    for extreme in (np.nanmax(command), np.nanmin(command)) if free.any() else ():
        if float(f'{extreme:.6g}') == extreme:      # a limit that someone has set
            free &= command != extreme
    free[1:] &= command[1:] != command[:-1]
    free[:-1] &= command[1:] != command[:-1]
    usable = free & np.isfinite(reference) & np.isfinite(signal)
    steps = np.diff(time, prepend=time[0] - 1.0)
    usable &= np.abs(steps - np.median(steps)) < 0.5 * np.median(steps)
    whole = np.convolve(usable, np.ones(ORDER + 1))[:count] > ORDER + 0.5
    samples = np.flatnonzero(whole)
    columns = [command[samples - lag] for lag in range(1, ORDER + 1)]
    columns += [values[samples - lag] for values in (reference, signal)
                for lag in range(ORDER + 1)]
    return _Rows(samples, np.stack(columns, axis=1), command[samples], ORDER)


def _sizes(known: Array) -> Array:
    """Return the largest number of each column, 1 for one of zeros."""
    sizes = np.abs(known).max(axis=0)
    return np.where(sizes > 0.0, sizes, 1.0)


def _fit(known: Array, command: Array) -> Array:
    scale = _sizes(known)
    return np.asarray(np.linalg.lstsq(known / scale, command, rcond=SMALL)[0] / scale)


def _obeying(rows: _Rows, span: float) -> Mask | None:
    """Return the rows that obey the relation that most obey; None if too few obey any."""
    step = 1 + len(rows.samples) // MOST
    known, command = rows.known[::step], rows.command[::step]
    best: Mask = np.zeros(len(command), bool)
    length = max(len(command) // PARTS, 4 * ORDER)
    begins = (slice(None), *(slice(begin, begin + length)
                             for begin in range(0, len(command) - length + 1, length)))
    for begin in begins:
        obeys = np.zeros(len(command), bool)
        obeys[begin] = True
        for _ in range(REFITS):
            factors = _fit(known[obeys], command[obeys])
            now = np.abs(command - known @ factors) < EXACT * span
            if now.sum() <= 4 * ORDER or (now == obeys).all():
                break
            obeys = now
        if now.sum() > best.sum():
            best = now
        if best.mean() > 1.0 - OBEY / PARTS:
            break
    if best.mean() < OBEY:
        return None
    factors = _fit(known[best], command[best])
    return _with_steps(rows, np.abs(rows.command - rows.known @ factors) < EXACT * span, span)


def _with_steps(rows: _Rows, obeys: Mask, span: float) -> Mask:
    """Return the rows with those that obey once the fit knows them, as those of the only step."""
    others = np.flatnonzero(~obeys)
    groups = np.split(others, np.flatnonzero(np.diff(others) > 1) + 1)
    for group in groups if len(groups) <= MOST_BREAKS else ():
        both = obeys.copy()
        both[group] = True
        chosen = np.union1d(group, np.flatnonzero(obeys)[::1 + int(obeys.sum()) // MOST])
        factors = _fit(rows.known[chosen], rows.command[chosen])
        if np.abs(rows.command[both] - rows.known[both] @ factors).max() < EXACT * span:
            obeys = both
    return obeys


def _shortest(rows: _Rows, obeys: Mask, span: float) -> tuple[_Rows, Array]:
    """Return rows with as few earlier samples as the relation takes, and its factors."""
    chosen = np.flatnonzero(obeys)[::1 + int(obeys.sum()) // MOST]
    for order in range(ORDER + 1):
        shorter = rows.of_order(order)
        factors = _fit(shorter.known[chosen], rows.command[chosen])
        error = np.abs(rows.command[obeys] - shorter.known[obeys] @ factors)
        if error.max() < EXACT * span:
            break
    return shorter, factors


class _Space:
    """The linear combinations of the columns of a fit that its rows determine."""

    def __init__(self, known: Array) -> None:
        self.scale = _sizes(known)
        _, values, vectors = np.linalg.svd(known / self.scale, full_matrices=False)
        self.vectors = vectors[values > SMALL * values[0]]

    def holds(self, rows: Array) -> Mask:
        """Return for which rows the fit determines the command."""
        rows = rows / self.scale
        outside = rows - (rows @ self.vectors.T) @ self.vectors
        return np.asarray(np.linalg.norm(outside, axis=1)
                          <= DETERMINED * np.linalg.norm(rows, axis=1))


def _factor(rows: _Rows, obeys: Mask, span: float) -> float | None:
    """Return the one of FACTORS with which the command is a controller's answer to the error."""
    step = 1 + int(obeys.sum()) // FEW
    bend = np.abs(np.diff(rows.command[obeys], 2, prepend=[0.0, 0.0]))
    chosen = np.union1d(np.arange(0, len(bend), step), np.argsort(-bend)[:FEW])
    command = rows.command[obeys][chosen]
    earlier, references, signals = (each[obeys][chosen] for each in rows.groups())
    possible, as_recorded = [], np.inf
    for feedforward in FEEDFORWARD:
        beyond = command - feedforward * references[:, 0]
        before = earlier - feedforward * references[:, 1:]
        for factor in FACTORS:
            table = np.hstack([before, references - signals / factor])
            error = beyond - table @ _fit(table, beyond)
            if np.abs(error).max() < EXACT * span:
                possible.append(factor)
            if factor == 1.0:
                as_recorded = min(as_recorded, float(np.abs(error).max()))
    # Of a signal that is small beside the reference another factor may only fit a little better.
    sure = possible[:1] == [1.0] or as_recorded > BREAK * span
    return possible[0] if len(set(possible)) == 1 and sure else None


def _scale(rows: _Rows, obeys: Mask, span: float, factors: Array, known: Mask) -> float | None:
    """
    Return the factor of another scale of signal or reference, 1 if they have the same.

    The relation of a controller that answers factor * reference - signal, and passes on any share
    of the reference beside that, tells both if the controller has a memory.
    """
    before, _, own = np.split(factors, [rows.order, 2 * rows.order + 1])
    if not (known[:rows.order].all() and known[2 * rows.order + 1:].all()):
        return None
    earlier, references, signals = (each[obeys] for each in rows.groups())
    excited = np.hstack([earlier, signals])
    if np.linalg.cond(excited / _sizes(excited)) > EXCITED:
        return None
    beyond = rows.command[obeys] - earlier @ before - signals @ own
    table = np.stack([-references @ own, references @ np.append(1.0, -before)], axis=1)
    sizes = np.linalg.norm(table, axis=0)
    if not sizes.all() or np.linalg.cond(table / sizes) > CONDITION:
        return None
    found = np.linalg.lstsq(table / sizes, beyond, rcond=None)[0] / sizes
    if np.abs(beyond - table @ found).max() > EXACT * span or not found[0] > 0.0:
        return None
    if abs(found[0] - 1.0) < BREAK:
        return 1.0
    # Nearer to 1 it may be what is left of poles and of a controller that is not linear.
    return float(found[0]) if abs(found[0] - 1.0) > OTHER_SCALE else None


def _remembers(rows: _Rows, obeys: Mask, span: float) -> bool:
    """Return whether the command takes earlier samples: else any residuals may be altered ones."""
    chosen = np.flatnonzero(obeys)[::1 + int(obeys.sum()) // MOST]
    shorter = rows.of_order(0)
    factors = _fit(shorter.known[chosen], rows.command[chosen])
    error = np.abs(rows.command[obeys] - shorter.known[obeys] @ factors)
    return bool(error.max() > BREAK * span)


def _breaks(rows: _Rows, factors: Array, residual: Array, span: float, remembers: bool
            ) -> list[Break]:
    """
    Return the parts that break a relation because samples were altered, lost or repeated.

    remembers: whether the command depends on earlier samples.
    """
    broken = np.flatnonzero(np.abs(residual) > 10.0 * EXACT * span)
    if not len(broken):
        return []
    groups = np.split(broken, np.flatnonzero(np.diff(broken) > APART) + 1)
    groups = [group for group in groups if np.abs(residual[group]).max() > BREAK * span]
    if len(groups) > MOST_BREAKS:
        return []
    _, of_reference, of_signal = np.split(factors, [rows.order, 2 * rows.order + 1])
    found = []
    for group in groups:
        part = slice(group[0], group[-1] + 1)
        samples, rest = rows.samples[part], residual[part]
        # Else it is not known what comes between, or follows.
        inside = samples[-1] - samples[0] < len(samples) and part.stop <= len(
            rows.samples) - APART
        factor, offset = _altered(rows, part, rest, of_signal, span)
        lost = 0 < len(rest) == rows.order and np.abs(rest).min() > 10.0 * EXACT * span
        if factor is not None or inside and remembers and (lost or _explained(rest, of_signal)
                                             or _explained(rest, of_reference)):
            found.append(Break(int(samples[0]), int(samples[-1]), factor, offset, bool(lost)))
    return found


def _lost(breaks: list[Break]) -> list[Break]:
    return [each for each in breaks if each.lost]


def _altered(rows: _Rows, part: slice, residual: Array, own: Array, span: float
             ) -> tuple[float | None, float | None]:
    """Return by which factor and offset of the signal the residuals arise; None if by none."""
    answered = rows.groups()[2][part] @ own
    table = np.stack([answered, np.full(len(answered), own.sum())], axis=1)
    rest = slice(2 * ORDER, None)      # samples before the part are still as recorded
    if len(answered) < 6 * ORDER:
        return None, None
    found = np.linalg.lstsq(table[rest], residual[rest], rcond=SMALL)[0]
    if np.abs(residual[rest] - table[rest] @ found).max() > 10.0 * EXACT * span:
        return None, None
    factor, offset = 1.0 + float(found[0]), float(found[1])
    references = rows.groups()[1][part, 0]
    changing = np.ptp(references) > BREAK * np.ptp(rows.groups()[1][:, 0])
    other_sign = abs(factor + 1.0) < BREAK and abs(offset) < BREAK * np.ptp(answered)
    # While the reference rests, another gain of the controller does the same.
    return (factor, offset) if changing or other_sign else (None, None)


def _explained(residual: Array, own: Array) -> bool:
    """
    Return whether altered samples of one signal explain consecutive residuals.

    own: factors of that signal. There are as many more residuals than altered samples as there
    are earlier samples in the relation. What a nonlinear controller does has not that form.
    """
    altered = len(residual) - len(own) + 1
    # With a short memory almost any residuals have that form.
    if len(own) < LEAST_MEMORY or not 0 < altered <= LONGEST:
        return False
    table = linalg.toeplitz(np.append(own, np.zeros(altered - 1)),
                            np.append(own[0], np.zeros(altered - 1)))
    found = np.linalg.lstsq(table, residual, rcond=SMALL)[0]
    return bool(np.abs(residual - table @ found).max() < BREAK * np.abs(residual).max())
