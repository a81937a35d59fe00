"""
Blind cases of static characteristics: valves, spools and solenoids on a test stand, in any unit.

By other laws than those that the diagnosis fits: relays of a Preisach model, Bouc-Wen, contact
that gives way, limits and dead bands that are rounded otherwise, exponential warming, noise of
any colour, converters.
"""

from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.ndimage import uniform_filter1d
from scipy.signal import lfilter, sawtooth

from asi_common.jit import jit

Array = npt.NDArray[np.float64]

EFFECTS: Final = {
    'valve_hysteresis': 'valve', 'valve_saturation': 'valve', 'valve_deadband': 'valve',
    'gain_asymmetry': 'valve', 'curvature': 'valve', 'valve_lag': 'valve',
    'transport_delay': 'command_path', 'command_quantisation': 'command_path',
    'sensor_drift': 'sensor', 'disturbance_force': 'mechanics'}
OUTSIDE: Final = ('ripple', 'bump', 'fading', 'resonance', 'slew', 'creep')
# Effects of time, which need more than one rate, or rests.
OF_TIME: Final = ('valve_lag', 'transport_delay', 'resonance', 'slew', 'creep')
COURSES: Final = ('triangle', 'sine', 'stairs', 'growing')
VISIBLE: Final = 2.0   # times the noise (rms)
SUB: Final = 8   # steps of the equations of time in a sample


class StaticRecording(NamedTuple):
    """One recording: time s, input and output in their units."""

    time_s: Array
    given: Array
    got: Array


class StaticCase(NamedTuple):
    """A case: recordings of one device, another one, and what is true of it."""

    kind: str                 # effect, small, pair, none or outside
    effects: tuple[str, ...]  # or the name of what is outside
    course: str
    recordings: tuple[StaticRecording, ...]
    fresh: StaticRecording
    visibility: float         # of the faintest effect, over the noise (rms)
    also: tuple[str, ...]     # effects that are too small to be seen


@jit
def _relays(given, up, down, weight, out):
    """Put the output of a Preisach model into `out`: relays that switch at `up` and `down`."""
    state = np.where(given[0] > 0.5 * (up + down), 1.0, -1.0)
    for k in range(given.size):
        total = 0.0
        for i in range(up.size):
            if given[k] >= up[i]:
                state[i] = 1.0
            elif given[k] <= down[i]:
                state[i] = -1.0
            total += weight[i] * state[i]
        out[k] = total


@jit
def _bouc_wen(given, width, power, beta, out):
    """Put input less hysteretic variable into `out`; Wen, J. Eng. Mech. 102 (1976)."""
    z = 0.0
    for k in range(given.size):
        step = given[k] - given[k - 1] if k else 0.0
        for _ in range(20):
            size = abs(z / width) ** power
            z += step / 20.0 * (1.0 - size * (beta * np.sign(step * z) + 1.0 - beta))
        out[k] = given[k] - z


@jit
def _backlash(given, width, soft, out):
    """Put the position behind a gap into `out`, whose contact gives way over `soft`."""
    x = given[0]
    for k in range(given.size):
        for _ in range(4):   # friction holds the load; a contact pushes it bit by bit
            gap = given[k] - x
            if gap > width:
                x += (gap - width) * (1.0 - np.exp(-(gap - width) / soft - 0.5))
            elif gap < -width:
                x -= (-gap - width) * (1.0 - np.exp((gap + width) / soft - 0.5))
        out[k] = x


def _hysteresis(x: Array, rng: np.random.Generator) -> Array:
    width, kind = rng.uniform(0.01, 0.12), rng.integers(3)
    out = np.empty_like(x)
    if kind == 0:
        _backlash(x, width, rng.uniform(0.05, 0.5) * width, out)
    elif kind == 1:
        _bouc_wen(x, width, rng.uniform(0.8, 3.0), rng.uniform(0.5, 0.8), out)
    else:
        count = 6000
        centre = rng.uniform(-1.15, 1.15, count)
        half = np.abs(width * (1.0 + rng.uniform(0.1, 0.8) * rng.standard_normal(count)))
        _relays(x, centre + half, centre - half, np.full(count, 1.15 / count), out)
    return out


def _saturation(y: Array, rng: np.random.Generator) -> Array:
    high, low = (rng.uniform(0.6, 0.93) if rng.random() < 0.7 else 9.0 for _ in range(2))
    high = rng.uniform(0.6, 0.93) if high == low == 9.0 else high
    n = 1.0 / rng.uniform(0.02, 0.12)
    return np.where(y > 0.0, y / (1.0 + np.abs(y / high) ** n) ** (1.0 / n),
                    y / (1.0 + np.abs(y / low) ** n) ** (1.0 / n))


def _dead_band(x: Array, rng: np.random.Generator) -> Array:
    half, centre = rng.uniform(0.02, 0.2), rng.uniform(-0.4, 0.4)
    soft, leak = rng.uniform(0.01, 0.15) * half, rng.uniform(0.0, 0.05)
    w = x - centre
    outside = w + 0.5 * (np.sqrt((w - half) ** 2 + soft ** 2)
                         - np.sqrt((w + half) ** 2 + soft ** 2))
    return (1.0 - leak) * outside + leak * w


def _two_slopes(x: Array, rng: np.random.Generator) -> Array:
    ratio, centre = rng.uniform(0.08, 0.4) * rng.choice((-1.0, 1.0)), rng.uniform(-0.3, 0.3)
    soft = rng.uniform(0.002, 0.03)
    return x + ratio * (np.sqrt((x - centre) ** 2 + soft ** 2))


def _bent(x: Array, rng: np.random.Generator) -> Array:
    much, kind = rng.uniform(0.3, 1.0), rng.integers(4)
    sign = rng.choice((-1.0, 1.0))
    if kind == 0:
        return np.sinh(2.0 * much * x) / np.sinh(2.0 * much)
    if kind == 1:
        return np.arctan(2.0 * much * x) / np.arctan(2.0 * much)
    if kind == 2:
        return sign * np.expm1(sign * much * x) / much
    return sign * (np.sqrt(1.0 + 0.8 * much * sign * (x)) - 1.0) / (0.4 * much)


def _in_steps(x: Array, rng: np.random.Generator) -> Array:
    quantum = 2.0 / rng.integers(8, 40)
    place = x / quantum + rng.uniform()
    soft = rng.uniform(0.0, 0.1)
    part = place - np.floor(place)
    edge = np.clip((part - 0.5) / max(soft, 1e-3) + 0.5, 0.0, 1.0)
    return quantum * (np.floor(place) + edge)


def _first_order(x: Array, steps: float) -> Array:
    keep = np.exp(-1.0 / max(steps, 1e-6))
    return np.asarray(lfilter([1.0 - keep], [1.0, -keep], x, zi=[keep * x[0]])[0])


def _resonance(x: Array, steps: float, damping: float) -> Array:
    omega, position, speed = 1.0 / steps, float(x[0]), 0.0
    out = np.empty_like(x)
    for k, u in enumerate(x):
        speed += omega * omega * (u - position) - 2.0 * damping * omega * speed
        position += speed
        out[k] = position
    return out


def _slew(x: Array, most: float) -> Array:
    out, y = np.empty_like(x), float(x[0])
    for k, u in enumerate(x):
        y += min(max(u - y, -most), most)
        out[k] = y
    return out


def _course(kind: str, rng: np.random.Generator, cycles: float, count: int) -> Array:
    """Return an input within -1 to 1, SUB steps a sample; it begins at -1, or in the middle."""
    turns = np.linspace(0.0, cycles, count * SUB)
    if kind == 'sine':
        return np.sin(2.0 * np.pi * (turns - 0.25 * rng.integers(2)))
    if kind == 'stairs':
        levels = rng.integers(6, 12)
        return np.round(levels * sawtooth(2.0 * np.pi * turns, 0.5)) / levels
    wave = sawtooth(2.0 * np.pi * (turns + 0.25 * rng.integers(2)), 0.5)
    if kind == 'growing':
        return wave * (0.3 + 0.7 * np.floor(turns) / max(np.floor(turns).max(), 1.0))
    return uniform_filter1d(wave, max(int(rng.uniform(0.0, 0.01) * count * SUB / cycles), 1),
                            mode='nearest')


class _Bench(NamedTuple):
    """Units, converters and noise of a test stand."""

    gain: float
    units: tuple[float, float]     # of the input, of the output
    origins: tuple[float, float]
    white: float
    coloured: float
    memory: float                  # samples
    bits: tuple[int, int]          # 0: none
    input_noise: float


def _bench(rng: np.random.Generator) -> _Bench:
    units = tuple(10.0 ** rng.uniform(-4.0, 6.0, 2))
    return _Bench(
        float(rng.choice((-1.0, 1.0))), (float(units[0]), float(units[1])),
        (float(rng.uniform(-3.0, 3.0)), float(rng.uniform(-3.0, 3.0))),
        rng.uniform(2e-4, 4e-3), rng.choice((0.0, 1.0)) * rng.uniform(5e-4, 3e-3),
        rng.uniform(3.0, 60.0), (int(rng.choice((0, 12, 16))), int(rng.choice((0, 10, 12, 16)))),
        rng.choice((0.0, 0.0, 1.0)) * rng.uniform(1e-4, 1e-3))


def _device(effects: tuple[str, ...], x: Array, per_pass: float, seed: int) -> Array:
    """Return the output of a device with effects for an input (-1 to 1); SUB steps a sample."""
    rng = {name: np.random.default_rng([seed, number]) for number, name in enumerate(effects)}

    def has(name: str) -> bool:
        return name in rng

    y = x
    if has('transport_delay'):
        late = int(rng['transport_delay'].uniform(0.01, 0.12) * per_pass)
        y = np.concatenate([np.full(late, y[0]), y[:y.size - late]])
    for name, law in (('command_quantisation', _in_steps), ('valve_hysteresis', _hysteresis),
                      ('valve_deadband', _dead_band), ('gain_asymmetry', _two_slopes),
                      ('curvature', _bent), ('valve_saturation', _saturation)):
        y = law(y, rng[name]) if has(name) else y
    if has('ripple'):
        y = y + rng['ripple'].uniform(0.01, 0.04) * np.sin(
            rng['ripple'].uniform(12.0, 30.0) * y + rng['ripple'].uniform(0.0, 6.0))
    if has('bump'):
        y = y + rng['bump'].uniform(0.03, 0.1) * np.exp(
            -((y - rng['bump'].uniform(-0.5, 0.5)) / rng['bump'].uniform(0.06, 0.15)) ** 2)
    if has('fading'):
        y = y * (1.0 - rng['fading'].uniform(0.05, 0.3) * np.linspace(0.0, 1.0, y.size))
    if has('creep'):
        own = rng['creep']
        much, times = own.uniform(0.04, 0.12), per_pass * np.array([0.01, 0.1, 1.0])
        y = (1.0 - much) * y + much / 3.0 * sum(_first_order(y, time) for time in times)
    if has('valve_lag'):
        time = rng['valve_lag'].uniform(0.01, 0.12) * per_pass
        y = _first_order(_first_order(y, time), rng['valve_lag'].uniform(0.0, 0.1) * time)
    if has('resonance'):
        y = _resonance(y, rng['resonance'].uniform(0.01, 0.04) * per_pass,
                       rng['resonance'].uniform(0.05, 0.3))
    if has('slew'):
        y = _slew(y, rng['slew'].uniform(1.1, 1.6) / per_pass)
    return y


def _recorded(effects: tuple[str, ...], kind: str, bench: _Bench, seed: int, number: int,
              shape: tuple[float, int, float, float]
              ) -> tuple[StaticRecording, Array]:
    """
    Return a recording, and its input and output (2 x n) without noise and units.

    shape: cycles, samples, duration s, and the s of a pass of the slowest recording.
    """
    cycles, count, seconds, slowest = shape
    rng = np.random.default_rng([seed, 100 + number])
    course = np.random.default_rng([seed, 99])
    x = _course(kind, course, cycles, count)
    y = _device(effects, x, slowest / seconds * count * SUB, seed)[SUB - 1::SUB]
    x = x[SUB - 1::SUB]
    time = seconds / count * np.arange(count)
    if 'sensor_drift' in effects:
        own = np.random.default_rng([seed, 55, number])
        size = own.uniform(0.04, 0.2) * own.choice((-1.0, 1.0))
        y = y + size * -np.expm1(-time / (seconds * own.uniform(0.3, 2.0)))
    if 'disturbance_force' in effects:
        size = course.uniform(0.03, 0.1) * course.choice((-1.0, 1.0))
        waves, own = course.random() < 0.5, np.random.default_rng([seed, 56, number])
        if waves:
            y = y + size * np.sin(2.0 * np.pi * own.uniform(3.3, 11.7) * cycles * time / seconds)
        else:
            begin = own.uniform(0.1, 0.6) * seconds
            y = y + size * ((time > begin) & (time < begin + own.uniform(0.05, 0.3) * seconds))
    y = y + 0.002 * np.random.default_rng([seed, 57]).uniform(-1.0, 1.0) * x ** 3
    clean = np.array([x, y])
    keep = np.exp(-1.0 / bench.memory)
    slow = lfilter([np.sqrt(1.0 - keep ** 2)], [1.0, -keep],
                   rng.standard_normal(2 * count))[count:]
    y = y + bench.white * rng.standard_normal(count) + bench.coloured * slow
    x = x + bench.input_noise * rng.standard_normal(count)
    x, y = (np.round(each / step) * step if bits else each for each, bits, step in (
        (x, bench.bits[0], 2.4 / 2 ** max(bench.bits[0], 1)),
        (y, bench.bits[1], 2.4 / 2 ** max(bench.bits[1], 1))))
    return StaticRecording(np.asarray(time, np.float64), bench.units[0] * (x + bench.origins[0]),
                           bench.units[1] * bench.gain * (y + bench.origins[1])), clean


def draw_static(seed: int) -> StaticCase:
    """Return the case of a seed."""
    rng = np.random.default_rng(seed)
    kind = str(rng.choice(('effect', 'none', 'outside', 'pair'), p=(0.6, 0.15, 0.15, 0.1)))
    names = tuple(EFFECTS)
    effects: tuple[str, ...] = ()
    if kind == 'effect':
        effects = (str(rng.choice(names)),)
    elif kind == 'outside':
        effects = (str(rng.choice(OUTSIDE)),)
    elif kind == 'pair':
        effects = tuple(sorted(str(each) for each in rng.choice(names, 2, replace=False)))
        if set(effects) == {'gain_asymmetry', 'curvature'}:   # one gain that changes
            effects = ('curvature', 'valve_hysteresis')
    course = str(rng.choice(COURSES))
    of_time = bool(set(effects) & set(OF_TIME))
    if set(effects) & {'resonance', 'creep'}:
        course = 'stairs'
    elif 'slew' in effects:
        course = 'sine'
    elif 'command_quantisation' in effects and course == 'stairs':
        course = 'triangle'   # stairs come in steps anyway
    cycles, count = float(rng.integers(2, 5)), int(rng.integers(1500, 6000))
    seconds = cycles * 10.0 ** rng.uniform(0.6, 2.0)
    bench = _bench(rng)
    rates = [1.0] + ([rng.uniform(2.5, 6.0)] if of_time or rng.random() < 0.4 else [])
    # The device is the same: its times are shares of a pass of the slowest recording.
    shapes = [(cycles, max(int(count / rate), 600), seconds / rate, 0.5 * seconds / cycles)
              for rate in rates]
    made = [_recorded(effects, course, bench, seed, number, shape)
            for number, shape in enumerate(shapes)]
    fresh, _ = _recorded(effects, course, bench, seed, 9, shapes[0])
    noise = float(np.hypot(bench.white, bench.coloured))

    def visible(name: str) -> float:
        """Return what an effect adds to the others and a line, over the noise (rms)."""
        rest = tuple(each for each in effects if each != name)
        return max(_residual(clean, _recorded(rest, course, bench, seed, number, shape)[1])
                   for number, ((_, clean), shape) in enumerate(zip(made, shapes, strict=True))
                   ) / noise

    visibilities = {name: visible(name) for name in effects}
    shown = tuple(name for name in effects if visibilities[name] >= VISIBLE)
    if kind == 'pair' and len(shown) == 1:
        kind = 'effect'
    if kind in ('effect', 'pair') and shown:
        also, effects = tuple(set(effects) - set(shown)), shown
    else:
        also, kind = (), 'small' if kind in ('effect', 'pair') else kind
    return StaticCase(kind, effects, course, tuple(each for each, _ in made), fresh,
                      min(visibilities.values(), default=0.0), also)


def _residual(clean: Array, without: Array) -> float:
    """Return the rms residual of an output with an effect, fitted by that without and a line."""
    known = np.stack([np.ones(clean.shape[1]), clean[0], without[1]])
    return float(np.std(clean[1] - known.T @ np.linalg.lstsq(known.T, clean[1], rcond=None)[0]))


def answer_of(case: StaticCase) -> dict[str, Any]:
    """Return what is true of a case, as the sealed answers have it."""
    blocks = [EFFECTS[name] for name in case.effects if name in EFFECTS]
    return {'kind': case.kind, 'effects': list(case.effects), 'blocks': blocks,
            'excitation': case.course, 'also': list(case.also)}
