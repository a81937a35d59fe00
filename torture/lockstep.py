"""Lock-step disturbed in every way: the run must be the same, bit for bit."""

import time
from typing import Any, Final

import numpy as np
from geometry_msgs.msg import WrenchStamped
from rosgraph_msgs.msg import Clock
from std_srvs.srv import SetBool, Trigger

from asi_actuator.model.actuator import measure, rest, step
from asi_actuator.parameters import as_record
from asi_analysis.bags.bag import read_bag
from asi_analysis.bags.run import Run
from asi_analysis.loop.closed_loop import simulate_loop
from asi_common.node.topics import nanoseconds, set_time
from torture.rig import ACTUATOR, CONTROLLER, RECORDER, NodeProcess, Rig, Tally, is_alive, pause

DURATION_S: Final = 0.4
RATE_HZ: Final = 5000.0
SIDES: Final = ('left', 'right')


def lockstep(rig: Rig, tally: Tally, end: float) -> None:
    """Two loops in two namespaces side by side, disturbed while they run."""
    states = {side: rig.states(f'/{side}/joint_states') for side in SIDES}
    clocks = {side: rig.node.create_publisher(Clock, f'/{side}/clock', 10) for side in SIDES}
    commands = {side: rig.node.create_publisher(WrenchStamped, f'/{side}/valve_command', 10)
                for side in SIDES}
    while time.monotonic() < end or not tally.tried:
        physics = {side: {'force_sensor.noise': 0.7,
                          'force_sensor.noise_seed': rig.random.randrange(2**31)}
                   for side in SIDES}
        control = {side: {'reference.shape': 'step', 'reference.start': 0.01,
                          'reference.amplitude': rig.random.uniform(10.0, 500.0)}
                   for side in SIDES}
        actuators, controllers = {}, {}
        for side in SIDES:
            states[side].clear()
            namespace = ('-r', f'__ns:=/{side}')
            controllers[side] = rig.start(CONTROLLER, *namespace, **control[side])
            actuators[side] = rig.start(ACTUATOR, *namespace, duration=DURATION_S,
                                        resend_after=0.02, give_up_after=60.0, **physics[side])
        faults = 0
        while any(is_alive(process) for process in actuators.values()):
            side = rig.random.choice(SIDES)
            _disturb(rig, side, actuators[side], controllers[side], clocks[side],
                     commands[side])
            faults += 1
        for side in SIDES:
            # Each loop counts as one fault more: it is disturbed by the other one.
            expected = simulate_loop(physics[side], control[side], DURATION_S, RATE_HZ)
            tally.count(side, _difference(actuators[side], states[side], expected.force_n, tally),
                        1 + faults // 2)
            controllers[side].stop()
        resets, problem = _reset_in_mid_run(rig)
        tally.count('reset', problem, resets + 1)
        tally.notes['resets in mid-run'] = tally.notes.get('resets in mid-run', 0) + resets
        if tally.failures:
            return


def _reset_in_mid_run(rig: Rig) -> tuple[int, str]:
    """Pause, reset and resume a recorded run; return how often, and what is wrong in its bag."""
    physics = {'force_sensor.noise': 0.7, 'force_sensor.noise_seed': rig.random.randrange(2**31)}
    bag = rig.folder / f'bag-{time.monotonic_ns()}'
    recorder = rig.start(RECORDER, output=bag)
    controller = rig.start(CONTROLLER, await_recorder=True, **{'reference.shape': 'prbs'})
    actuator = rig.start(ACTUATOR, await_recorder=True, duration=DURATION_S, resend_after=0.02,
                         give_up_after=60.0, **physics)
    pauses = rig.node.create_client(SetBool, '/asi_actuator/pause')
    resets = rig.node.create_client(Trigger, '/asi_actuator/reset')
    while is_alive(actuator):
        for client, request in ((pauses, SetBool.Request(data=True)), (resets, Trigger.Request()),
                                (pauses, SetBool.Request(data=False))):
            if client.service_is_ready():
                client.call_async(request)
            time.sleep(rig.random.uniform(0.0, 0.05))
    statuses = [actuator.exit_status(), recorder.stop(), controller.stop()]
    if any(statuses):
        return 0, f'exit statuses {statuses}: {actuator.text[-300:]}'
    return _explained(read_bag(bag), as_record(physics), actuator.text.count('reset: enabled'))


def _explained(run: Run, p: np.void, requested: int) -> tuple[int, str]:
    """Return how often the recorded model was reset, and the first state that is wrong."""
    signals = [run.signal(name) for name in ('force', 'valve_position', 'position', 'velocity')]
    state, resets = rest(), 0
    measure(state, p)
    for k, command in enumerate(run.signal('command')[:-1]):
        recorded = tuple(signal[k + 1] for signal in signals)
        step(state, command, p, 1.0 / RATE_HZ)
        if measure(state, p) != recorded:
            resets, state = resets + 1, rest()
            step(state, command, p, 1.0 / RATE_HZ)
            if resets > requested or measure(state, p) != recorded:
                return resets, f'state {k + 2} is neither the next nor the first after a reset'
    missing = round(DURATION_S * RATE_HZ) - len(run)
    return resets, f'{missing} states are missing' if missing else ''


def _disturb(rig: Rig, side: str, actuator: NodeProcess, controller: NodeProcess, clocks: Any,
             commands: Any) -> None:
    """Disturb the loop once, in a way that must not change the run."""
    stamp_ns = rig.random.choice((0, 10**6, 10**9, 10**18, rig.random.randrange(10**9)))
    kind = rig.random.randrange(5)
    if kind == 0 and is_alive(actuator):
        pause(actuator, 0.1)
    elif kind == 1:
        pause(controller, 0.1)
    elif kind == 2:
        for held in (True, False):
            client = rig.node.create_client(SetBool, f'/{side}/asi_actuator/pause')
            if client.service_is_ready():
                client.call_async(SetBool.Request(data=held))
            time.sleep(0.05)
    elif kind == 3:
        message = Clock()
        set_time(message.clock, stamp_ns)
        clocks.publish(message)
    else:
        command = WrenchStamped()
        # Not a stamp of a state: those are multiples of 200 us.
        set_time(command.header.stamp, stamp_ns + 7)
        command.wrench.force.x = 1000.0
        commands.publish(command)
    time.sleep(0.02)


def _difference(actuator: NodeProcess, states: list[Any], expected: np.ndarray,
                tally: Tally) -> str:
    if actuator.exit_status() != 0:
        return f'ended with {actuator.exit_status()}: {actuator.text[-500:]}'
    heard = {nanoseconds(state.header.stamp): state.effort[0] for state in states}
    period_ns = round(1e9 / RATE_HZ)
    for k, force in enumerate(expected, 1):
        if k * period_ns not in heard:
            # This listener subscribed too late for it, or only this listener lost it.
            tally.samples_lost += 1
        elif heard[k * period_ns] != force:
            return f'state {k} is {heard[k * period_ns]!r}, expected {force!r}'
    return ''
