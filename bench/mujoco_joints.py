"""
`python -m bench.mujoco_joints [--machines 50 --seed 0]`: joints of MuJoCo, diagnosed.

Arms under a torque from a PD loop, with an encoder, simulated by an independent engine: half of
them have gravity, and the diagnosis has no model of them. Each has one cause: friction, backlash
or a spring between motor and arm, a delayed or lagging torque, a push, or one outside the
vocabulary (ripple, quadratic drag, a soft stop). It needs the extra: pip install -e '.[mujoco]'.
"""

import argparse
import itertools
import json
import math
import warnings
from typing import Any, Final, NamedTuple

import numpy as np

from asi_analysis import parallel
from asi_analysis.arrays import Array
from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError, InputWarning
from asi_analysis.gap.diagnose import diagnose
from asi_analysis.gap.model.effects import UNKNOWN

OUTSIDE: Final = ('ripple', 'drag', 'soft_stop')
CAUSES: Final = ('none', 'coulomb_friction', 'backlash', 'load_compliance', 'transport_delay',
                 'valve_lag', 'disturbance_force', *OUTSIDE)
STEP_S, DURATION_S, WEIGHT = 2e-4, 12.0, 9.81
CONFIDENT: Final = 0.9


class Machine(NamedTuple):
    """A joint: its course and the sizes of its parts, 0 where it has none; SI units."""

    cause: str
    rate_hz: int
    course: Array          # rad
    rotor: float           # kg m2, of the motor
    mass: float            # kg, of the arm
    length: float          # m
    damping: float         # N m s/rad
    weighs: bool
    loop: float            # rad/s, bandwidth of the PD loop
    encoder: float         # rad, resolution
    force: float           # N m, largest torque of the course
    size: float            # of the cause, in its unit
    at: float              # where it acts: frequency Hz or 0 (a pulse), teeth, rad

    @property
    def inertia(self) -> float:
        """Return the inertia of motor and arm."""
        return self.rotor + self.mass * self.length ** 2


def course_of(kind: str, rng: np.random.Generator, time: Array) -> Array:
    """Return a course of a kind, between -1 and 1."""
    if kind == 'multisine':
        course = sum(np.sin(2.0 * np.pi * f * time + rng.uniform(0.0, 2.0 * np.pi)) / f ** 0.5
                     for f in np.geomspace(0.2, rng.uniform(3.0, 8.0), 12))
    elif kind == 'chirp':
        rate = np.geomspace(0.15, rng.uniform(3.0, 7.0), time.size)
        course = np.sin(2.0 * np.pi * np.cumsum(rate) * time[1])
    elif kind == 'triangle':
        course = np.arcsin(np.sin(2.0 * np.pi * rng.uniform(0.3, 0.8) * time))
    else:   # levels, smoothed
        held = rng.uniform(0.4, 1.2)
        levels = rng.uniform(-1.0, 1.0, int(time[-1] / held) + 1)
        course = levels[(time / held).astype(int)]
        keep = math.exp(-2.0 * np.pi * 6.0 * time[1])
        course = np.array(list(itertools.accumulate(
            course, lambda now, next_: keep * now + (1.0 - keep) * next_, initial=0.0)))[1:]
    return np.asarray(course / np.abs(course).max())


def draw(seed: int) -> Machine:
    """Return the machine of a seed."""
    rng = np.random.default_rng([seed, 99])
    cause = CAUSES[seed % len(CAUSES)]
    weighs = bool(rng.random() < 0.5)
    length, mass = rng.uniform(0.15, 0.5), rng.uniform(0.3, 3.0)
    arm = mass * length ** 2
    rotor = max(10.0 ** rng.uniform(-3.0, -1.3),
                arm / 3.0 if cause in ('backlash', 'load_compliance') else 0.0)
    inertia = rotor + arm
    damping = inertia * rng.uniform(0.3, 3.0)
    rate = int(rng.choice([250, 500, 1000]))
    time = np.arange(int(DURATION_S * rate)) / rate
    reach = rng.uniform(0.2, 0.8)
    course = reach * course_of(str(rng.choice(['multisine', 'chirp', 'triangle', 'levels'])), rng,
                               time)
    loop = 2.0 * np.pi * rng.uniform(2.0, 5.0)
    speed = np.gradient(course, 1.0 / rate)
    takes = (inertia * np.gradient(speed, 1.0 / rate) + damping * speed
             + weighs * WEIGHT * mass * length * np.sin(course))
    force = float(np.quantile(np.abs(takes), 0.9))
    fast = float(np.quantile(np.abs(speed), 0.95))
    size = {
        'none': 0.0, 'coulomb_friction': force * rng.uniform(0.08, 0.4),
        'backlash': reach * rng.uniform(0.02, 0.12),
        'load_compliance': 0.3 * inertia * (2.0 * np.pi * rng.uniform(4.0, 15.0)) ** 2,
        'transport_delay': rng.uniform(0.005, min(0.04, 0.25 / loop)),
        'valve_lag': rng.uniform(0.008, min(0.05, 0.3 / loop)),
        'disturbance_force': force * rng.uniform(0.15, 0.5),
        'ripple': force * rng.uniform(0.1, 0.35),
        'drag': force * rng.uniform(0.2, 0.6) / fast ** 2,
        'soft_stop': 50.0 * inertia * (2.0 * np.pi * 3.0) ** 2}[cause]
    at = {'disturbance_force': float(rng.choice([0.0, rng.uniform(0.7, 6.0)])),
          'ripple': float(rng.integers(9, 30)), 'soft_stop': reach * rng.uniform(0.5, 0.8)}
    return Machine(cause, rate, course, rotor, mass, length, damping, weighs, loop,
                   2.0 * np.pi / 2.0 ** float(rng.choice([14, 16, 18])), force, size,
                   at.get(cause, 0.0))


def described(m: Machine) -> str:
    """Return a machine in MuJoCo's language."""
    arm = (f'<geom type="sphere" size="0.02" pos="0 0 {-m.length}" mass="{m.mass}" '
           'contype="0" conaffinity="0"/>')
    hinge = 'type="hinge" axis="0 1 0"'
    if m.cause in ('backlash', 'load_compliance'):
        reach = math.degrees(m.size)
        between, brake = ((f'limited="true" range="{-reach} {reach}" solreflimit="0.002 0.7" '
                           'solimplimit="0.99 0.999 0.0001"', 0.02 * m.inertia)
                          if m.cause == 'backlash' else
                          (f'stiffness="{m.size}"', 0.05 * math.sqrt(m.size * m.inertia)))
        arm = ('<geom type="sphere" size="0.01" mass="0.001" contype="0" conaffinity="0"/>'
               f'<body><joint {hinge} {between} damping="{brake}"/>{arm}</body>')
    friction = m.size if m.cause == 'coulomb_friction' else 0.0
    drive = (f'<general joint="motor" dyntype="filterexact" dynprm="{m.size}" gainprm="1"/>'
             if m.cause == 'valve_lag' else '<motor joint="motor"/>')
    return (f'<mujoco><option timestep="{STEP_S}" gravity="0 0 {-WEIGHT * m.weighs}" '
            f'integrator="implicitfast"/><worldbody><body><joint name="motor" {hinge} '
            f'armature="{m.rotor}" damping="{m.damping}" frictionloss="{friction}" '
            'solreffriction="0.0005 1" solimpfriction="0.999 0.9999 0.0001"/>'
            f'{arm}</body></worldbody><actuator>{drive}</actuator></mujoco>')


def push(m: Machine, time: float, angle: float, speed: float) -> float:
    """Return the torque of a cause that MuJoCo has no word for, N m."""
    if m.cause == 'disturbance_force':
        return (m.size * math.sin(2.0 * math.pi * m.at * time) if m.at else
                1.5 * m.size * (4.0 < time < 8.0))
    if m.cause == 'ripple':
        return m.size * math.sin(m.at * angle)
    if m.cause == 'drag':
        return -m.size * speed * abs(speed)
    if m.cause == 'soft_stop':
        return -m.size * math.copysign(max(abs(angle) - m.at, 0.0), angle)
    return 0.0


def recorded(m: Machine) -> Run:
    """Return the recording of a machine: torque from the loop, and position by the encoder."""
    import mujoco
    engine = mujoco.MjModel.from_xml_string(described(m))
    data = mujoco.MjData(engine)
    data.qpos[0] = m.course[0]
    late = round(m.size / STEP_S) if m.cause == 'transport_delay' else 0
    waiting = [0.0] * late
    command, position = np.zeros((2, m.course.size))
    last, rate = m.course[0], 0.0
    keep = math.exp(-2.0 * math.pi * 30.0 / m.rate_hz)
    for k, wanted in enumerate(m.course):
        position[k] = m.encoder * round(data.qpos[0] / m.encoder)
        rate = keep * rate + (1.0 - keep) * (position[k] - last) * m.rate_hz
        last = position[k]
        command[k] = (m.inertia * m.loop * (m.loop * (wanted - position[k]) - rate)
                      + m.weighs * WEIGHT * m.mass * m.length * math.sin(wanted))
        for _ in range(round(1.0 / (m.rate_hz * STEP_S))):
            waiting.append(command[k])
            data.ctrl[0] = waiting.pop(0)
            data.qfrc_applied[0] = push(m, data.time, data.qpos[0], data.qvel[0])
            mujoco.mj_step(engine, data)
    return Run(np.arange(m.course.size) / m.rate_hz, command_n=command, position_m=position,
               source=m.cause, information={'signals': {'command': 'Nm', 'position': 'rad'}})


def one(seed: int) -> dict[str, Any]:
    """Return what was found of the machine of a seed."""
    machine = draw(seed)
    with warnings.catch_warnings():
        warnings.simplefilter('ignore', InputWarning)
        try:
            found = diagnose([recorded(machine)], {}, 'joint')
        except InputError as error:
            return {'cause': machine.cause, 'verdict': 'refused', 'why': str(error),
                    'right': False, 'probability': 0.0}
    right = (UNKNOWN in found.verdict if machine.cause in OUTSIDE else
             found.verdict == (() if machine.cause == 'none' else (machine.cause,)))
    return {'seed': seed, 'cause': machine.cause, 'verdict': '+'.join(found.verdict) or 'no_gap',
            'right': right, 'probability': found.joined[found.verdict]}


def main() -> None:
    """Diagnose machines and print how often each cause is found."""
    parser = argparse.ArgumentParser(description=__doc__.partition('\n\n')[0])
    parser.add_argument('--machines', type=int, default=50)
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--jobs', type=int, default=2)
    parser.add_argument('--rows', action='store_true', help='print each machine as JSON, too')
    given = parser.parse_args()
    with parallel.workers(given.jobs):
        rows = list(parallel.each(one, ((given.seed + n,) for n in range(given.machines))))
    for row in rows if given.rows else ():
        print(json.dumps(row))
    for cause in CAUSES:
        own = [row for row in rows if row['cause'] == cause]
        print(f'{cause}: {sum(row["right"] for row in own)} of {len(own)}')
    wrong = sum(not row['right'] and row['probability'] >= CONFIDENT for row in rows)
    print(f'wrong with {CONFIDENT:g} or more: {wrong} of {len(rows)}')


if __name__ == '__main__':
    main()
