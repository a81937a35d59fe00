"""Processes killed, stopped for a while, or ended by a signal, at random moments."""

import signal
import struct
import time
from pathlib import Path
from typing import Final

from asi_analysis.bags.bag_file import read_contents
from asi_analysis.errors import InputError
from asi_common.node.topics import nanoseconds
from torture.rig import (
    ACTUATOR,
    CONTROLLER,
    NAP_S,
    PATIENCE_S,
    PEER,
    RECORDER,
    NodeProcess,
    NotThere,
    Rig,
    Tally,
    is_alive,
    until,
)
from torture.wire import Wire

SIGNALS: Final = (signal.SIGKILL, signal.SIGSTOP, signal.SIGTERM)
# The limits of this run, s: generous, since the machine is busy and they are not under test.
FIRMWARE_S: Final = 0.1
AGE_S: Final = 0.2
RATE_HZ: Final = 200.0
# After the limit the valve must be closed within two periods. A busy machine may add so much (s),
# beside the time for which it stalled; the table shows the actual time.
MACHINE_S: Final = 1.0
KILL_LOSES_S: Final = 1.0


class Loop:
    """The whole loop over the CAN bus, recorded."""

    def __init__(self, rig: Rig, recorded: bool = True):
        self.rig = rig
        self.wire = Wire(rig.folder)
        self.states = rig.states()
        self.bags = 0
        self.processes: dict[str, NodeProcess] = {}
        self.names = ('peer', 'actuator', 'controller', *(['recorder'] if recorded else []))
        for name in self.names:
            self.start(name)

    def start(self, name: str) -> None:
        realtime = {'mode': 'realtime', 'rate_hz': RATE_HZ}
        if name == 'peer':
            process = self.rig.start(
                PEER, '--interface', 'slcan', '--channel', str(self.wire.peer),
                '--command-timeout', str(FIRMWARE_S), '--set', 'force_sensor.noise=0.5')
        elif name == 'actuator':
            process = self.rig.start(
                ACTUATOR, **realtime, driver='can', command_timeout=AGE_S,
                await_recorder='recorder' in self.names,
                **{'can.interface': 'slcan', 'can.channel': self.wire.node,
                   'limit.state_age': AGE_S, 'limit.lost_states': 10**6})
        elif name == 'controller':
            process = self.rig.start(
                CONTROLLER, **realtime, gain=1.0, **{
                    'reference.shape': 'sine', 'reference.amplitude': 100.0,
                    'reference.frequency': 2.0})
        else:
            self.bags += 1
            process = self.rig.start(RECORDER, output=self.bag)
        self.processes[name] = process

    @property
    def bag(self) -> Path:
        return self.rig.folder / f'bag-{self.bags}'

    def run(self) -> None:
        """
        Start what is dead, reset what is in fault; wait until the valve is driven.

        And, if the loop is recorded, until that is recorded.
        """
        begin_ns = time.time_ns()
        self._stood_still_s = self.rig.stood_still_s
        for name, process in self.processes.items():
            if not is_alive(process):
                self.start(name)
        count = len(self.states)
        until(lambda: len(self.states) > count, 'a state')
        end = time.monotonic() + PATIENCE_S
        while not self.wire.driven():
            if time.monotonic() > end:
                raise NotThere(f'the loop does not run: {self.rig.diagnostics}')
            self.rig.enable()
            time.sleep(0.3)
        if 'recorder' in self.names:
            until(lambda: max(self.stamps_in_bag(), default=0) > begin_ns, 'a recorded state')

    def machine_s(self) -> float:
        """Return what the machine may have added to a time since run(), s."""
        time.sleep(2.0 * NAP_S)  # until a stall that is not over yet has been counted
        return MACHINE_S + self.rig.stood_still_s - self._stood_still_s

    def stamps_in_bag(self) -> list[int]:
        try:
            topics = read_contents(self.bag, lambda name: name == '/joint_states').topics
        except InputError:
            return []  # nothing is written yet
        if '/joint_states' not in topics:
            return []
        # A CDR message begins with 4 bytes of its own, this one goes on with its stamp.
        stamps = [struct.unpack_from('<4xiI', data) for data in topics['/joint_states'].data]
        return [seconds * 10**9 + rest for seconds, rest in stamps]

    def lost(self) -> int:
        """Return how many states are not in the bag that came while it was recorded."""
        recorded = self.stamps_in_bag()
        if not recorded:
            return 0
        heard = {nanoseconds(state.header.stamp) for state in self.states}
        return len({stamp for stamp in heard if recorded[0] <= stamp <= recorded[-1]}
                   - set(recorded))


def processes(rig: Rig, tally: Tally, end: float) -> None:
    """Each process with each signal, in random order, again and again."""
    loop = Loop(rig)
    choices = [(name, number) for name in loop.processes for number in SIGNALS]
    left: list[tuple[str, signal.Signals]] = []
    try:
        while time.monotonic() < end or not tally.tried:
            left = left or rig.random.sample(choices, len(choices))
            name, number = left.pop()
            what = f'{number.name} to {name}'
            try:
                loop.run()
                time.sleep(rig.random.uniform(0.0, 0.3))
                tally.count(what, _break(loop, name, number, tally))
                if not is_alive(loop.processes['recorder']):
                    tally.samples_lost += loop.lost()
            except NotThere as error:
                tally.count(what, f'{error}; ' + '; '.join(
                    f'{name} ({process.poll()}): {process.text[-200:]}'
                    for name, process in loop.processes.items()))
            if trace := rig.tracebacks():
                tally.failures.append(f'{what}: {trace}')
                return
    finally:
        loop.wire.close()


def _break(loop: Loop, name: str, number: signal.Signals, tally: Tally) -> str:
    """Send a signal to a process; return what went wrong."""
    process, wire = loop.processes[name], loop.wire
    heard = len(loop.states)
    wire.mark()
    hit_ns = time.time_ns()
    process.send(number)
    problem = ''
    if name == 'recorder':
        # The loop does not depend on its subscribers.
        until(lambda: len(loop.states) > heard + RATE_HZ / 2, 'states without a recorder')
    else:
        # An actuator that is killed or stopped cannot report that its valve is closed.
        shut = ((lambda: wire.shut_commanded_s) if name == 'peer' else (lambda: wire.shut_s))
        tally.zero_s.append(until(lambda: shut() is not None and shut(),
                                  'the valve to be shut', PATIENCE_S))
        limit = AGE_S + FIRMWARE_S + 2.0 / RATE_HZ + loop.machine_s()
        if tally.zero_s[-1] > limit:
            problem = f'the valve was shut after {tally.zero_s[-1]:.3f} s, not {limit:g} s'
    if number == signal.SIGSTOP:
        process.send(signal.SIGCONT)
        time.sleep(0.1)
        # The actuator may lose its bus when the terminal is full; all others continue.
        return problem or ('' if is_alive(process) else f'has ended: {process.text[-300:]}')
    status = process.exit_status()
    # A recorder that has lost messages exits with 1; these are counted separately.
    if number == signal.SIGTERM and status != 0 and 'were lost' not in process.text:
        return f'exit status {status}: {process.text[-300:]}'
    if name == 'recorder':
        missing_s = (hit_ns - max(loop.stamps_in_bag(), default=0)) * 1e-9
        tally.notes['recording lost (s), worst'] = max(
            tally.notes.get('recording lost (s), worst', 0.0), missing_s)
        if missing_s > KILL_LOSES_S + loop.machine_s():
            return f'the bag ends {missing_s:.2f} s before'
    return problem
