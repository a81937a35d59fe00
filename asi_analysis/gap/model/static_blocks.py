"""
The equations of a static characteristic with its effects, compiled.

Input and output are relative to the middle of their ranges, in their units. The hysteresis is a
sum of plays (Prandtl-Ishlinskii; Krejci, Hysteresis, Convexity and Dissipation, 1996) whose width
may change along the input.
"""

import math
from typing import Final

import numpy as np

from asi_actuator.model.linear_lag import first_order_or_none
from asi_actuator.model.valve_flexure import dead_zone
from asi_actuator.model.valve_hysteresis import play
from asi_analysis.arrays import Array
from asi_analysis.gap.model.blocks import drift
from asi_analysis.gap.model.effects import OF_A_RECORDING, of_recording
from asi_analysis.gap.prepare import Recording
from asi_common.jit import jit

PLAYS: Final = 8
FIELDS: Final = (
    'gain', 'offset',           # of the nominal line; the offset beyond `base`
    'base',                     # output of the given line at the middle of the input's range
    'reach', 'size',            # half ranges of input and output
    'command_delay',            # s
    'command_quantum',          # of the input
    'command_phase',            # turns
    'command_edge',             # width of the edge of a step, as a share of the step
    'loop_width',               # of the input: half width of the hysteresis
    'loop_share',               # of the input that passes the plays
    'loop_spread',              # 0: one play; 1: widths evenly from 0 to twice the mean
    'loop_skew',                # relative increase of the width from the middle to the upper end
    'loop_start',               # -1 to 1: initial position of the input in its plays
    'command_deadband',         # of the input: half width
    'deadband_centre',          # of the input
    'deadband_slope',           # share of the gain within it
    'bend',                     # 1: two slopes, 2: curvature; a label: they exclude each other
    'gain_asymmetry',           # -1 to 1
    'asymmetry_centre',         # of the input
    'curve_square', 'curve_cube', 'curve_fourth', 'curve_fifth',
    'limit_above', 'limit_below',       # of the output; 0: none
    'corner',                   # width over which a limit is rounded, as a share of the half range
    'valve_lag',                # s, of two lags in series
    'valve_lag_split',          # share of the second
    'sensor_offset', 'sensor_drift', 'sensor_drift_curve', 'sensor_drift_bend',
    'disturbance_wave', 'disturbance_phase', 'disturbance_frequency',   # turns, Hz
    'disturbance_pulse', 'disturbance_start', 'disturbance_end',        # s
)
DTYPE: Final = np.dtype([(name, np.float64) for name in FIELDS])


@jit
def _late(values, place):
    """Return a signal at a fractional sample number, constant beyond its ends."""
    last = values.shape[0] - 1
    if place <= 0.0:
        return values[0]
    if place >= last:
        return values[last]
    below = int(place)
    share = place - below
    return values[below] + share * (values[below + 1] - values[below])


@jit
def _stepped(place, edge):
    """Return the nearest integer, with linear edges that are `edge` wide."""
    whole = math.floor(place + 0.5)
    part = place - whole
    beyond = abs(part) - 0.5 + 0.5 * edge
    if beyond <= 0.0:
        return whole
    return whole + math.copysign(beyond / edge, part)


@jit
def _round_limit(distance, corner):
    """Return by how much a saturation lowers a value `distance` above it, rounded by `corner`."""
    if corner <= 0.0 or abs(distance) > 30.0 * corner:
        return max(distance, 0.0)
    return corner * math.log1p(math.exp(distance / corner))


@jit
def characteristic(given, p, period, out):
    """Put the output at each sample into `out`; given: the input, n samples `period` s apart."""
    plays, radii = np.empty(PLAYS), np.empty(PLAYS)
    share = p.loop_share if p.loop_width > 0.0 else 0.0
    keep, old, new = first_order_or_none(p.valve_lag * (1.0 - p.valve_lag_split), period)
    keep_2, old_2, new_2 = first_order_or_none(p.valve_lag * p.valve_lag_split, period)
    for i in range(PLAYS):
        spread = 1.0 + p.loop_spread * ((2.0 * i + 1.0) / PLAYS - 1.0)
        radii[i] = spread * p.loop_width / share if share > 0.0 else 0.0
    corner = p.corner * p.size
    before, first, second = 0.0, 0.0, 0.0
    for k in range(out.shape[0]):
        u = _late(given, k - p.command_delay / period)
        if p.command_quantum > 0.0:
            u = _stepped(u / p.command_quantum - p.command_phase, p.command_edge)
            u = p.command_quantum * (u + p.command_phase)
        v = u
        if share > 0.0:
            wider = max(1.0 + p.loop_skew * u / p.reach, 0.0)
            held = 0.0
            for i in range(PLAYS):
                radius = radii[i] * wider
                if k == 0:
                    plays[i] = u + p.loop_start * radius
                plays[i] = play(plays[i], u, radius)
                held += plays[i]
            v = (1.0 - share) * u + share * held / PLAYS
        if p.command_deadband > 0.0:
            w = v - p.deadband_centre
            v = p.deadband_slope * w + (1.0 - p.deadband_slope) * dead_zone(
                w, p.command_deadband)
        if p.gain_asymmetry != 0.0:
            v += p.gain_asymmetry * abs(v - p.asymmetry_centre)
        s = v / p.reach
        v += p.reach * s * s * (p.curve_square + s * (
            p.curve_cube + s * (p.curve_fourth + s * p.curve_fifth)))
        y = p.base + p.offset + p.gain * v
        if p.limit_above > 0.0:
            y -= _round_limit(y - p.limit_above, corner)
        if p.limit_below < 0.0:
            y += _round_limit(p.limit_below - y, corner)
        if k == 0:
            before, first, second = y, y, y
        again = first
        first = keep * first + old * before + new * y
        second = keep_2 * second + old_2 * again + new_2 * first
        before = y
        time = k * period
        added = p.sensor_offset + drift(time, p)
        if p.disturbance_wave != 0.0:
            added += p.disturbance_wave * math.sin(
                2.0 * math.pi * (p.disturbance_frequency * time + p.disturbance_phase))
        if p.disturbance_start <= time < p.disturbance_end:
            added += p.disturbance_pulse
        out[k] = second + added


def predict(recording: Recording, p: np.void) -> Array:
    """Return the output predicted from the recorded input: n samples."""
    own = np.zeros(1, DTYPE)[0]
    for name in FIELDS:
        own[name] = p[of_recording(name, recording.number) if name in OF_A_RECORDING else name]
    out = np.empty(recording.fit.size)
    characteristic(recording.command, own, recording.period_s, out)
    return out
