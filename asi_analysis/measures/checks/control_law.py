"""
Whether the recorded command is that of one linear controller, identified from the recording.

A linear digital controller computes each command from the samples of reference and controlled
signal that it has received, and from its own earlier commands: a linear difference equation, its
control law. Where a recording holds these samples, the equation is exact to rounding errors,
whatever the plant does and however large the noise is; a sample that was altered later violates
it. Of a file with numbers of few digits it is exact to these. A recording without such an equation
(a nonlinear controller, a part of its samples, signals that are not synchronised) allows no
conclusion.
"""

from typing import Final, NamedTuple

import numpy as np
from scipy import linalg

from asi_analysis.arrays import Array, Mask
from asi_analysis.measures.checks.rows import (
    MOST_FITTED,
    ORDER,
    RANK_TOLERANCE,
    Rows,
    fit,
    rows_of,
    sizes_of,
)

LEAST_ROWS: Final = 20 * ORDER      # commands to which the equation is fitted
PARTS: Final = 8                    # of the recording; the fit is begun with each
REFITS: Final = 5
# Least share of the rows that must satisfy an equation: of fewer it is a coincidence, or another
# controller's.
LEAST_SATISFIED: Final = 0.5
# Least residual, as a share of the range of the command, that violates the equation.
BREAK: Final = 1e-3
# Least effect of the signal on the command, as a share of its range, for a feedback.
LEAST_FEEDBACK: Final = 1e-3
LEAST_DISTANCE: Final = ORDER       # of two breaks, in rows
MOST_BREAKS: Final = 20             # with more, the controller is not linear
MOST_ALTERED: Final = 400           # samples in one break
LEAST_MEMORY: Final = 3     # samples of a signal in an equation that can show altered ones
NEARLY_ALL: Final = 0.9     # share of the samples that are compared
LARGEST_POLE: Final = 1.01  # of a stable equation, an integrator's pole with its error
MOST_LOST: Final = 2        # places with lost rows; with more, the controller is not linear
CLEAR: Final = 3.0      # of rounding errors; their standard deviation is a tenth of this
# Factors of a wrong sign or unit of force: N in mN, kN, lbf, kgf; feed-forwards of the reference
# that controllers have; rows with which each is tried.
FACTORS: Final = (1.0, -1.0, 1e3, 1e-3, 4.4482216, 1.0 / 4.4482216, 9.80665, 1.0 / 9.80665)
FEEDFORWARD: Final = (1.0, 0.0)
TRIAL_ROWS: Final = 500
# Least difference of a factor from 1 that shows another scale (a disturbance observer has a
# smaller one), and largest condition number of its fit.
OTHER_SCALE: Final = 0.3
CONDITION: Final = 1e4
# Largest condition number of the samples: a few sines without noise satisfy any equation.
SAMPLES_CONDITION: Final = 1e5
# Longest delay of a signal in the recording, in samples; number of delays that are tried.
LONGEST_DELAY: Final = 400
DELAYS_TRIED: Final = 4


class Break(NamedTuple):
    """First and last sample of a part of the recording that violates the control law."""

    first: int
    last: int
    # If the controller had factor * recorded + offset there; None if nothing of that form.
    factor: float | None
    offset: float | None
    lost: bool      # rows may be lost or repeated here: as many commands as the order violate it
    backwards: bool     # its rows satisfy the law in the reverse order


class ControlLaw(NamedTuple):
    """
    The control law of a recording.

    reference, signal: gain from the same sample to the command, NaN if it is not identifiable, or
    if the signal hardly has an effect; factor: recorded signal over the one that the controller
    compared with the reference, None if it is not identifiable; breaks: the parts that violate
    the law; has_memory: the law has earlier samples, and shows that rows follow each other.
    """

    reference: float
    signal: float
    factor: float | None
    breaks: tuple[Break, ...]
    everywhere: bool    # no compared sample violates it
    exact: bool         # all compared samples satisfy it to rounding errors
    of_all: bool        # nearly all samples of the recording were compared
    has_memory: bool
    # Whether the equation is stable, None if that is unknown. Of samples in the reverse order it
    # is not.
    is_stable: bool | None

    def of_servo(self) -> 'ControlLaw':
        """Return what it says if the derivative of the signal may have been another input."""
        sure = self.factor in FACTORS
        return self._replace(
            reference=self.reference if sure else np.nan, signal=self.signal if sure else np.nan,
            factor=self.factor if sure else None,
            breaks=tuple(each for each in self.breaks
                         if each.factor is not None or each.backwards))


def control_law(time: Array, command: Array, reference: Array, signal: Array
                ) -> ControlLaw | None:
    """Return the control law of n samples at one rate; None if no equation is exact."""
    rows = rows_of(time, command, reference, signal)
    if len(rows.samples) < LEAST_ROWS:
        return None
    span = float(np.ptp(rows.command))
    if not span > 0.0:
        return None
    valid = _satisfied(rows)
    if valid is None:
        return None
    rows, factors = _lowest_order(rows, valid)
    space = _Space(rows, valid, factors)
    compared = space.error(rows.known) < 10.0 * rows.exact()
    residual = np.where(compared, rows.command - rows.known @ factors, 0.0)
    effects = np.abs(factors) * space.scale
    known = space.error(np.diag(space.scale)) < BREAK * effects.max()
    direct = [float(factors[k]) if known[k] else np.nan for k in (rows.order, 2 * rows.order + 1)]
    if not abs(direct[1]) * float(np.nanstd(signal)) > LEAST_FEEDBACK * span:
        direct = [np.nan, np.nan]
    factor = 1.0 if _same_static_gain(rows, factors, space) else _factor(rows, valid, span)
    if factor is None:
        factor = _scale(rows, valid, span, factors, known)
    has_memory = _has_memory(rows, valid, span)
    breaks = _breaks(rows, factors, residual, span, has_memory)
    if factor is None or len(_lost(breaks)) > MOST_LOST:    # a few sines satisfy any equation
        breaks = [each for each in breaks if each not in _lost(breaks)]
    return ControlLaw(direct[0], direct[1], factor, tuple(breaks),
                      bool(np.abs(residual).max() < BREAK * span),
                      bool(np.abs(residual).max() < 10.0 * rows.exact()),
                      int(compared.sum()) > NEARLY_ALL * len(time), has_memory,
                      _is_stable(rows, valid, factors) if known[:rows.order].all() else None)


def delayed_signal(time: Array, command: Array, reference: Array, signal: Array
                   ) -> tuple[str, int]:
    """
    Return which of 'signal', 'reference' and 'command' was recorded late, by how many samples.

    '', 0 unless the control law is exact for samples that the recording has later.
    """
    recorded = {'signal': signal, 'reference': reference, 'command': command}
    change, *others = (np.diff(np.nan_to_num(each), 2, prepend=[0.0, 0.0])
                       for each in (command, signal, reference))
    most = min(LONGEST_DELAY, len(change) // 4)
    if most < 1:
        return '', 0
    # The part with the largest change rules out most delays, in less time than the whole.
    length = LEAST_ROWS + 4 * ORDER
    begin = max(min(int(np.argmax(np.abs(change[2:]))) - ORDER, len(change) - length - most), 0)
    for name, (cause, late) in zip(recorded, (
            (change, others[0]), (change, others[1]), (others[0], change)), strict=True):
        part = slice(max(begin - (most if name == 'command' else 0), 0),
                     begin + length)
        for lag in dict.fromkeys((*_likely_delays(cause, late, most),
                                  *range(1, min(ORDER, most) + 1))):
            moved = recorded | {name: np.append(recorded[name][lag:], np.full(lag, np.nan))}
            columns = [moved[each] for each in ('command', 'reference', 'signal')]
            first = control_law(time[part], *(each[part] for each in columns))
            if first is None or not first.everywhere:
                continue
            found = control_law(time, *columns)
            # Of a controller that has the derivative of a signal, which later samples show
            # better, it is not exact.
            # A reference without an effect fits at any delay.
            if found and found.exact and (name != 'reference' or found.factor == 1.0) and (
                    abs(found.reference) * _range(reference) > LEAST_FEEDBACK * _range(command)
                    if name == 'reference' else abs(found.signal) > 0.0):
                return name, int(lag)
    return '', 0


def _range(values: Array) -> float:
    return float(np.nanmax(values) - np.nanmin(values))


def _likely_delays(change: Array, other: Array, most: int) -> list[int]:
    """Return the delays of `other`, in samples below `most`, with the largest correlation."""
    size = 2 ** int(np.ceil(np.log2(2 * len(change))))
    spectrum, of_signs = (np.fft.rfft(b, size) * np.conj(np.fft.rfft(a, size)) for a, b in (
        (change, other), (np.sign(change), np.sign(other))))
    # Of all samples alike, and of all frequencies: noise tells the delay beside steps and sines.
    spectra = (spectrum, of_signs, spectrum / np.maximum(np.abs(spectrum), 1e-300))
    return [int(lag) + 1 for each in spectra
            for lag in np.argsort(-np.abs(np.fft.irfft(each)[1:most]))[:DELAYS_TRIED]]


def _satisfied(rows: Rows) -> Mask | None:
    """Return which rows satisfy the equation that most rows satisfy; None if these are too few."""
    step = 1 + len(rows.samples) // MOST_FITTED
    known, command = rows.known[::step], rows.command[::step]
    best: Mask = np.zeros(len(command), bool)
    length = max(len(command) // PARTS, 4 * ORDER)
    begins = (slice(None), *(slice(begin, begin + length)
                             for begin in range(0, len(command) - length + 1, length)))
    for begin in begins:
        valid = np.zeros(len(command), bool)
        valid[begin] = True
        for _ in range(REFITS):
            factors = fit(known[valid], command[valid])
            now = np.abs(command - known @ factors) < rows.exact()
            if now.sum() <= 4 * ORDER or (now == valid).all():
                break
            valid = now
        if now.sum() > best.sum():
            best = now
        if best.mean() > 1.0 - LEAST_SATISFIED / PARTS:
            break
    if best.mean() < LEAST_SATISFIED:
        return None
    factors = fit(known[best], command[best])
    residual = np.abs(rows.command - rows.known @ factors)
    return _with_rare_events(rows, residual < rows.exact())


def _with_rare_events(rows: Rows, valid: Mask) -> Mask:
    """Return the rows with those that only a refit with them satisfies, as of the only step."""
    others = np.flatnonzero(~valid)
    groups = np.split(others, np.flatnonzero(np.diff(others) > 1) + 1)
    for group in groups if len(groups) <= MOST_BREAKS else ():
        both = valid.copy()
        both[group] = True
        chosen = np.union1d(group, np.flatnonzero(valid)[::1 + int(valid.sum()) // MOST_FITTED])
        factors = fit(rows.known[chosen], rows.command[chosen])
        if np.abs(rows.command[both] - rows.known[both] @ factors).max() < rows.exact():
            valid = both
    return valid


def _lowest_order(rows: Rows, valid: Mask) -> tuple[Rows, Array]:
    """Return the rows for the lowest order with an exact equation, and its coefficients."""
    chosen = np.flatnonzero(valid)[::1 + int(valid.sum()) // MOST_FITTED]
    for order in range(ORDER + 1):
        shorter = rows.of_order(order)
        factors = fit(shorter.known[chosen], rows.command[chosen])
        error = np.abs(rows.command[valid] - shorter.known[valid] @ factors)
        if error.max() < rows.exact():
            break
    return shorter, factors


class _Space:
    """The space spanned by the rows of a fit: outside it the fit determines no command."""

    def __init__(self, rows: Rows, valid: Mask, factors: Array) -> None:
        self.scale = sizes_of(rows.known[valid])
        _, values, vectors = np.linalg.svd(rows.known[valid] / self.scale, full_matrices=False)
        self.vectors = vectors[values > max(RANK_TOLERANCE, CLEAR * rows.rounding) * values[0]]
        self.largest = float(np.linalg.norm(factors * self.scale))

    def error(self, rows: Array) -> Array:
        """Return the largest error of the command of each row: by its part outside the space."""
        rows = rows / self.scale
        outside = rows - (rows @ self.vectors.T) @ self.vectors
        return np.asarray(self.largest * np.linalg.norm(outside, axis=1))


def _factor(rows: Rows, valid: Mask, span: float) -> float | None:
    """Return the one of FACTORS by which the signal is scaled; None if none or several fit."""
    step = 1 + int(valid.sum()) // TRIAL_ROWS
    bend = np.abs(np.diff(rows.command[valid], 2, prepend=[0.0, 0.0]))
    chosen = np.union1d(np.arange(0, len(bend), step), np.argsort(-bend)[:TRIAL_ROWS])
    command = rows.command[valid][chosen]
    earlier, references, signals = (each[valid][chosen] for each in rows.groups())
    possible, as_recorded = [], np.inf
    for feedforward in FEEDFORWARD:
        beyond = command - feedforward * references[:, 0]
        before = earlier - feedforward * references[:, 1:]
        for factor in FACTORS:
            table = np.hstack([before, references - signals / factor])
            error = beyond - table @ fit(table, beyond)
            if np.abs(error).max() < rows.exact():
                possible.append(factor)
            if factor == 1.0:
                as_recorded = min(as_recorded, float(np.abs(error).max()))
    # If the signal is small beside the reference, another factor may fit only a little better.
    sure = possible[:1] == [1.0] or as_recorded > BREAK * span
    return possible[0] if len(set(possible)) == 1 and sure else None


def _same_static_gain(rows: Rows, factors: Array, space: _Space) -> bool:
    """
    Return whether the command does not change if reference and signal change by the same amount.

    Both have the same unit then, also where only the signal is differentiated.
    """
    _, references, own = np.split(factors, [rows.order, 2 * rows.order + 1])
    both = np.append(np.zeros(rows.order), np.ones(2 * rows.order + 2))
    alone = both * np.append(np.zeros(2 * rows.order + 1), np.ones(rows.order + 1))
    sure = space.error(np.stack([both, alone])).max() < BREAK * abs(own.sum())
    return bool(sure and own.sum() < 0.0 and abs(
        references.sum() + own.sum()) < BREAK * abs(own.sum()))


def _scale(rows: Rows, valid: Mask, span: float, factors: Array, known: Mask) -> float | None:
    """
    Return the ratio of the scales of signal and reference, whatever it is; None if unknown.

    The control law u = C (factor * reference - signal) + feedforward * reference determines both
    numbers if the controller has a memory.
    """
    before, _, own = np.split(factors, [rows.order, 2 * rows.order + 1])
    if not (known[:rows.order].all() and known[2 * rows.order + 1:].all()):
        return None
    earlier, references, signals = (each[valid] for each in rows.groups())
    excited = np.hstack([earlier, signals])
    if np.linalg.cond(excited / sizes_of(excited)) > min(
            SAMPLES_CONDITION, 1.0 / max(rows.rounding, RANK_TOLERANCE)):
        return None
    beyond = rows.command[valid] - earlier @ before - signals @ own
    table = np.stack([-references @ own, references @ np.append(1.0, -before)], axis=1)
    sizes = np.linalg.norm(table, axis=0)
    if not sizes.all() or np.linalg.cond(table / sizes) > CONDITION:
        return None
    found = np.linalg.lstsq(table / sizes, beyond, rcond=None)[0] / sizes
    if np.abs(beyond - table @ found).max() > rows.exact() or not found[0] > 0.0:
        return None
    if abs(found[0] - 1.0) < BREAK:
        return 1.0
    # Nearer to 1 it may come from neglected poles or a small nonlinearity of the controller.
    return float(found[0]) if abs(found[0] - 1.0) > OTHER_SCALE else None


def _has_memory(rows: Rows, valid: Mask, span: float) -> bool:
    """Return whether the command depends on earlier samples; else any residual may be altered."""
    chosen = np.flatnonzero(valid)[::1 + int(valid.sum()) // MOST_FITTED]
    shorter = rows.of_order(0)
    factors = fit(shorter.known[chosen], rows.command[chosen])
    error = np.abs(rows.command[valid] - shorter.known[valid] @ factors)
    return bool(error.max() > BREAK * span)


def _is_stable(rows: Rows, valid: Mask, factors: Array) -> bool | None:
    """Return whether the equation is stable, None if it has no memory or its samples few sines."""
    excited = rows.known[valid]
    if not rows.order or np.linalg.cond(excited / sizes_of(excited)) > SAMPLES_CONDITION:
        return None
    poles = np.roots([1.0, *-factors[:rows.order]])
    return bool(np.abs(poles).max(initial=0.0) < LARGEST_POLE)


def _breaks(rows: Rows, factors: Array, residual: Array, span: float, has_memory: bool
            ) -> list[Break]:
    """
    Return the parts that violate the law because samples were altered, lost or repeated.

    has_memory: whether the command depends on earlier samples.
    """
    broken = np.flatnonzero(np.abs(residual) > 10.0 * rows.exact())
    if not len(broken):
        return []
    groups = np.split(broken, np.flatnonzero(np.diff(broken) > LEAST_DISTANCE) + 1)
    groups = [group for group in groups if np.abs(residual[group]).max() > BREAK * span]
    if len(groups) > MOST_BREAKS:
        return []
    _, of_reference, of_signal = np.split(factors, [rows.order, 2 * rows.order + 1])
    reverse = rows.backwards()
    as_reverse = np.abs(reverse.command - reverse.known @ factors) < 10.0 * rows.exact()
    found = []
    for group in groups:
        part = slice(group[0], group[-1] + 1)
        samples, rest = rows.samples[part], residual[part]
        # Otherwise rows are missing within or just after the part.
        inside = samples[-1] - samples[0] < len(samples) and part.stop <= len(
            rows.samples) - LEAST_DISTANCE
        factor, offset = _altered(rows, part, rest, of_signal)
        lost = 0 < len(rest) == rows.order and np.abs(rest).min() > 10.0 * rows.exact()
        within = slice(group[0] + rows.order, group[-1] - rows.order + 1)
        backwards = group[-1] - group[0] > 4 * ORDER and bool(as_reverse[within].all())
        altered = lost or _explained(rest, of_signal) or _explained(rest, of_reference)
        if factor is not None or backwards or inside and has_memory and altered:
            found.append(Break(int(samples[0]), int(samples[-1]), factor, offset, bool(lost),
                               backwards))
    return found


def _lost(breaks: list[Break]) -> list[Break]:
    return [each for each in breaks if each.lost]


def _altered(rows: Rows, part: slice, residual: Array, own: Array
             ) -> tuple[float | None, float | None]:
    """Return the factor and offset of the signal that explain the residuals; None without one."""
    answered = rows.groups()[2][part] @ own
    table = np.stack([answered, np.full(len(answered), own.sum())], axis=1)
    rest = slice(2 * ORDER, None)      # samples before the part are still as recorded
    if len(answered) < 6 * ORDER:
        return None, None
    found = np.linalg.lstsq(table[rest], residual[rest], rcond=RANK_TOLERANCE)[0]
    if np.abs(residual[rest] - table[rest] @ found).max() > 10.0 * rows.exact():
        return None, None
    factor, offset = 1.0 + float(found[0]), float(found[1])
    references = rows.groups()[1][part, 0]
    changing = np.ptp(references) > BREAK * np.ptp(rows.groups()[1][:, 0])
    other_sign = abs(factor + 1.0) < BREAK      # no gain of a stable loop
    # While the reference is constant, another gain of the controller has the same effect.
    return (factor, offset) if changing or other_sign else (None, None)


def _explained(residual: Array, own: Array) -> bool:
    """
    Return whether altered samples of one signal explain consecutive residuals.

    own: coefficients of that signal. The residuals are then the altered samples, convolved with
    these; those of a nonlinear controller do not have that form.
    """
    altered = len(residual) - len(own) + 1
    # With a short memory almost any residuals have that form.
    if len(own) < LEAST_MEMORY or not 0 < altered <= MOST_ALTERED:
        return False
    table = linalg.toeplitz(np.append(own, np.zeros(altered - 1)),
                            np.append(own[0], np.zeros(altered - 1)))
    found = np.linalg.lstsq(table, residual, rcond=RANK_TOLERANCE)[0]
    return bool(np.abs(residual - table @ found).max() < BREAK * np.abs(residual).max())
