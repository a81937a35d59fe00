"""
Harmonic balance of the whole loop: all nonlinearities, several harmonics, sampled control.

The unknowns are the harmonics of the valve command and of the piston's velocity, the mean command,
and the frequency. Linear blocks act on harmonics; nonlinear blocks are run in the time domain with
the model's function until their memory has settled, and their output is projected (alternating
frequency and time: Cameron and Griffin, J. Applied Mechanics 56, 1989). The command is held over
each control period as the loop holds it, and averaged over the phases of the control clock.
"""

import math
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from asi_actuator.model.actuator import rest
from asi_actuator.model.friction import (
    BEFORE,
    ELEMENTS,
    deflected_seals,
    friction,
    settle,
)
from asi_actuator.model.hydraulic_damping import hydraulic_damping
from asi_actuator.model.load import PRESCRIBED, load_spring
from asi_actuator.model.valve_characteristic import (
    valve_characteristic,
    valve_opening,
    valve_position,
)
from asi_actuator.model.valve_hysteresis import AT_ONCE, magnet_step, magnetise
from asi_analysis.arrays import Array, Complex
from asi_analysis.errors import InputError
from asi_analysis.loop import linear_model as linear
from asi_common.jit import FULL, jit
from asi_controller.compensator import frequency_response

HARMONICS: Final = 9
GRID: Final = 512            # samples of a period in continuous time
SETTLING: Final = 2          # periods
AVERAGED: Final = 10         # periods over which the clock's phases are averaged
SEALS_SETTLING: Final = 60   # most periods until the deflection of the seals is periodic
SETTLED_N: Final = 1e-7      # tolerance of that, as a force
SUBSTEPS: Final = 8          # of a control period, for the hysteresis
TOLERANCE: Final = 1e-7      # of the residual, relative to the command
MOST_STEPS: Final = 30
# Of a branch: first step of arc length, in scaled unknowns; largest number of points; lowest gain,
# as a multiple of that at its start.
FIRST_ARC: Final = 0.04
MOST_POINTS: Final = 60
LOWEST: Final = 0.3


class Loop(NamedTuple):
    """
    The closed loop: plant and compensator as records, control period (s), reference (N).

    friction_n: mean friction (N) of seals that do not slide; it depends on the history, and each
    value has its own cycle. None: that of a piston that moved slowly to its position.
    """

    plant: np.void
    compensator: np.void
    period_s: float
    reference_n: float
    friction_n: float | None = None

    @property
    def limit_n(self) -> float:
        """Limit of the command (N), infinite without one."""
        return min(float(self.plant['command_limit']), float(self.compensator['saturation']))

    def compensated(self, frequency_hz: npt.ArrayLike) -> Complex:
        """Return the response of the compensator at frequencies (Hz)."""
        return frequency_response(self.compensator, frequency_hz, 1.0 / self.period_s)


class Balance(NamedTuple):
    """
    A periodic motion.

    command, velocity, force: complex amplitudes of the harmonics 0, 1, … (N, m/s, N), so that a
    signal is the real part of their sum times exp(i h w t).
    """

    gain: float
    frequency_hz: float
    command: Complex
    velocity: Complex
    force: Complex

    @property
    def amplitude_n(self) -> float:
        """Amplitude of the measured force's fundamental."""
        return float(abs(self.force[1]))

    @property
    def thd(self) -> float:
        """Rms of the force's harmonics over that of its fundamental."""
        return float(np.linalg.norm(self.force[2:]) / abs(self.force[1]))


@jit
def _drive(state, command, frequency, limit, p, period, out):
    """Project the response of the magnetic circuit to the held command onto harmonics `out`."""
    step = period / SUBSTEPS
    half = magnet_step(p, 0.5 * step)
    ticks = int(math.ceil((SETTLING + AVERAGED) / (frequency * period)))
    settled = SETTLING / frequency
    span = AVERAGED / frequency
    weights = 0.0
    out[:] = 0.0
    for k in range(ticks):
        value = command[0].real
        for h in range(1, command.size):
            angle = 2.0 * math.pi * h * frequency * k * period
            value += command[h].real * math.cos(angle) - command[h].imag * math.sin(angle)
        value = min(max(value, -limit), limit)
        before = magnetise(state, value, p, AT_ONCE)
        for i in range(SUBSTEPS):
            middle = magnetise(state, value, p, half)
            after = magnetise(state, value, p, half)
            mean = (before + 4.0 * middle + after) / 6.0
            before = after
            time = k * period + (i + 0.5) * step - settled
            if 0.0 <= time < span:
                # Hann's window: the span need not be a whole number of control periods.
                weight = 1.0 - math.cos(2.0 * math.pi * time / span)
                weights += weight
                turn = complex(math.cos(2.0 * math.pi * frequency * (time + settled)),
                               -math.sin(2.0 * math.pi * frequency * (time + settled)))
                wave = 1.0 + 0.0j
                for h in range(out.size):
                    out[h] += weight * mean * wave
                    wave *= turn
    for h in range(out.size):
        out[h] *= (1.0 if h == 0 else 2.0) / weights


@jit
def _forces(position, velocity, p, static, damping):
    for k in range(position.size):
        static[k] = valve_characteristic(position[k], p)
        damping[k] = hydraulic_damping(velocity[k], valve_opening(position[k], p), p)


def valve_forces(position: Array, velocity: Array, p: np.void) -> tuple[Array, Array]:
    """Return static valve force and hydraulic damping (N) at valve positions and velocities."""
    static, damping = np.empty(len(position)), np.empty(len(position))
    _forces(np.ascontiguousarray(position), np.ascontiguousarray(velocity), p, static, damping)
    return static, damping


@jit
def _friction(velocity, deflection, period, p, out):
    """Fill in the friction (N) over a period of seals that begin with a deflection (m)."""
    step = period / velocity.size
    seals = deflected_seals(deflection, p)
    begin, change = np.zeros(ELEMENTS), np.zeros(ELEMENTS)
    begin_before, change_before = np.zeros(ELEMENTS), np.zeros(ELEMENTS)
    for turn in range(SEALS_SETTLING):
        begin[:] = seals[BEFORE]
        for k in range(velocity.size):
            mean = 0.5 * (velocity[k - 1] + velocity[k])
            out[k] = friction(seals, mean, velocity[k], p, step).force
            settle(seals, 0.0, p)
        change[:] = seals[BEFORE] - begin
        if np.abs(change).max() * p.friction_presliding_stiffness < SETTLED_N:
            break
        # Seals that hardly slide would creep for thousands of periods: so by the secant method.
        for i in range(ELEMENTS):
            slope = -1.0
            if turn > 0 and begin[i] != begin_before[i]:
                slope = (change[i] - change_before[i]) / (begin[i] - begin_before[i])
            seals[BEFORE, i] = begin[i] - change[i] / min(max(slope, -1.0), -0.01)
        begin_before[:], change_before[:] = begin, change


def _wave(harmonics: Complex) -> Array:
    """Return one period of a signal on the grid."""
    spectrum = np.zeros(GRID // 2 + 1, complex)
    spectrum[:len(harmonics)] = 0.5 * harmonics
    spectrum[0] = harmonics[0].real
    return np.fft.irfft(spectrum * GRID, GRID)


def _harmonics(wave: Array, count: int) -> Complex:
    """Return the harmonics 0 to `count` of one period."""
    spectrum = np.fft.rfft(wave)[:count + 1] / GRID
    spectrum[1:] *= 2.0
    return spectrum


def plant_response(loop: Loop, command: Complex, velocity: Complex, frequency_hz: float
                   ) -> tuple[Complex, Complex]:
    """Return harmonics of the measured force, and of the residual force on the load."""
    p, count = loop.plant, len(command) - 1
    f = frequency_hz * np.arange(count + 1)
    drive = np.empty(count + 1, complex)
    _drive(rest(), command, frequency_hz, loop.limit_n, p, loop.period_s, drive)
    position = valve_position(_wave(drive * linear.flexure(p)(f)), p)
    speed = _wave(velocity)
    static, damping = valve_forces(position, speed, p)
    hydraulic = _harmonics(static - damping, count) * linear.fluid(p)(f)

    stiffness = load_spring(p)[0]
    deflection = 0.0
    if p['friction_model'] == FULL and stiffness:
        # Seals that never slide are undeflected at the rest position.
        swing = _wave(np.concatenate([[0.0], velocity[1:] / (2j * np.pi * f[1:])]))
        springs = stiffness + p['friction_presliding_stiffness']
        mean = ((hydraulic[0].real + p['load_external_force']) / springs
                if loop.friction_n is None
                else loop.friction_n / p['friction_presliding_stiffness'])
        deflection = float(mean + swing[-1])
    seal_force = np.empty(GRID)
    _friction(speed, deflection, 1.0 / frequency_hz, p, seal_force)
    transmitted = hydraulic - _harmonics(seal_force, count)
    excess = transmitted[1:] - velocity[1:] * linear.impedance(f[1:], p)
    felt = transmitted - velocity * linear.inertia(f, p)
    force = felt * linear.sensor(p)(f) * linear.card(p)(f)
    force[0] += p['force_sensor_offset']
    return force, excess


def residual(loop: Loop, command: Complex, velocity: Complex, frequency_hz: float
             ) -> tuple[Array, Complex]:
    """Return the residual of the balance (N), as real numbers, and the measured force."""
    force, excess = plant_response(loop, command, velocity, frequency_hz)
    f = frequency_hz * np.arange(len(command))
    answer = -loop.compensated(f) * force
    answer[0] += loop.reference_n * (loop.compensated([0.0])[0] + loop.compensator['feedforward'])
    missing = command - answer
    # The residual force on the load, scaled to a command.
    weight = abs(loop.compensator['gain'])
    return np.concatenate([[missing[0].real], missing[1:].real, missing[1:].imag,
                           weight * excess.real, weight * excess.imag]), force


# Vector of unknowns: mean, Re of 1.., Im of 2.., velocity Re, Im, frequency, gain.
def _pack(balance: Balance) -> Array:
    u, v = balance.command, balance.velocity
    return np.concatenate([[u[0].real], u[1:].real, u[2:].imag, v[1:].real, v[1:].imag,
                           [balance.frequency_hz, balance.gain]])


def _unpack(x: Array) -> tuple[Complex, Complex, float, float]:
    count = (len(x) - 2) // 4
    command = np.zeros(count + 1, complex)
    command[0] = x[0]
    command[1:] = x[1:count + 1]
    command[2:] += 1j * x[count + 1:2 * count]
    velocity = np.zeros(count + 1, complex)
    velocity[1:] = x[2 * count:3 * count] + 1j * x[3 * count:4 * count]
    return command, velocity, float(x[-2]), float(x[-1])


def with_gain(loop: Loop, gain: float) -> Loop:
    """Return the loop with another gain of its compensator (at zero frequency)."""
    changed = loop.compensator.copy()
    changed['gain'] = gain
    return loop._replace(compensator=changed)


def _evaluate(loop: Loop, x: Array) -> tuple[Array, Complex]:
    command, velocity, frequency, gain = _unpack(x)
    return residual(with_gain(loop, gain), command, velocity, frequency)


def _sizes(x: Array) -> Array:
    """Return the scale of each unknown, for Newton steps and arc length."""
    count = (len(x) - 2) // 4
    command, velocity, frequency, gain = _unpack(x)
    return np.concatenate([np.full(2 * count, max(abs(command[1]), 1e-9)),
                           np.full(2 * count, max(abs(velocity[1]), 1e-9)),
                           [frequency, gain]])


def _jacobian(loop: Loop, x: Array, at: Array, sizes: Array) -> Array:
    """Return the derivatives of the residual with the scaled unknowns."""
    columns = np.empty((len(at), len(x)))
    for k in range(len(x)):
        moved = x.copy()
        moved[k] += 1e-5 * sizes[k]
        columns[:, k] = (_evaluate(loop, moved)[0] - at) / 1e-5
    return columns


def _newton(loop: Loop, x: Array, row: Array, target: Array, sizes: Array) -> Array | None:
    """
    Return the solution with row . (x - target) / sizes = 0; None without convergence.

    row: fixes the gain, or the arc length. The step is halved until the residual decreases.
    """
    def extended_residual(point: Array) -> Array:
        return np.append(_evaluate(loop, point)[0] / sizes[0],
                         row @ ((point - target) / sizes))

    at = extended_residual(x)
    for _ in range(MOST_STEPS):
        if np.linalg.norm(at) < TOLERANCE * math.sqrt(len(at)):
            return x
        slopes = np.vstack([_jacobian(loop, x, at[:-1] * sizes[0], sizes) / sizes[0], row])
        step = np.linalg.lstsq(slopes, -at, rcond=None)[0] * sizes
        share = 1.0
        while share > 1e-3:
            trial = x + share * step
            if trial[-2] > 0.0 and trial[-1] > 0.0:
                after = extended_residual(trial)
                if np.linalg.norm(after) < (1.0 - 0.2 * share) * np.linalg.norm(at):
                    break
            share *= 0.5
        else:
            # At corners of the nonlinearities no step lowers a small residual further.
            return x if np.linalg.norm(at) < 1e-4 * math.sqrt(len(at)) else None
        x, at = trial, after
    return x if np.linalg.norm(at) < 1e-4 * math.sqrt(len(at)) else None


def _balance(loop: Loop, x: Array) -> Balance:
    command, velocity, frequency, gain = _unpack(x)
    return Balance(gain, frequency, command, velocity, _evaluate(loop, x)[1])


def balance(loop: Loop, guess: Balance) -> Balance | None:
    """Return the periodic motion near a guess, at the guess's gain; None if there is none."""
    if loop.plant['load_type'] == PRESCRIBED:
        raise InputError('load.type = prescribed: a prescribed motion has no limit cycle')
    x = _pack(guess)
    sizes = _sizes(x)
    row = np.zeros(len(x))
    row[-1] = 1.0
    found = _newton(loop, x, row, x, sizes)
    return None if found is None else _balance(loop, found)


def continue_in_gain(loop: Loop, start: Balance, most: float, rising: bool = False
                     ) -> list[Balance]:
    """
    Return the branch of cycles from `start`: decreasing gain to the fold and beyond; or `rising`.

    Pseudo-arclength continuation (Keller 1977) along the tangent passes the fold, where the cycle
    appears. Ends outside the gains from LOWEST to `most` times that of the start, and beyond the
    fold when the gain has increased by 10 %.
    """
    x = _pack(start)
    sizes = _sizes(x)
    branch = [start]
    direction = np.zeros(len(x))
    direction[-1] = 1.0 if rising else -1.0
    step = FIRST_ARC
    while len(branch) < MOST_POINTS and step >= FIRST_ARC / 64.0:
        at = _evaluate(loop, x)[0]
        slopes = _jacobian(loop, x, at, sizes) / sizes[0]
        tangent = np.linalg.svd(slopes)[2][-1]
        tangent *= math.copysign(1.0, tangent @ direction)
        trial = x + step * tangent * sizes
        found = _newton(loop, trial, tangent, trial, sizes)
        if found is None or abs(_unpack(found)[0][1]) < 1.0:
            step *= 0.5
            continue
        direction = (found - x) / sizes
        x, step = found, min(1.3 * step, 0.12)
        branch.append(_balance(loop, x))
        lowest = min(point.gain for point in branch)
        risen = not rising and lowest < start.gain and branch[-1].gain > 1.1 * lowest
        if not LOWEST * start.gain <= branch[-1].gain <= most * start.gain or (
                risen and direction[-1] > 0.0):
            break
    return branch


def fold(branch: list[Balance]) -> tuple[float, float, float]:
    """
    Return (gain, frequency Hz, amplitude N) where the branch has its least gain: the onset.

    By the parabola through the three points about it; if the branch ends there, that point.
    """
    gains = np.array([point.gain for point in branch])
    k = int(np.argmin(gains))
    if not 0 < k < len(branch) - 1:
        return branch[k].gain, branch[k].frequency_hz, branch[k].amplitude_n
    near = branch[k - 1:k + 2]
    arc = np.array([point.amplitude_n for point in near])
    curve = np.polyfit(arc, gains[k - 1:k + 2], 2)
    where = -0.5 * curve[1] / curve[0]
    if curve[0] <= 0.0 or not min(arc) <= where <= max(arc):
        return branch[k].gain, branch[k].frequency_hz, branch[k].amplitude_n
    return (float(np.polyval(curve, where)),
            float(np.polyval(np.polyfit(arc, [b.frequency_hz for b in near], 2), where)),
            float(where))
