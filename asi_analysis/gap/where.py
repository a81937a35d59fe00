"""Where the gap lies: by block, along the chain, and by regime."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.signal import butter, sosfiltfilt

from asi_analysis.gap.blocks import impedance, load_constants
from asi_analysis.gap.effects import BLOCK_OF, BLOCKS
from asi_analysis.gap.fit import Group, measured, predict
from asi_analysis.gap.prepare import Array, Mask, Recording, low_pass
from asi_analysis.gap.verdict import Weighed

BANDS_HZ = ((0.0, 1.0), (1.0, 5.0), (5.0, 20.0), (20.0, 60.0), (60.0, 200.0))
# Without a verdict about a channel its gap is laid at the blocks that it goes through.
ALONG = {'valve': ('command_path', 'valve'), 'force': ('hydraulics', 'sensor'),
         'load': ('mechanics', 'sensor')}


class Regime(NamedTuple):
    """The gap in one regime: rms there over the rms everywhere, and the share of the samples."""

    kind: str
    regime: str
    relative: float
    share: float


def by_block(groups: list[Weighed]) -> dict[str, float]:
    """
    Return the share of each block in the gap, most first.

    The gap of a channel (what the refitted nominal model leaves beyond the noise, over the size
    of the signal) belongs to the blocks of the effects that may explain it, by their probability.
    """
    share = dict.fromkeys(BLOCKS, 0.0)
    for weighed in groups:
        group = weighed.group
        null = weighed.candidates[()].fitted.held_out
        for channel in group.channels:
            size = np.mean([np.mean(measured(r, channel) ** 2) for r in group.recordings])
            gap = max(null[channel] - group.floor[channel], 0.0) / float(size)
            blocks: dict[str, float] = {}
            for names, probability in weighed.probability.items():
                known = [BLOCK_OF[name] for name in names if name in BLOCK_OF]
                for block in known or ALONG[channel]:
                    blocks[block] = (blocks.get(block, 0.0)
                                     + probability / len(known or ALONG[channel]))
            for block, probability in blocks.items():
                share[block] += gap * probability
    total = sum(share.values())
    if total > 0.0:
        share = {block: value / total for block, value in share.items()}
    return dict(sorted(share.items(), key=lambda item: -item[1]))


def _load_velocity(recording: Recording, p: np.void) -> Array:
    """Return the velocity (m/s) that the nominal load takes under the measured force."""
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


def along_the_chain(valve: Group, force: Group, p_valve: np.void, p_force: np.void
                    ) -> dict[str, float]:
    """
    Return the share of each part of the chain in the gap of the force.

    Shapley values over swapping the measured for the simulated valve position and velocity; what
    is left with both measured belongs to hydraulics and sensor.
    """
    recording = valve.recordings[0]
    simulated = {'valve_position': predict(recording, 'valve', p_valve),
                 'velocity': _load_velocity(recording, p_force)}
    kept = recording.fit | recording.held_out

    def error(*swapped: str) -> float:
        changed: dict[str, Any] = {name: simulated[name] for name in swapped}
        mixed = replace(recording, **changed)
        left = measured(recording, 'force') - predict(mixed, 'force', p_force)
        return float(np.mean(left[kept] ** 2))

    none, z, v = error(), error('valve_position'), error('velocity')
    both = error('valve_position', 'velocity')
    parts = {'command_path and valve': 0.5 * ((z - none) + (both - v)),
             'mechanics': 0.5 * ((v - none) + (both - z)), 'hydraulics and sensor': none}
    total = sum(max(part, 0.0) for part in parts.values()) or 1.0
    return {name: max(part, 0.0) / total for name, part in parts.items()}


def by_regime(group: Group, channel: str, p: np.void) -> list[Regime]:
    """Return where in frequency, amplitude, motion and time the gap of a channel is large."""
    recording = group.recordings[0]
    real = measured(recording, channel)
    left = real - predict(recording, channel, p)
    kept = recording.fit | recording.held_out
    whole = float(np.sqrt(np.mean(left[kept] ** 2))) or 1.0
    found: list[Regime] = []

    def add(kind: str, masks: Mapping[str, Mask]) -> None:
        for name, mask in masks.items():
            chosen = kept & mask
            if chosen.mean() > 0.01:
                rms = float(np.sqrt(np.mean(left[chosen] ** 2)))
                found.append(Regime(kind, name, rms / whole, float(chosen.sum() / kept.sum())))

    for low, high in BANDS_HZ:
        if high < 0.45 / recording.period_s:
            kind = 'lowpass' if low == 0.0 else 'bandpass'
            edge = (high if low == 0.0 else np.array([low, high])) * 2.0 * recording.period_s
            band = sosfiltfilt(butter(2, edge, kind, output='sos'), left)
            found.append(Regime('frequency', f'{low:g} to {high:g} Hz',
                                float(np.sqrt(np.mean(band[kept] ** 2))) / whole, 1.0))
    size = np.abs(real)
    cuts = np.quantile(size, [0.0, 1 / 3, 2 / 3, 1.0])
    add('amplitude', {name: (size >= low) & (size <= high) for name, low, high in zip(
        ('small', 'medium', 'large'), cuts[:-1], cuts[1:], strict=True)})
    velocity = recording.velocity
    if velocity is None and recording.motion is not None:
        motion = recording.motion
        velocity = motion.velocity[motion.pad:motion.pad + real.size]
    if velocity is not None:
        fast = np.quantile(np.abs(velocity), 0.5)
        add('velocity', {'forward, fast': velocity > fast, 'forward, slow': (velocity > 0.0) & (
            velocity <= fast), 'backward, slow': (velocity <= 0.0) & (velocity >= -fast),
            'backward, fast': velocity < -fast})
        turns = np.flatnonzero(np.diff(np.signbit(velocity)))
        last = np.searchsorted(turns, np.arange(real.size)) - 1
        since = (np.arange(real.size) - turns[np.maximum(last, 0)]) * recording.period_s \
            if turns.size else np.full(real.size, np.inf)
        add('time since reversal', {'below 5 ms': since < 0.005, '5 to 50 ms': (
            since >= 0.005) & (since < 0.05), 'above 50 ms': since >= 0.05})
    if recording.valve_position is not None and channel != 'valve':
        opening = np.abs(recording.valve_position)
        middle = np.quantile(opening, 0.5)
        add('valve opening', {'small': opening <= middle, 'large': opening > middle})
    third = np.arange(real.size) * 3 // real.size
    add('time in the run', {name: third == i for i, name in enumerate(('first third',
        'second third', 'last third'))})
    return found
