"""
Discretisation and execution of the compensators in `compensators/`.

A compensator is designed in continuous time as a product of (s/z + 1)/(s/p + 1), so that the gain
is that at zero frequency, as in the paper; discretised for the control rate by Tustin's rule,
prewarped at the frequency of the limit cycle; and run as a cascade of second-order sections, the
slowest pole last. The additions in `additions/` act before it, beside it and after it.
"""

import math
from collections.abc import Mapping
from typing import Final

import numpy as np
import numpy.typing as npt

from asi_common.jit import jit
from asi_common.parameter import ParameterError, Value, completed, with_its_type
from asi_common.record import as_number, field_name, record_dtype
from asi_controller.additions.disturbance_observer import disturbance, observe
from asi_controller.additions.friction_feedforward import compensated
from asi_controller.additions.gain_schedule import scheduled
from asi_controller.additions.hysteresis_inverse import follow
from asi_controller.additions.integrator import integrate
from asi_controller.additions.notch import with_notch
from asi_controller.additions.reference_model import (
    approach,
    extrapolated,
    model_drive,
    model_ratio,
)
from asi_controller.additions.velocity_feedforward import advanced, compensation, followed
from asi_controller.compensators import COMPENSATORS
from asi_controller.design import MOST_POLES, PREWARP_HZ, Design
from asi_controller.parameters import ADDITION_PARAMETERS, COMPENSATOR_PARAMETERS
from asi_controller.sections import second_order_sections

# A change of the gain multiplies the memory by the ratio of the gains, which must stay finite.
LEAST_GAIN: Final = 1e-100
MOST_SECTIONS: Final = MOST_POLES // 2 + 1   # the last for the notch
# The gain in use while the parameter `gain` is 0, by compensator.
OWN_GAIN: Final = {name: each.gain for name, each in COMPENSATORS.items()}

# For so long, the time constant of the frequency of the limit cycle (s), an error is taken to have
# moved along a line: longer than what a lead remembers, and shorter than a cycle.
RAMP_S: Final = 1.0 / (2.0 * math.pi * PREWARP_HZ)
# Values of `fresh`: at the next sample the memory is initialised to that of a constant error, with
# the lag at rest, or of one that moves as it does now, with the lag at the running command.
REST: Final = 1
TAKE_OVER: Final = 2


COMPENSATOR_DTYPE = np.dtype([
    ('gain', np.float64),
    ('feedforward', np.float64),
    ('saturation', np.float64),
    ('count', np.int64),                             # second-order sections in use
    ('sections', np.float64, (MOST_SECTIONS, 5)),    # b0 b1 b2 a1 a2
    ('lag', np.float64, (3,)),                       # b0 b1 a1, the slowest pole
    ('memory', np.float64, (MOST_SECTIONS, 2)),
    ('lag_memory', np.float64),
    ('fresh', np.int64),                             # REST, TAKE_OVER or neither
    ('changed', np.int64),                           # 1: bumpless transfer at the next tick
    ('bias', np.float64),                            # N, of the bumpless transfer
    ('bias_decay', np.float64),                      # factor of the bias in each tick
    ('command', np.float64),                         # N, the last one
    ('slow_error', np.float64),                      # N, lagging; NaN: not known
    ('period', np.float64),                          # s
    *record_dtype(ADDITION_PARAMETERS).descr,
    ('integral', np.float64),                        # N, of the integrator
    ('reference', np.float64),                       # N, the last one
    ('model_ratio', np.float64),                     # N per N, of the reference model
    ('model_force', np.float64),                     # N, of the reference model
    ('model_delayed', np.float64),                   # N
    ('centre', np.float64),                          # N, of the hysteresis inverse
    ('velocity', np.float64),                        # m/s, of the velocity feed-forward; NaN: off
    ('observed', np.float64, (2,)),                  # N, of the disturbance observer
])


def design(values: Mapping[str, Value], rate_hz: float | None = None) -> Design:
    """
    Return the compensator of the parameters, in continuous time.

    rate_hz: the control rate of the discrete one: its notch is then where `discretise`
    puts it at its frequency.
    Raises ParameterError if a parameter or the combination is not allowed.
    """
    v = completed(values, COMPENSATOR_PARAMETERS)
    if rate_hz is not None:
        _check_rate(rate_hz)
    if 0.0 < float(v['gain']) < LEAST_GAIN:
        raise ParameterError(f'gain = {v["gain"]!r} is not allowed: it is 0, or at least '
                             f'{LEAST_GAIN:g}')
    chosen = COMPENSATORS[str(v['compensator'])]
    found = chosen.design(float(v['gain']) or chosen.gain, **{
        parameter.name: with_its_type(parameter, v[f'{chosen.name}.{parameter.name}'])
        for parameter in chosen.parameters})
    return with_notch(found, float(v['notch.frequency']), float(v['notch.depth']),
                      float(v['notch.width']), rate_hz)


def _check_rate(rate_hz: float) -> None:
    """Raise ParameterError if a control rate does not allow the prewarping."""
    if not 2.0 * PREWARP_HZ < rate_hz < math.inf:
        raise ParameterError(f'a control rate of {rate_hz:g} Hz is not allowed: the compensators '
                             f'need more than {2.0 * PREWARP_HZ:g} Hz')


def _discrete(root: complex, rate_hz: float) -> complex:
    """Return the discrete zero or pole of one in rad/s, by Tustin's rule with prewarping."""
    w = 2.0 * math.pi * PREWARP_HZ
    relative = root * math.tan(0.5 * w / rate_hz) / w
    # Against a division by zero.
    return (1.0 + relative) / (1.0 - relative or 1e-12)


def _first_order(zero: float, pole: float) -> npt.NDArray[np.float64]:
    """Return b0, b1, a1 of a discrete zero and pole, with gain 1 at zero frequency."""
    b = np.array([1.0, -zero])
    return np.append(b * (1.0 - pole) / b.sum(), -pole)


def _take_lag(poles: list[complex], zeros: list[complex]) -> tuple[complex, complex | None] | None:
    """
    Remove and return the slowest real pole, with the nearest real zero if one is necessary.

    It is necessary if the rest would otherwise have more zeros than poles. None, and nothing is
    removed, if there is no such pole or zero.
    """
    real_poles = [pole for pole in poles if pole.imag == 0.0]
    real_zeros = [zero for zero in zeros if zero.imag == 0.0]
    needs_zero = len(zeros) == len(poles)
    if not real_poles or (needs_zero and not real_zeros):
        return None
    pole = max(real_poles, key=lambda pole: pole.real)
    poles.remove(pole)
    if not needs_zero:
        return pole, None
    zero = min(real_zeros, key=lambda zero: abs(zero - pole))
    zeros.remove(zero)
    return pole, zero


def discretise(design_: Design, rate_hz: float) -> tuple[
        npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """
    Return the sections (n x 5: b0 b1 b2 a1 a2) and the slowest pole's section (b0 b1 a1).

    Each has gain 1 at zero frequency. The slowest real pole comes last, alone or with a real zero,
    because that is where anti-windup must act.
    Raises ParameterError if the control rate is too low, or a root too slow or too fast for it.
    """
    _check_rate(rate_hz)
    poles, zeros = ([_discrete(root, rate_hz) for root in roots]
                    for roots in (design_.poles, design_.zeros))
    if (any(abs(pole) > 1.0 - 1e-13 for pole in poles)
            or any(abs(zero - 1.0) < 1e-13 for zero in zeros)):
        raise ParameterError('the compensator has a zero or a pole too slow or too fast for a '
                             f'control rate of {rate_hz:g} Hz')
    lag = np.array([1.0, 0.0, 0.0])
    if taken := _take_lag(poles, zeros):
        # Tustin's rule puts the zeros at infinity at the Nyquist frequency.
        lag = _first_order(-1.0 if taken[1] is None else taken[1].real, taken[0].real)
    if not poles:
        return np.empty((0, 5)), lag
    zeros += [-1.0] * (len(poles) - len(zeros))
    sections = second_order_sections(zeros, poles)[:, [0, 1, 2, 4, 5]]
    at_zero = sections[:, :3].sum(1) / (1.0 + sections[:, 3:].sum(1))
    sections[:, :3] /= at_zero[:, None]
    return sections, lag


def compensator(values: Mapping[str, Value], rate_hz: float,
                running: np.void | None = None) -> np.void:
    """
    Return the record of a compensator for `compensate`.

    values: parameters by name, the rest at their defaults; rate_hz: control rate; running: the
    compensator that it replaces, with bumpless transfer of the command.
    Raises ParameterError if a parameter or the combination is not allowed.
    """
    v = completed(values, COMPENSATOR_PARAMETERS)
    design_ = design(v, rate_hz)
    sections, lag = discretise(design_, rate_hz)
    c = np.zeros(1, COMPENSATOR_DTYPE)[0]
    c['gain'], c['feedforward'], c['saturation'] = (
        design_.gain, v['feedforward'], v['saturation'])
    c['count'] = len(sections)
    c['sections'][:len(sections)] = sections
    c['lag'] = lag
    c['fresh'], c['velocity'] = REST, math.nan
    transfer = float(v['transfer_time'])
    c['bias_decay'] = math.exp(-1.0 / (rate_hz * transfer)) if transfer else 0.0
    c['period'] = 1.0 / rate_hz
    for parameter in ADDITION_PARAMETERS:
        c[field_name(parameter.name)] = as_number(parameter, v[parameter.name])
    c['model_ratio'] = model_ratio(
        float(v['reference_model.bandwidth']), float(v['reference_model.lag_frequency']),
        1.0 / rate_hz)
    if running is not None:
        for name in ('integral', 'reference', 'model_force', 'model_delayed', 'centre',
                     'velocity', 'observed', 'slow_error'):
            c[name] = running[name]
        if not c['reference_model_delay']:
            c['model_delayed'] = c['model_force']
        c['command'], c['changed'] = running['command'], int(transfer > 0.0)
        if (np.array_equal(running['sections'], c['sections'])
                and np.array_equal(running['lag'], c['lag']) and not _error_steps(running, c)):
            c['fresh'], c['memory'] = running['fresh'], running['memory']
            # The slow part of the command is independent of the gain.
            c['lag_memory'] = running['lag_memory'] * running['gain'] / c['gain']
        else:
            c['fresh'] = TAKE_OVER
        if _error_steps(running, c):
            c['slow_error'] = math.nan
    return c


def _error_steps(running: np.void, c: np.void) -> bool:
    """
    Return whether a change of the additions is a step of the error.

    A lead with the memory of the error before would differentiate it.
    """
    had, has = (each['reference_model_bandwidth'] > 0.0 for each in (running, c))
    return bool((had and not has) or any(
        running[name] != c[name]
        for name in ('gain_schedule_velocity', 'gain_schedule_least', 'model_delayed')))


@jit
def _through_sections(c, value):
    """Return an error (N) through the sections; updates their memory."""
    for i in range(c.count):
        out = c.sections[i, 0] * value + c.memory[i, 0]
        c.memory[i, 0] = c.sections[i, 1] * value - c.sections[i, 3] * out + c.memory[i, 1]
        c.memory[i, 1] = c.sections[i, 2] * value - c.sections[i, 4] * out
        value = out
    return value


@jit
def _initialise(c, error, slope, slow):
    """
    Set the memory to that of an error which was at rest, and then moved for RAMP_S along a line.

    error, slope: the error now, N, and its change in a period, N; slow: last output of the lag, N.
    """
    ticks = math.ceil(RAMP_S / c.period) if slope != 0.0 else 0
    value = error - ticks * slope
    for i in range(c.count):
        b0, _, b2, _, a2 = c.sections[i]
        c.memory[i, 0] = value - b0 * value
        c.memory[i, 1] = b2 * value - a2 * value
    before = value
    for tick in range(ticks):
        before = _through_sections(c, value + tick * slope)
    c.lag_memory = c.lag[1] * before - c.lag[2] * slow
    c.fresh = 0


@jit
def _slope(c, error):
    """
    Return the change of an error (N) in a period, N; updates `c` in place.

    It is that of a lag of the error, which steadies what noise makes of two samples.
    """
    if c.fresh == REST or math.isnan(c.slow_error):
        c.slow_error = error
    kept = math.exp(-c.period / RAMP_S)
    behind = error - c.slow_error
    c.slow_error = error - kept * behind
    return (1.0 - kept) * behind


@jit
def _additions(c, reference, measured, velocity):
    """Return the set point (N) of the feedback, and the command (N) that is added to it."""
    goal, drive = reference, reference
    if c.reference_model_bandwidth > 0.0:
        if c.fresh == REST:
            c.model_force = c.model_delayed = measured
            c.reference = reference
        ahead = extrapolated(reference, c.reference, c.reference_model_lead_time,
                             c.reference_model_slope, c.period)
        drive = model_drive(c.model_force, ahead, c.model_ratio, c.reference_model_drive)
        goal = c.model_delayed
        c.model_force = approach(c.model_force, drive, 2.0 * math.pi
                                 * c.reference_model_lag_frequency, c.period)
        c.model_delayed = (approach(c.model_delayed, c.model_force,
                                    1.0 / c.reference_model_delay, c.period)
                           if c.reference_model_delay > 0.0 else c.model_force)
    else:
        c.model_force = c.model_delayed = reference
    c.reference = reference
    command = c.feedforward * drive
    if c.velocity_feedforward_share > 0.0:
        c.velocity = followed(c.velocity, velocity, c.velocity_feedforward_lead_time, c.period)
        command += compensation(advanced(c.velocity, velocity), c.velocity_feedforward_share,
                                c.velocity_feedforward_damping)
    else:
        c.velocity = math.nan
    if c.friction_feedforward_level > 0.0:
        command += compensated(velocity, c.friction_feedforward_level,
                               c.friction_feedforward_speed)
    if c.disturbance_observer_bandwidth > 0.0:
        command -= disturbance(c.observed, measured, c.disturbance_observer_bandwidth,
                               c.disturbance_observer_lag_frequency)
    if c.integrator_rate > 0.0:
        command += c.integral
    else:
        c.integral = 0.0
    return goal, command


@jit
def _limited(c, command):
    return min(max(command, -c.saturation), c.saturation)


@jit
def _through_inverse(c, command):
    """Return the command (N) through the inverse of the valve's play; updates its state."""
    moved = _limited(c, command)
    dead_zone = c.hysteresis_inverse_dead_zone
    c.centre = follow(c.centre, moved, dead_zone)
    if c.hysteresis_inverse_size == 0.0:
        return command
    return command + c.hysteresis_inverse_size * (moved - c.centre) / dead_zone


@jit
def compensate(c, reference, measured, velocity):
    """
    Return the valve command (N); updates `c` in place.

    reference, measured: desired and measured force, N; velocity: of the piston, m/s.

    Anti-windup by conditional integration: while the command is saturated the lag does not move
    further in that direction. (With back-calculation the short peak of a lead after a step would
    shift the lag for seconds.)
    """
    if c.fresh == REST:
        c.integral = 0.0
        observe(c.observed, measured, c.command, 0.0, c.period)
    goal, direct = _additions(c, reference, measured, velocity)
    error = goal - measured
    value = error * scheduled(velocity, c.gain_schedule_velocity, c.gain_schedule_least)
    slope = _slope(c, value)
    if c.fresh != 0:
        _initialise(c, value, slope,
                    (c.command - direct) / c.gain if c.fresh == TAKE_OVER else 0.0)
    value = _through_sections(c, value)
    out = c.lag[0] * value + c.lag_memory
    linear = c.gain * out + direct
    wanted = _through_inverse(c, linear)
    possible = _limited(c, wanted)
    if c.changed == 1:
        # The excess of a saturated command is no part of the step that is faded in: as a bias it
        # would outlast the saturation.
        c.bias = _limited(c, c.command) - possible
        c.changed = 0
    c.command = _limited(c, possible + c.bias)
    # Of one sign: where the first is not 0, the bias cannot reach the other limit.
    excess = wanted - possible + (possible + c.bias - c.command)
    observe(c.observed, measured, _limited(c, _limited(c, linear) + c.bias),
            c.disturbance_observer_bandwidth, c.period)
    c.bias *= c.bias_decay
    c.integral = integrate(c.integral, error, excess, c.integrator_rate, c.period)
    memory = c.lag[1] * value - c.lag[2] * out
    if excess * (memory - c.lag_memory) <= 0.0:
        c.lag_memory = memory
    return c.command


@jit
def commands(c, reference, measured, velocity):
    """
    Return the valve commands (N) to n samples in succession; updates `c` in place.

    reference, measured: desired and measured force, N; velocity: of the piston, m/s.
    """
    found = np.empty(reference.size)
    for k in range(reference.size):
        found[k] = compensate(c, reference[k], measured[k], velocity[k])
    return found


def frequency_response(c: np.void, frequencies_hz: npt.ArrayLike, rate_hz: float
                       ) -> npt.NDArray[np.complex128]:
    """
    Return the response of the discrete compensator at frequencies (Hz).

    With notch and integrator (infinite at 0 Hz), at rest; without the other additions.
    """
    z = np.exp(2j * np.pi * np.asarray(frequencies_hz, float) / rate_hz)
    response = c['gain'] * (c['lag'][0] + c['lag'][1] / z) / (1.0 + c['lag'][2] / z)
    for b0, b1, b2, a1, a2 in c['sections'][:c['count']]:
        response = response * (b0 + b1 / z + b2 / z**2) / (1.0 + a1 / z + a2 / z**2)
    if c['integrator_rate'] == 0.0:
        return response
    return response + c['integrator_rate'] / rate_hz / (z - 1.0)
