"""Locate the gap: by block, along the signal chain, and by regime."""

import itertools
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.signal import butter, sosfiltfilt

from asi_actuator.model.effects import BLOCKS
from asi_analysis.arrays import Array, Mask
from asi_analysis.gap.inference.fit import held_out_error
from asi_analysis.gap.inference.hypotheses import Weighed
from asi_analysis.gap.inference.probability import Names
from asi_analysis.gap.model.blocks import impedance, load_constants
from asi_analysis.gap.model.effects import MOTIONS, UNKNOWN, block_of
from asi_analysis.gap.model.group import Group, Values
from asi_analysis.gap.model.predict import compared, measured, predict, unexplained
from asi_analysis.gap.motion import low_pass
from asi_analysis.gap.prepare import Recording, velocity_of
from asi_analysis.gap.words import digits

BANDS_HZ = ((0.0, 1.0), (1.0, 5.0), (5.0, 20.0), (20.0, 60.0), (60.0, 200.0))
# Blocks of each channel: they share its gap if no effect is named.
ALONG = {'valve': ('command_path', 'valve'), 'force': ('hydraulics', 'sensor'),
         'load': ('mechanics', 'sensor'), 'static': ('valve', 'command_path', 'sensor'),
         **dict.fromkeys(MOTIONS, ('mechanics', 'hydraulics'))}


LEAST_SHARE = 0.01       # of the samples in a regime, and of a gap
LEAST_PROBABILITY = 0.02   # of a hypothesis whose effects' contributions are computed
BINS = 16
REPORTED_SHARE = 0.2     # share of the residual's power above which a dependence is reported
NEARLY = 0.9   # a sine has two parameters where the means have BINS
IN_TIME = 'time in the run'
OF_FORCE = ('force', 'load')   # channels that compare the force
REPORTED_FACTOR = 1.6    # ratio of the largest to the smallest regime that is reported
# Of a ripple by the position (teeth, poles, ribs): cells of the position's range; periods in that
# range; spatial frequencies tried in the width of a line.
CELLS, FEWEST, MOST, PER_PERIOD = 4096, 2, 256, 4


class Regime(NamedTuple):
    """
    The gap (rms) in one regime, as a multiple of that of the refitted model in all regimes.

    relative: of the refitted model; after: of the verdict; share: of the samples.
    """

    kind: str
    regime: str
    relative: float
    after: float
    share: float


class Ripple(NamedTuple):
    """A sine of the position: its period (m, or rad) and the share of the power that it is."""

    period: float
    share: float


def by_block(groups: list[Weighed]) -> dict[str, float]:
    """
    Return the share of each block in the gap, most first.

    The gap of a channel is the residual of the refitted nominal model above the error floor,
    relative to the signal. It is divided among the blocks of the hypotheses in proportion to their
    probability, and within a hypothesis by the contribution of each effect.
    """
    # Hypotheses without an effect have no block, and do not count if any other has.
    share = _shares(groups, lambda names: bool(names))
    if sum(share.values()) == 0.0:   # no residual of the refitted model is above its error floor
        for weighed in groups:
            for names, probability in weighed.probability.items():
                for name in set(names) - {UNKNOWN}:
                    share[str(block_of(name))] += probability
    if sum(share.values()) == 0.0:
        share = _shares(groups, lambda names: True)
    total = sum(share.values())
    if total > 0.0:
        share = {block: value / total for block, value in share.items()}
    return dict(sorted(share.items(), key=lambda item: -item[1]))


def _shares(groups: list[Weighed], counts: Callable[[Names], bool]) -> dict[str, float]:
    """Return the gap of each block, relative to the signals; counts: which hypotheses do."""
    share = dict.fromkeys(BLOCKS, 0.0)
    for weighed in groups:
        group, null = weighed.group, _without_effects(weighed)
        for channel in group.channels:
            size = np.mean([np.mean(compared(r, channel, measured(r, channel)) ** 2)
                            for r in group.recordings])
            gap = max(null[channel] - group.judged_floor(channel), 0.0) / float(size)
            for names, probability in weighed.probability.items():
                for block, part in (_blocks_of(weighed, names, channel, probability).items()
                                    if counts(names) else ()):
                    share[block] += gap * probability * part
    return share


def _without_effects(weighed: Weighed) -> Values:
    """
    Return the mean square residual without effects, by channel.

    That of the refitted nominal model. If this hides an effect, as one of its parameters is far
    beyond its tolerance: that of the most probable fit, with its effects set to null.
    """
    group, null = weighed.group, weighed.candidates[()].fitted.held_out
    best = max(weighed.candidates, key=lambda names: weighed.probability[names])
    if not best or any(null[channel] > group.judged_floor(channel) for channel in group.channels):
        return null
    return held_out_error(group, _nulled(weighed, best, best))


def _blocks_of(weighed: Weighed, names: Names, channel: str, probability: float
               ) -> dict[str, float]:
    """Return the share of each block in a channel's gap under a hypothesis; their sum is 1."""
    names = tuple(name for name in names if name != UNKNOWN)
    if len(names) > 1 and names in weighed.candidates and probability > LEAST_PROBABILITY:
        parts = explained(weighed, names, channel)
    else:
        parts = dict.fromkeys(names, 1.0)
    blocks: dict[str, float] = {}
    for name, part in parts.items():
        block = str(block_of(name))
        blocks[block] = blocks.get(block, 0.0) + part
    if not blocks:   # no gap, or unknown: by the best single effect of each block
        null = max(weighed.candidates[()].fitted.held_out[channel], 1e-300)
        for block in ALONG[channel]:
            blocks[block] = LEAST_SHARE * null + max(
                (null - candidate.fitted.held_out[channel]
                 for tried, candidate in weighed.candidates.items()
                 if len(tried) == 1 and block_of(tried[0]) == block), default=0.0)
            blocks[block] = max(blocks[block], LEAST_SHARE * null)
    total = sum(blocks.values())
    return {block: part / total for block, part in blocks.items()}


def _nulled(weighed: Weighed, names: Names, absent: Collection[str]) -> np.void:
    """Return the record of a hypothesis with some of its effects set to null."""
    group, whole = weighed.group, weighed.candidates[names]
    kept, reset = set[str](), set[str]()
    for name in names:
        for form in group.effects[name]:
            if form in whole.variants:
                (reset if name in absent else kept).update(form.fields | dict(form.fixed).keys())
    p = whole.fitted.record.copy()
    for field in reset - kept:
        p[field] = group.nominal[field]
    return p


def explained(weighed: Weighed, names: Names, channel: str) -> dict[str, float]:
    """
    Return the contribution of each effect of a hypothesis to a channel (mean square).

    Shapley values, at least LEAST_SHARE of the largest.
    """
    group = weighed.group

    def explains(present: Collection[str]) -> float:
        absent = [name for name in names if name not in present]
        return -held_out_error(group, _nulled(weighed, names, absent))[channel]

    parts = _shapley_values(names, explains)
    trace = LEAST_SHARE * max(max(parts.values()), 1e-300)
    return {name: max(part, trace) for name, part in parts.items()}


def _shapley_values(names: Collection[str], value: Callable[[Collection[str]], float]
                    ) -> dict[str, float]:
    """Return what each name adds to a value, in the mean over all orders of adding them."""
    known = {frozenset(chosen): value(chosen) for count in range(len(names) + 1)
             for chosen in itertools.combinations(names, count)}
    parts = dict.fromkeys(names, 0.0)
    orders = list(itertools.permutations(names))
    for order in orders:
        for place, name in enumerate(order):
            before = frozenset(order[:place])
            parts[name] += (known[before | {name}] - known[before]) / len(orders)
    return parts


def _load_velocity(recording: Recording, p: np.void) -> Array:
    """Return the velocity (m/s) of the nominal load under the measured force."""
    force = recording.force
    assert force is not None
    frequency = np.fft.rfftfreq(force.size, recording.period_s)
    omega = 2.0 * np.pi * frequency
    stiffness = load_constants(p)[2]
    whole = impedance(omega, p) * 1j * omega + stiffness
    whole[0] = whole[0] or 1.0
    velocity = 1j * omega / whole * np.fft.rfft(force) * low_pass(
        frequency, 0.2 / recording.period_s)
    return np.fft.irfft(velocity, force.size)


def along_the_chain(recording: Recording, p_valve: np.void, p_force: np.void) -> dict[str, float]:
    """
    Return the share of each part of the chain in the gap of the force.

    Shapley values over replacing measured valve position and velocity by simulated ones; what
    remains with both measured belongs to hydraulics and sensor.
    """
    simulated = {'valve_position': predict(recording, 'valve', p_valve),
                 'velocity': _load_velocity(recording, p_force)}
    valid = recording.valid

    def error(swapped: Collection[str]) -> float:
        changed: dict[str, Any] = {name: simulated[name] for name in swapped}
        mixed = replace(recording, **changed)
        residual = measured(recording, 'force') - predict(mixed, 'force', p_force)
        return float(np.mean(residual[valid] ** 2))

    more = _shapley_values(tuple(simulated), error)
    parts = {'command_path and valve': more['valve_position'], 'mechanics': more['velocity'],
             'hydraulics and sensor': error(())}
    total = sum(max(part, 0.0) for part in parts.values()) or 1.0
    return {name: max(part, 0.0) / total for name, part in parts.items()}


def regimes_of(recording: Recording, channel: str) -> dict[tuple[str, str], Mask]:
    """Return the samples in each regime of amplitude, motion, valve and time."""
    real = measured(recording, channel)
    size = np.abs(real - np.median(real))
    low, high = np.quantile(size, [1 / 3, 2 / 3])
    found = {('amplitude', 'small'): size <= low, ('amplitude', 'medium'):
             (size > low) & (size <= high), ('amplitude', 'large'): size > high}
    velocity = velocity_of(recording)
    if velocity is not None:
        fast = np.quantile(np.abs(velocity), 0.5)
        turns = np.flatnonzero(np.diff(np.signbit(velocity)))
        last = np.searchsorted(turns, np.arange(real.size)) - 1
        since = np.where(last >= 0, np.arange(real.size) - turns[last], np.inf) \
            * recording.period_s if turns.size else np.full(real.size, np.inf)
        found |= {
            ('velocity', 'forward, fast'): velocity > fast,
            ('velocity', 'forward, slow'): (velocity > 0.0) & (velocity <= fast),
            ('velocity', 'backward, slow'): (velocity <= 0.0) & (velocity >= -fast),
            ('velocity', 'backward, fast'): velocity < -fast,
            ('time since reversal', 'below 5 ms'): since < 0.005,
            ('time since reversal', '5 to 50 ms'): (since >= 0.005) & (since < 0.05),
            ('time since reversal', 'above 50 ms'): since >= 0.05}
    if channel == 'static' and recording.command is not None:
        rising = np.gradient(recording.command) > 0.0
        found |= {('input', 'rising'): rising, ('input', 'falling'): ~rising}
    if recording.valve_position is not None and channel not in ('valve', 'static'):
        opening = np.abs(recording.valve_position)
        middle = np.quantile(opening, 0.5)
        found |= {('valve opening', 'small'): opening <= middle,
                  ('valve opening', 'large'): opening > middle}
    third = np.arange(real.size) * 3 // real.size
    return found | {(IN_TIME, name): third == number for number, name in enumerate(
        ('first third', 'second third', 'last third'))}


def by_regime(group: Group, channel: str, before: np.void, after: np.void) -> list[Regime]:
    """
    Return the gap of a channel by frequency, amplitude, motion and time.

    before, after: records of the refitted nominal model and of the verdict.
    """
    square: dict[tuple[str, str], Array] = {}   # sums over all recordings: before, after, samples
    total = np.zeros(3)
    for recording in group.recordings:
        valid = recording.valid
        residual = np.array([unexplained(recording, channel, p) for p in (before, after)])
        total += [*np.sum(residual[:, valid] ** 2, axis=1), valid.sum()]
        inner = slice(*np.flatnonzero(valid)[[0, -1]])   # without the start, which is not used
        for low, high in BANDS_HZ:
            if high < 0.45 / recording.period_s:
                edge = (high if low == 0.0 else np.array([low, high])) * 2.0 * recording.period_s
                kind = 'lowpass' if low == 0.0 else 'bandpass'
                band = sosfiltfilt(butter(2, edge, kind, output='sos'), residual[:, inner])
                _add(square, ('frequency', f'{low:g} to {high:g} Hz'), band, valid[inner])
        for regime, mask in regimes_of(recording, channel).items():
            _add(square, regime, residual, valid & mask)
    whole = np.sqrt(total[:2] / total[2])
    return [Regime(kind, name, float(np.sqrt(part[0] / part[2]) / (whole[0] or 1.0)),
                   float(np.sqrt(part[1] / part[2]) / (whole[0] or 1.0)),
                   float(part[2] / total[2]))
            for (kind, name), part in square.items() if part[2] > LEAST_SHARE * total[2]]


def _add(square: dict[tuple[str, str], Array], regime: tuple[str, str], residual: Array,
         valid: Mask) -> None:
    """Add the squares of residuals, and the number of samples, to those of a regime."""
    sums = np.array([*np.sum(residual[:, valid] ** 2, axis=1), valid.sum()])
    square[regime] = square.get(regime, np.zeros(3)) + sums


def dependence(group: Group, channel: str, p: np.void) -> dict[str, float]:
    """
    Return the share (0 to 1) of a residual's power that is a function of one quantity.

    By quantity: the share that its means in BINS bins explain. Of a residual of the force, by the
    predicted force: what nothing explains is always a function of the measured one.
    """
    residual, kinds = [], []
    for recording in group.recordings:
        valid, left = recording.valid, unexplained(recording, channel, p)
        residual.append(left[valid])
        motion = recording.motion
        kinds.append({name: values[valid] for name, values in (
            ('position', motion.position[motion.inner] if motion and motion.measured else None),
            ('velocity', velocity_of(recording)),
            ('input' if channel == 'static' else 'command', recording.command),
            ('valve position', recording.valve_position),
            ('force' if channel not in OF_FORCE else 'predicted force',
             recording.force if channel not in OF_FORCE else measured(recording, channel) - left),
            (IN_TIME, recording.time_s),
            ) if values is not None and not (
                name == 'valve position' and channel in ('valve', 'static'))})
    rest = np.concatenate(residual)
    found = {}
    for name in set.intersection(*(set(kind) for kind in kinds)):
        values = np.concatenate([kind[name] for kind in kinds])
        edges = np.unique(np.quantile(values, np.linspace(0.0, 1.0, BINS + 1)))
        place = np.clip(np.searchsorted(edges, values, 'right') - 1, 0, max(edges.size - 2, 0))
        count = np.maximum(np.bincount(place), 1)
        mean = np.bincount(place, rest) / count
        found[name] = float(np.sum(count * mean ** 2) / max(float(rest @ rest), 1e-300))
    return dict(sorted(found.items(), key=lambda item: -item[1]))


def ripple(group: Group, channel: str, p: np.void) -> Ripple | None:
    """
    Return the sine of the position that explains most of a channel's residual.

    Of any phase in each recording, as the origins of their positions may differ. None if the
    position was not measured. p: record of the model.
    """
    waves, spans = np.arange(FEWEST, MOST, 1.0 / PER_PERIOD), []
    power, whole = np.zeros(waves.size), 0.0
    courses = []
    for recording in group.recordings:
        motion = recording.motion
        if motion is None or not motion.measured:
            return None
        position = motion.position[motion.inner][recording.valid]
        courses.append((position, unexplained(recording, channel, p)[recording.valid]))
        spans.append(float(np.ptp(position)))
    span = max(spans)
    if span == 0.0:
        return None
    for position, rest in courses:
        power += _explained_by_waves((position - position.min()) / span, rest - rest.mean(),
                                     waves)
        whole += float(rest @ rest)
    most = int(np.argmax(power))
    return Ripple(span / float(waves[most]), float(power[most]) / max(whole, 1e-300))


def _explained_by_waves(place: Array, rest: Array, waves: Array) -> Array:
    """Return the power that a sine of each number of waves explains; place: from 0 to 1."""
    cell = np.minimum((place * CELLS).astype(int), CELLS - 1)
    count, total = np.bincount(cell, minlength=CELLS), np.bincount(cell, rest, CELLS)
    filled = count > 0
    centre, count, total = (np.arange(CELLS) + 0.5)[filled] / CELLS, count[filled], total[filled]
    power = np.empty(waves.size)
    for number, wave in enumerate(waves):
        shapes = np.array([np.ones(centre.size), np.cos(2.0 * np.pi * wave * centre),
                           np.sin(2.0 * np.pi * wave * centre)])
        push = shapes @ total
        power[number] = push @ np.linalg.lstsq((shapes * count) @ shapes.T, push)[0]
    return power


def in_words(regimes: list[Regime], depends: Mapping[str, float], rippled: Ripple | None = None,
             unit: str = 'm') -> str:
    """
    Return a sentence that says what the residual depends on.

    rippled: by the position; told where it explains nearly what the means of `dependence` do.
    """
    shares = dict(depends)
    if rippled and rippled.share > NEARLY * shares.get('position', 0.0):
        shares.pop('position', None)
        period = digits(rippled.period, unit)
        shares[f'position, a ripple with a period of {period}'] = rippled.share
    parts = [f'{100 * share:.0f} % of it is a function of the {name}'
             for name, share in sorted(shares.items(), key=lambda item: -item[1])[:2]
             if share > REPORTED_SHARE]
    for kind in dict.fromkeys(regime.kind for regime in regimes):
        own = [regime for regime in regimes if regime.kind == kind]
        most = max(own, key=lambda regime: regime.after)
        least = min(own, key=lambda regime: regime.after)
        if most.after > REPORTED_FACTOR * least.after:
            parts.append({'frequency': f'it is strongest at {most.regime}',
                          IN_TIME: f'it is largest in the {most.regime} of the run'}.get(
                              kind, f'it is largest where the {kind} is {most.regime}'))
    return ('Of the residual: ' + '; '.join(parts) + '.' if parts else
            'The residual does not depend on any recorded quantity in particular.')
