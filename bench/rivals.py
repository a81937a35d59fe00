"""
Error against computing time of our model, scipy, python-control and MuJoCo.

scipy's solve_ivp (LSODA, Radau) and python-control get the same equations, written as a
right-hand side that is compiled too. They have no delays, so both delays are 0. The play of the
hysteresis is no differential equation; but while the command is constant, its output is the last
one limited to a band that only narrows, which is given to them in closed form. MuJoCo gets what it
can express: a saturated force, a first-order lag, a mass with spring and damper.

The error is the largest one of the force at the control samples, as a share of the largest force,
relative to our model at a sub-step 16 times finer than the default; LSODA at its tightest
tolerance confirms that. Time is processor time for a simulated second.
"""

import sys
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Final, NamedTuple

import numba
import numpy as np
import numpy.typing as npt
from scipy.integrate import solve_ivp

from asi_actuator.model.actuator import simulate
from asi_actuator.model.force_sensor import CARD_DAMPING
from asi_actuator.model.friction import sliding_friction, sliding_share
from asi_actuator.model.hydraulic_damping import hydraulic_damping
from asi_actuator.model.valve_characteristic import (
    valve_characteristic,
    valve_opening,
    valve_position,
)
from asi_actuator.model.valve_hysteresis import command_rate, half_width, play, saturated
from asi_actuator.parameters import ACTUATOR_PARAMETERS, as_record
from asi_common.parameter import Value, defaults
from bench.result import Result, interleaved, show

Array = npt.NDArray[np.float64]

# A command that holds for a millisecond at a time, as a control loop of 1 kHz gives.
PERIOD_S: Final = 1e-3
STEPS: Final = 60
COMMANDS: Final = 800.0 * np.sin(2.0 * np.pi * 40.0 * PERIOD_S * np.arange(STEPS))
NO_DELAYS: Final[dict[str, Value]] = {'valve_flexure.delay': 0.0, 'force_sensor.delay': 0.0}
FINER: Final = 16
SUBSTEPS_S: Final = (1e-4, 5e-5, 2.5e-5, 1.25e-5, 6.25e-6, 3.125e-6)
TOLERANCES: Final = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8)
DEFAULT_SUBSTEP_S: Final = float(defaults(ACTUATOR_PARAMETERS)['maximum_substep'])

# The states of the right-hand side.
(FILTERED, COIL, FLEXURE, FLEXURE_RATE, HYDRAULIC, POSITION, VELOCITY, SEAL, SENSOR, SENSOR_RATE,
 CARD, CARD_RATE, COUNT) = range(13)


class Point(NamedTuple):
    """What a solver reached: seconds for a simulated second, largest error (share)."""

    seconds: float
    error: float


@numba.njit(error_model='numpy')
def _second_order(x, rate, input_, frequency, damping_ratio):
    w = 2.0 * np.pi * frequency
    return w * w * (input_ - x) - 2.0 * damping_ratio * w * rate


@numba.njit(error_model='numpy')
def slopes(x, command, flux, p):
    """Return the derivative of the states at a held command; flux: the play's output before."""
    rate = command_rate(command, x[FILTERED], p)
    drive = saturated(play(flux, command, half_width(rate, p)), p)
    position = valve_position(x[FLEXURE], p)
    velocity = x[VELOCITY]
    static = (valve_characteristic(position, p)
              - hydraulic_damping(velocity, valve_opening(position, p), p))
    limit = sliding_friction(velocity, p) / p.friction_presliding_stiffness
    loss = sliding_share(np.copysign(1.0, velocity) * x[SEAL] / limit) / limit
    elastic = max(0.0, 1.0 - loss * abs(x[SEAL]))
    seal_force = (p.friction_presliding_stiffness * x[SEAL]
           + p.friction_presliding_damping * elastic * velocity)
    transmitted = x[HYDRAULIC] - seal_force
    out = np.empty(COUNT)
    out[FILTERED] = rate
    out[COIL] = 2.0 * np.pi * p.valve_flexure_coil_frequency * (drive - x[COIL])
    out[FLEXURE] = x[FLEXURE_RATE]
    out[FLEXURE_RATE] = _second_order(x[FLEXURE], x[FLEXURE_RATE], x[COIL],
                                      p.valve_flexure_natural_frequency,
                                      p.valve_flexure_damping_ratio)
    out[HYDRAULIC] = 2.0 * np.pi * p.fluid_dynamics_frequency * (static - x[HYDRAULIC])
    out[POSITION] = velocity
    out[VELOCITY] = (transmitted - p.load_locked_stiffness * x[POSITION]
                     - p.load_locked_damping * velocity) / p.load_mass
    out[SEAL] = velocity - loss * abs(velocity) * x[SEAL]
    out[SENSOR] = x[SENSOR_RATE]
    felt = transmitted - p.force_sensor_mass_share * p.load_mass * out[VELOCITY]
    out[SENSOR_RATE] = _second_order(x[SENSOR], x[SENSOR_RATE], felt,
                                     p.force_sensor_natural_frequency,
                                     p.force_sensor_damping_ratio)
    out[CARD] = x[CARD_RATE]
    out[CARD_RATE] = _second_order(x[CARD], x[CARD_RATE], x[SENSOR],
                                   p.force_sensor_card_frequency, CARD_DAMPING)
    return out


@numba.njit(error_model='numpy')
def flux_after(x, command, flux, p):
    """Return the play's output at the end of a command that has held."""
    return play(flux, command, half_width(command_rate(command, x[FILTERED], p), p))


def parameters(substep_s: float = DEFAULT_SUBSTEP_S) -> np.void:
    """Return the parameters that all share."""
    return as_record(NO_DELAYS | {'maximum_substep': substep_s})


def ours(commands: Array, period_s: float, substep_s: float) -> Array:
    """Return the force at the control samples by our model."""
    return simulate(parameters(substep_s), commands, period_s).force_n


def by_scipy(commands: Array, period_s: float, method: str, tolerance: float) -> Array:
    """Return the same by solve_ivp, begun anew at each command: there the slope jumps."""
    p, x, flux = parameters(), np.zeros(COUNT), 0.0
    scale = np.full(COUNT, 1.0)
    scale[[FLEXURE_RATE, SENSOR_RATE, CARD_RATE]] = 1e3
    scale[[POSITION, SEAL]], scale[VELOCITY] = 1e-6, 1e-3
    force = np.empty(commands.size)
    for k, command in enumerate(commands):
        force[k] = x[CARD]
        found = solve_ivp(lambda _, x: slopes(x, command, flux, p), (0.0, period_s), x,  # noqa: B023
                          method, rtol=tolerance, atol=1e2 * tolerance * scale)
        # A jump of the command widens the band at once; then the band narrows.
        flux = flux_after(found.y[:, -1], command, flux_after(x, command, flux, p), p)
        x = found.y[:, -1]
    return force


def by_control(command: float, period_s: float, samples: int, tolerance: float) -> Array:
    """Return the answer to one step of the command, by python-control with LSODA."""
    import control
    p = parameters()
    system = control.nlsys(lambda t, x, u, _: slopes(x, command, 0.0, p),
                           lambda t, x, u, _: x[CARD], inputs=1, outputs=1, states=COUNT)
    time_s = np.arange(samples) * period_s
    found = control.input_output_response(
        system, time_s, np.full(samples, command), solve_ivp_method='LSODA',
        solve_ivp_kwargs={'rtol': tolerance, 'atol': tolerance})
    return np.asarray(found.outputs)


MUJOCO: Final[dict[str, Value]] = {
    'load.type': 'spring', 'load.mass': 2.0, 'load.stiffness': 2e5, 'load.damping': 200.0,
    **{f'{block}.model': 'off' for block in ('valve_hysteresis', 'valve_flexure', 'friction',
                                             'hydraulic_damping', 'force_sensor')}}


def mujoco_model(timestep_s: float) -> object:
    """Return the same in MuJoCo: a slide with spring and damper, a motor with a lag and a stop."""
    import mujoco
    p = as_record(MUJOCO)
    gain, bound = (float(p[name]) for name in ('valve_characteristic_gain',
                                               'valve_characteristic_maximum_force'))
    lag_s = 1.0 / (2.0 * np.pi * float(p['fluid_dynamics_frequency']))
    return mujoco.MjModel.from_xml_string(f"""
    <mujoco><option timestep="{timestep_s}" gravity="0 0 0" integrator="implicitfast"/>
    <worldbody><body><joint name="piston" type="slide" axis="1 0 0" damping="200"
    stiffness="200000"/><geom size="0.1" mass="2"/></body></worldbody>
    <actuator><general joint="piston" dyntype="filterexact" dynprm="{lag_s}" gainprm="{gain}"
    ctrllimited="true" ctrlrange="{-bound / gain} {bound / gain}"/></actuator></mujoco>""")


def by_mujoco(model: object, commands: Array, every: int) -> Array:
    """Return the position at the control samples, the loop over steps in MuJoCo's own C."""
    import mujoco
    from mujoco import rollout
    data = mujoco.MjData(model)
    start = np.zeros(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    states, _ = rollout.rollout(model, data, start, np.repeat(commands, every)[:, None])
    # time, position, velocity, activation; the state after each step.
    return np.concatenate([[0.0], states[0, every - 1:-1:every, 1]])


def points(runs: Mapping[float, Callable[[], Array]], reference: Array, rounds: int,
           simulated_s: float) -> list[Point]:
    """Return time and error of runs by their accuracy, the runs in turns."""
    times = interleaved({f'{each}': run for each, run in runs.items()}, rounds,
                        time.process_time)
    largest = float(np.abs(reference).max())
    return [Point(float(np.median(times[f'{each}'])) / simulated_s,
                  float(np.abs(run() - reference).max()) / largest) for each, run in runs.items()]


def seconds_at(error: float, curve: list[Point]) -> float:
    """Return the time that a solver takes for an error, between its points, else its nearest."""
    known = sorted((np.log(p.error), np.log(p.seconds)) for p in curve)
    return float(np.exp(np.interp(np.log(error), *zip(*known, strict=True))))


def curve_results(name: str, what: str, curve: list[Point]) -> list[Result]:
    """Return a curve as results: time, at an error."""
    return [Result(f'rivals.{name}.{k}', what, point.seconds, 's for a simulated second',
                   at=point.error) for k, point in enumerate(curve)]


def held_commands(quick: bool) -> list[Result]:
    """Return ours against scipy, for a command that holds and changes."""
    tolerances = TOLERANCES[:2] if quick else TOLERANCES
    commands = COMMANDS[:20] if quick else COMMANDS
    simulated_s = commands.size * PERIOD_S
    reference = ours(commands, PERIOD_S, DEFAULT_SUBSTEP_S / FINER)
    mine = points({h: partial(ours, commands, PERIOD_S, h) for h in SUBSTEPS_S}, reference,
                  3 if quick else 30, simulated_s)
    default = mine[SUBSTEPS_S.index(DEFAULT_SUBSTEP_S)]
    results = curve_results('ours', 'ours', mine)
    for method in ('LSODA', 'Radau'):
        curve = points({each: partial(by_scipy, commands, PERIOD_S, method, each)
                        for each in tolerances}, reference, 1 if quick else 2, simulated_s)
        results += curve_results(method, f'scipy {method}', curve)
        best = min(point.error for point in curve)
        ratio = seconds_at(max(default.error, best), curve) / default.seconds
        results.append(Result(
            f'rivals.{method}.ratio', 'times as long at our default error '
            f'({100.0 * default.error:.2g} % of the force)', default.seconds,
            's for a simulated second', 0.0, f'scipy solve_ivp {method}', ratio, '>= 100'))
        if method == 'LSODA':
            results.append(Result('rivals.same', 'LSODA at its tightest against our finest', best,
                                  'of the force'))
    return results


def one_step(quick: bool) -> list[Result]:
    """Return ours against python-control, for one step of the command."""
    tolerances = TOLERANCES[1:3] if quick else TOLERANCES[1:-1]
    samples, command = 60, 500.0
    commands = np.full(samples, command)
    reference = ours(commands, PERIOD_S, DEFAULT_SUBSTEP_S / FINER)
    mine = points({h: partial(ours, commands, PERIOD_S, h) for h in SUBSTEPS_S}, reference,
                  3 if quick else 30, samples * PERIOD_S)
    curve = points({each: partial(by_control, command, PERIOD_S, samples, each)
                    for each in tolerances}, reference, 1 if quick else 3, samples * PERIOD_S)
    default = mine[SUBSTEPS_S.index(DEFAULT_SUBSTEP_S)]
    ratio = seconds_at(default.error, curve) / default.seconds
    return [*curve_results('control', 'python-control (one step)', curve),
            Result('rivals.control.ratio', 'times as long, one step of the command at our default '
                   f'error ({100.0 * default.error:.2g} %)', default.seconds,
                   's for a simulated second', 0.0, 'python-control, LSODA', ratio)]


def mass_on_a_spring(quick: bool) -> list[Result]:
    """Return ours against MuJoCo, for what both can state."""
    def mine(substep_s: float) -> Array:
        return simulate(as_record(MUJOCO | {'maximum_substep': substep_s}), COMMANDS,
                        PERIOD_S).position_m

    simulated_s = STEPS * PERIOD_S
    reference = mine(DEFAULT_SUBSTEP_S / FINER)
    rounds = 3 if quick else 30
    own = points({h: partial(mine, h) for h in SUBSTEPS_S}, reference, rounds, simulated_s)
    counts = {h: round(PERIOD_S / h) for h in (*SUBSTEPS_S, 1e-6)}
    curve = points({h: partial(by_mujoco, mujoco_model(PERIOD_S / count), COMMANDS, count)
                    for h, count in counts.items()}, reference, rounds, simulated_s)
    default = own[SUBSTEPS_S.index(DEFAULT_SUBSTEP_S)]
    same_step = curve[SUBSTEPS_S.index(DEFAULT_SUBSTEP_S)]
    return [Result('rivals.mujoco.ratio', 'times as long, a lag and a mass on a spring, at the '
                   f'same step (errors {default.error:.1g} ours, {same_step.error:.1g} its)',
                   default.seconds, 's for a simulated second', 0.0, 'MuJoCo, implicitfast',
                   same_step.seconds / default.seconds),
            *curve_results('mujoco', 'MuJoCo (lag and mass)', curve),
            *curve_results('mujoco_ours', 'ours (lag and mass)', own)]


def measure(quick: bool) -> list[Result]:
    """Return ours against each rival."""
    return [*held_commands(quick), *one_step(quick), *mass_on_a_spring(quick)]


if __name__ == '__main__':
    show(measure('--quick' in sys.argv))
