"""
Whether a static hysteresis loop, without any dependence on the rate, can cause the limit cycle.

`python -m bench.static_loop [OUT]` draws loops at random from the block's static part (a play and
further plays whose widths begin anywhere, then iron that saturates) and linear parts with a coil
of the paper's open-loop bandwidth, any delay, and the structure that locks the piston as shipped
or as plausible. By the describing function, for each: the least gain with a cycle (the onset), its
frequency, and the ratio of the onset without the hysteresis to it. The published facts require an
onset at Kp = 8 and 92 Hz, and none without hysteresis below 1.5 times (F13) or 2 times (F12) that.

The criteria favour the static loop: a step need not exceed its unstable cycle, and damping,
friction and the limit of the command never stop it. Only loops with at most F18's error at Kp = 3
are kept, and only cycles that do not saturate the valve (F7). Then those with the onset's gain and
frequency and the highest ratios are simulated at Kp = 3, piston locked: a step of F begins with a
command of 4 F, which widens the loop as a cycle does, and leaves a steady-state error.
"""

import sys
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from asi_actuator.parameters import as_record
from asi_analysis.arrays import Array, Complex
from asi_analysis.loop import linear_model as linear
from asi_analysis.loop.describing_functions import hysteresis
from asi_analysis.loop.linear_model import damping_slope
from asi_analysis.paper.facts.conditions import LOCKED, Conditions
from asi_analysis.paper.facts.fact import Setup
from asi_analysis.paper.facts.measures import onset_gains, onset_name
from asi_analysis.paper.facts.table_1 import step_test
from asi_analysis.reporting.figures import BLUE, GREEN, GREY, ORANGE, drawing, save
from asi_common.files import write_text
from asi_common.parameter import Value

LOOPS: Final = 3000
COMMANDS_N: Final = np.geomspace(60.0, 4000.0, 30)
FREQUENCIES_HZ: Final = np.geomspace(30.0, 400.0, 400)
# Limits of F4, and the range of the sum of both delays in the search.
COILS_HZ: Final = (18.0, 20.0, 22.0)
DELAYS_S: Final = np.linspace(1e-4, 4e-3, 40)
PLAUSIBLE: Final = {'load.locked_damping': 103.7, 'friction.presliding_damping': 112.5}
# Largest error (N) at Kp = 3 that the loop hides, F18, without the friction of the seals (5 N).
MOST_ERROR_N: Final = 7.0
OPEN_LOOP_N: Final = 300.0
VALVE_N: Final = 900.0
ONSET: Final = (7.6, 8.4)
ONSET_HZ: Final = (88.67, 94.67)
# Limits of the loops that are simulated: somewhat wider.
WIDER: Final = (7.2, 8.8)
WIDER_HZ: Final = (86.0, 97.0)
# Steps (N) at Kp = 3, and the number of loops whose error is simulated.
STEPS_N: Final = (50.0, 100.0, 200.0, 300.0, 500.0)
SIMULATED: Final = 20


class Loops(NamedTuple):
    """n static loops: their shape, error (N) at Kp = 3, and N over COMMANDS_N."""

    shape: Array        # n x (radius, widening, from, range, saturation)
    error_n: Array
    response: Complex   # n x amplitudes


class Found(NamedTuple):
    """Onsets: of loop `loop`, gain, frequency (Hz), ratio, coil (Hz), delay (s), plausible."""

    loop: Array
    gain: Array
    frequency_hz: Array
    ratio: Array
    coil_hz: Array
    delay_s: Array
    plausible: Array


NAMES: Final = ('radius', 'widening', 'widening_from', 'widening_range', 'saturation')


def _shapes(random: np.random.Generator) -> Array:
    """Return shapes: a third with one play only, a third Rayleigh's, a third from any width."""
    kind = np.arange(LOOPS) % 3
    widening = np.where(kind == 0, 0.0, np.exp(random.uniform(np.log(0.05), np.log(8.0), LOOPS)))
    start = np.where(kind == 2, random.uniform(0.0, 1500.0, LOOPS), 0.0)
    return np.stack([random.uniform(1.0, 60.0, LOOPS), widening, start,
                     np.exp(random.uniform(np.log(50.0), np.log(6000.0), LOOPS)),
                     np.exp(random.uniform(np.log(600.0), np.log(2e4), LOOPS))], axis=1)


def error_n(shape: Array) -> float:
    """Return the error (N) at Kp = 3 that a loop hides: half its width over 4, as F18."""
    radius, widening, start, range_, _ = shape
    widths = np.append(start + range_ * (np.arange(8) + 0.5) / 8.0, radius)
    slopes = np.append(np.full(8, widening / 8.0), 1.0)
    return float(np.sum(slopes * np.clip(np.minimum(widths, OPEN_LOOP_N - widths), 0.0, None))
                 / 4.0)


def loops(seed: int = 1) -> Loops:
    """Return random static loops within the error, with their describing function."""
    shapes = _shapes(np.random.default_rng(seed))
    errors = np.array([error_n(shape) for shape in shapes])
    kept = errors <= MOST_ERROR_N
    p = as_record({'valve_hysteresis.lag_time': 0.0})
    rows = []
    for shape in shapes[kept]:
        for name, value in zip(NAMES, shape, strict=True):
            p[f'valve_hysteresis_{name}'] = value
        rows.append([hysteresis(a, 90.0, p, samples=180) for a in COMMANDS_N])
    return Loops(shapes[kept], errors[kept], np.array(rows))


def _crossing(phase: Array, wanted: Array) -> Array:
    """Return the frequencies (Hz) at which a falling phase (rad) has the wanted values."""
    return np.interp(-wanted, -phase, FREQUENCIES_HZ, left=np.nan, right=np.nan)


def onsets(of: Loops) -> Found:
    """Return the onset of each loop with each linear part."""
    parts = []
    for plausible in (False, True):
        p = as_record({**LOCKED, **(PLAUSIBLE if plausible else {}),
                       'valve_flexure.coil_frequency': 1e4, 'valve_flexure.delay': 0.0,
                       'force_sensor.delay': 0.0})
        # The piston with damping and seals, as in the simulated cycle, but not in section 4.1.
        base = linear.plant(p, 2e-4, damping_slope(p), seals_stuck=True)(FREQUENCIES_HZ)
        for coil in COILS_HZ:
            slow = 1.0 / (1.0 + 1j * FREQUENCIES_HZ / coil)
            for delay in DELAYS_S:
                whole = base * slow * np.exp(-2j * np.pi * FREQUENCIES_HZ * delay)
                parts.append(_of_part(of, whole, slow, coil, delay, plausible))
    return Found(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _of_part(of: Loops, whole: Complex, slow: Complex, coil: float, delay: float,
             plausible: bool) -> Found:
    phase = np.minimum.accumulate(np.unwrap(np.angle(whole)))
    limit_hz = float(_crossing(phase, np.array([-np.pi]))[0])
    f = _crossing(phase, -np.pi - np.angle(of.response))
    gain = 1.0 / (np.interp(f, FREQUENCIES_HZ, np.abs(whole)) * np.abs(of.response))
    valve = COMMANDS_N * np.abs(of.response) * np.interp(f, FREQUENCIES_HZ, np.abs(slow))
    gain[~np.isfinite(f) | (valve > VALVE_N)] = np.inf
    k = np.argmin(gain, axis=1)
    row = np.arange(len(k))
    least = gain[row, k]
    linear_gain = 1.0 / float(np.interp(limit_hz, FREQUENCIES_HZ, np.abs(whole)))
    kept = np.isfinite(least)
    return Found(row[kept], least[kept], f[row, k][kept], linear_gain / least[kept],
                 np.full(kept.sum(), coil), np.full(kept.sum(), delay),
                 np.full(kept.sum(), plausible))


def _inside(value: Array, limits: tuple[float, float]) -> Array:
    return (value >= limits[0]) & (value <= limits[1])


def table(of: Loops, found: Found) -> str:
    """Return in Markdown, for each kind of loop, what it reaches with each demand dropped."""
    kinds = {'one play': of.shape[:, 1] == 0.0,
             'widening from 0 (Rayleigh)': (of.shape[:, 1] > 0.0) & (of.shape[:, 2] == 0.0),
             'widening from any width': of.shape[:, 2] > 0.0}
    columns = ('static loop', 'tried', 'with gain and frequency of the onset',
               'their highest ratio without hysteresis',
               'with gain and ratio 1.5: nearest frequency',
               'with frequency and ratio 1.5: nearest gain')
    lines = [f'| {" | ".join(columns)} |', '|' + len(columns) * '---|']
    gain, hz = _inside(found.gain, ONSET), _inside(found.frequency_hz, ONSET_HZ)
    for words, kind in kinds.items():
        own = kind[found.loop]
        both, high = own & gain & hz, own & (found.ratio >= 1.5)
        ratio = f'{found.ratio[both].max():.2f}' if both.any() else '-'
        lines.append(f'| {words} | {own.sum()} | {both.sum()} | {ratio} | '
                     + _nearest(found.frequency_hz[high & gain], 91.67, ' Hz') + ' | '
                     + _nearest(found.gain[high & hz], 8.0) + ' |')
    return '\n'.join(lines) + '\n'


def errors(of: Loops, found: Found) -> str:
    """Return in Markdown the errors that loops of the onset leave after steps at Kp = 3."""
    near = np.flatnonzero(_inside(found.gain, WIDER) & _inside(found.frequency_hz, WIDER_HZ))
    near = near[np.argsort(-found.ratio[near])]
    _, first = np.unique(found.loop[near], return_index=True)
    chosen = near[np.sort(first)[:SIMULATED]]
    left = np.array([[_error_after(of.shape[found.loop[k]], found, k, step_n)
                      for step_n in STEPS_N] for k in chosen])
    rises = np.array([_rise(of.shape[found.loop[k]], found, k) for k in chosen])
    columns = ['onset without hysteresis over onset', 'loops',
               *(f'error after {step_n:g} N' for step_n in STEPS_N),
               'rise of the onset gain from 100 to 300 N']
    lines = [f'| {" | ".join(columns)} |', '|' + len(columns) * '---|']
    for low, high in ((1.1, 1.25), (1.25, 1.5), (1.5, np.inf)):
        own = (found.ratio[chosen] >= low) & (found.ratio[chosen] < high)
        if own.any():
            cells = [f'{value:.1f} N' for value in np.min(left[own], axis=0)]
            words = f'{low:g} to {high:g}' if np.isfinite(high) else f'at least {low:g}'
            cells = [words, f'{own.sum()}', *cells, f'{np.nanmin(rises[own]):.0f} to '
                     f'{np.nanmax(rises[own]):.0f} %']
            lines.append(f'| {" | ".join(cells)} |')
    return '\n'.join(lines) + '\n'


def _actuator(shape: Array, found: Found, k: int) -> dict[str, Value]:
    return {**(PLAUSIBLE if found.plausible[k] else {}), 'valve_hysteresis.lag_time': 0.0,
            **{f'valve_hysteresis.{name}': float(value)
               for name, value in zip(NAMES, shape, strict=True)},
            'valve_flexure.coil_frequency': float(found.coil_hz[k]),
            'valve_flexure.delay': float(found.delay_s[k]), 'force_sensor.delay': 0.0}


def _rise(shape: Array, found: Found, k: int) -> float:
    """Return the rise (%) of the simulated onset gain from a step of 100 N to one of 300 N."""
    setup = Setup(_actuator(shape, found, k), Conditions()._replace(
        onset_accuracy=0.005, onset_watched_s=8.0, highest_gain=24.0), {})
    gains = onset_gains(setup, (100.0, 300.0))
    low, high = (gains[onset_name(step_n, 'gain')] for step_n in (100.0, 300.0))
    return 100.0 * (high / low - 1.0) if np.isfinite(low) and np.isfinite(high) else np.nan


def _error_after(shape: Array, found: Found, k: int, step_n: float) -> float:
    """Return the steady-state error (N) of a loop after a step at Kp = 3, piston locked."""
    test = Conditions().proportional._replace(amplitude_n=step_n, load=LOCKED)
    return step_test(Setup(_actuator(shape, found, k), Conditions(), {}), test, 'p')['p_error_n']


def _nearest(values: Array, wanted: float, unit: str = '') -> str:
    if not values.size:
        return '-'
    return f'{values[np.argmin(np.abs(np.log(values / wanted)))]:.3g}{unit}'


def write(out: Path) -> str:
    """Write table and picture into `out`; return the table."""
    of = loops()
    found = onsets(of)
    text = (table(of, found) + '\nSome of them, simulated: the least error among them '
            'after a step at Kp = 3, and how the onset rises:\n\n'
            + errors(of, found))
    write_text(out / 'static_loop.md', text)
    with drawing(3.2) as figure:
        axes = figure.subplots()
        near = _inside(found.gain, ONSET)
        for words, chosen, colour in (
                ('one play', of.shape[:, 1] == 0.0, GREY),
                ('widening', of.shape[:, 1] > 0.0, BLUE)):
            one = near & chosen[found.loop]
            axes.plot(found.frequency_hz[one], found.ratio[one], '.', ms=1.5, color=colour,
                      label=words, rasterized=True)
        axes.axvspan(*ONSET_HZ, color=GREEN, alpha=0.25, lw=0, label='the paper: frequency')
        axes.axhline(1.5, color=ORANGE, label='the paper: least ratio (F13)')
        axes.set(xlabel='frequency at the onset (Hz)',
                 ylabel='onset without hysteresis / with')
        axes.legend(loc='upper left', markerscale=4.0)
        axes.set_title('Static loops with the onset at Kp 7.6 to 8.4')
    save(figure, out / 'static_loop.png', 110.0)
    return text


if __name__ == '__main__':
    sys.stdout.write(write(Path(sys.argv[1] if len(sys.argv) > 1
                                else 'doc/explanation/reproduction')))
