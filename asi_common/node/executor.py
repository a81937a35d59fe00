"""How every node is run: its executor, its signals, its exit status."""

import faulthandler
import gc
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, MutableMapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

import rclpy
from rclpy.callback_groups import CallbackGroup, MutuallyExclusiveCallbackGroup
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.guard_condition import GuardCondition
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from rclpy.timer import Timer
from rclpy.utilities import remove_ros_args

from asi_common.executable import end_by_signal, end_while_compiling
from asi_common.node.parameter_files import unused_files
from asi_common.node.priority import prefer
from asi_common.parameter import ParameterError
from asi_common.signals import SIGNALS, end_quietly
from asi_common.writable import choose_log_folder

# Longest wait of services, parameters, unhurried timers and new entities; and of events of the
# middleware. Twice as long if the loop has no timer.
SERVICE_PERIOD_NS: Final = 10_000_000
EVENT_PERIOD_NS: Final = 500_000_000
# Longest wait of a node after the system clock has been set back.
WAKE_PERIOD_S: Final = 0.02
# Longest wait of a node that ends until its last messages have been received: it takes 50 ms,
# unless a subscriber was killed, and even then Ctrl-C takes less than 2 s. After its own end a
# node waits for slow ones, until Fast DDS declares one that was killed dead (20 s).
LAST_MESSAGES_S: Final = 1.0
SLOW_SUBSCRIBER_S: Final = 30.0
# How long a signal waits for a node that is being made, so that the node leaves the graph: others
# see one that does not until Fast DDS declares it dead (20 s).
MAKING_S: Final = 1.0
# Longest time for a node to end, including the rest of a bag. Fast DDS 2.14 can deadlock with a
# callback if several nodes end at the same moment.
END_S = 60.0
PROFILES: Final = Path(__file__).parent
# With one of these the user has chosen who may reach a node.
CHOICES: Final = ('ROS_AUTOMATIC_DISCOVERY_RANGE', 'ROS_LOCALHOST_ONLY', 'ROS_STATIC_PEERS',
                  'ROS_DISCOVERY_SERVER', 'FASTRTPS_DEFAULT_PROFILES_FILE')
HERE_ALONE: Final = ('reached from this machine alone: ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET opens '
                     'this node to the network (doc/how_to/security.md)')
USAGE: Final = ('a node takes ROS arguments only: --ros-args -p NAME:=VALUE --params-file FILE '
                '-r OLD:=NEW --log-level LEVEL; its parameters: doc/reference/parameters.md')


class RunError(Exception):
    """The run cannot go on; the text says why."""


class RunFinished(Exception):  # noqa: N818
    """The run has reached its end."""


class Unhurried(MutuallyExclusiveCallbackGroup):
    """Callback group of timers that are served between ticks, so that they delay none."""


class Polled(CallbackGroup):
    """
    Callback group of subscriptions that a timer polls.

    To wake up for a message costs more than to take it.
    """

    def can_execute(self, entity: Any) -> bool:
        return False

    def beginning_execution(self, entity: Any) -> bool:
        return False

    def ending_execution(self, entity: Any) -> None:
        pass


class LoopExecutor(SingleThreadedExecutor):
    """
    An executor for a loop of thousands of messages a second.

    rclpy's executor builds its wait set anew and makes a task for every message. This one keeps
    the wait set of subscriptions and timers and calls their callbacks (plain functions of the
    message, or without arguments) directly, which takes half the time (bench/loop_rate.py). All
    else is left to rclpy's own spin_once, which takes longer than a tick may be late. It is called
    only if a check every SERVICE_PERIOD_NS finds a service, client or task that needs it, and
    every EVENT_PERIOD_NS for the events of the middleware; both just after a tick of the loop's
    timer, when the next tick is farthest.
    """

    def __init__(self, context: Context | None = None) -> None:
        super().__init__(context=context)
        self.stopped = False
        self._awake = GuardCondition(None, None, self.context)

    def spin(self) -> None:
        """Serve the nodes until `stopped` is true or the context is shut down."""
        threading.Thread(target=self._wake, daemon=True).start()
        # The garbage collector need not traverse the objects of the start-up again and again.
        gc.freeze()
        while not self.stopped and self.context.ok():
            self.spin_once(timeout_sec=0.0)
            self._spin_loop(time.monotonic_ns() + EVENT_PERIOD_NS)

    def _wake(self) -> None:
        """
        End every wait after WAKE_PERIOD_S of the steady clock.

        Fast DDS, as built for wheels, waits until a time of the system clock. If that is set back
        by an hour, it waits for an hour, or until a message comes (`python -m torture clocks`).
        """
        while not self.stopped:
            self._awake.trigger()
            time.sleep(WAKE_PERIOD_S)

    def can_execute(self, entity: Any) -> bool:
        """Exclude from spin_once what the loop serves itself."""
        return not isinstance(entity, Subscription | Timer) and super().can_execute(entity)

    def _spin_loop(self, end_ns: int) -> None:
        """Serve subscriptions and timers until `end_ns`, or until spin_once is needed."""
        nodes = self.get_nodes()
        # A recorder's callback group keeps its subscriptions out: it polls them.
        subscriptions: list[Any] = [s for node in nodes for s in node.subscriptions
                                    if s.callback_group.can_execute(s)]
        every_timer: list[Any] = [t for node in nodes for t in node.timers]
        unhurried = [t for t in every_timer if isinstance(t.callback_group, Unhurried)]
        timers = [t for t in every_timer if t not in unhurried]
        services: list[Any] = [s for node in nodes for s in node.services]
        clients: list[Any] = [c for node in nodes for c in node.clients]
        context: Any = self.context.handle
        with ExitStack() as in_use:
            for entity in (*subscriptions, *every_timer, *services, *clients, self._guard,
                           self._awake):
                in_use.enter_context(entity.handle)
            in_use.enter_context(context)
            fast = rclpy_implementation.WaitSet(
                len(subscriptions), 1, len(timers), 0, 0, 0, context)
            slow = rclpy_implementation.WaitSet(
                0, 1, 0, len(clients), len(services), 0, context)
            while not self.stopped and (now_ns := time.monotonic_ns()) < end_ns:
                self._serve(fast, subscriptions, timers, now_ns + SERVICE_PERIOD_NS)
                for timer in unhurried:
                    if timer.handle.is_timer_ready():
                        timer.handle.call_timer()
                        timer.callback()
                # A task: what rclpy does with the answer of a service.
                if self._tasks or self._requested(slow, services, clients):
                    return

    def _serve(self, wait_set: Any, subscriptions: list[Any], timers: list[Any],
               end_ns: int) -> None:
        """Call the callbacks of subscriptions and timers until the first tick after `end_ns`."""
        # Attributes are looked up once instead of in every tick.
        heard = [(s.handle, s.handle.pointer, s.msg_type, s.raw, s.callback)
                 for s in subscriptions]
        timed = [(t.handle, t.callback) for t in timers]
        entities = ([(wait_set.add_subscription, handle) for handle, *_ in heard]
                    + [(wait_set.add_timer, handle) for handle, _ in timed]
                    + [(wait_set.add_guard_condition, self._awake.handle)])
        ticked = False
        while (not self.stopped and (left_ns := end_ns - time.monotonic_ns())
               > (0 if ticked else -SERVICE_PERIOD_NS)):
            wait_set.clear_entities()
            for add, entity in entities:
                add(entity)
            wait_set.wait(left_ns + SERVICE_PERIOD_NS)
            ready = wait_set.get_ready_entities('subscription')
            for handle, pointer, kind, raw, callback in heard:
                if pointer in ready:
                    taken = handle.take_message(kind, raw)
                    if taken is not None:
                        callback(taken[0])
            ticked = not timed
            # Checked one by one: a callback may have taken so long that a timer became ready.
            for handle, callback in timed:
                if handle.is_timer_ready():
                    handle.call_timer()
                    callback()
                    ticked = True

    def _requested(self, wait_set: Any, services: list[Any], clients: list[Any]) -> bool:
        """Return whether a service, a client, or a task or change of a node needs spin_once."""
        wait_set.clear_entities()
        for service in services:
            wait_set.add_service(service.handle)
        for client in clients:
            wait_set.add_client(client.handle)
        wait_set.add_guard_condition(self._guard.handle)
        wait_set.wait(0)
        return any(wait_set.get_ready_entities(kind)
                   for kind in ('service', 'client', 'guard_condition'))


def run_node(make_node: Callable[[], Node], at_once: bool = True) -> int:
    """
    Run a node until SIGINT, SIGTERM or its own end; return the exit status.

    at_once: a node that is being made has nothing to keep, so a signal waits for it for MAKING_S.
    0: stopped by a signal or finished (RunFinished); 1: the run failed (RunError); 2: a bad
    parameter or ROS argument. What went wrong is logged in one line.
    """
    try:
        return _run(make_node, at_once)
    finally:
        # `ros2 launch` passes on the Ctrl-C that a terminal has sent already; Python, which gives
        # up its own handlers at its end, would be killed by that.
        for number in SIGNALS:
            signal.signal(number, signal.SIG_IGN)


def _run(make_node: Callable[[], Node], at_once: bool) -> int:
    if at_once:
        end_quietly()
    choose_log_folder()
    rmw = rclpy.get_rmw_implementation_identifier()
    here_alone = stay_here(os.environ, rmw)
    unprotected = choose_transport(os.environ, rmw)
    try:
        # rclpy's own handlers would shut the context down in the middle of a callback.
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    except (RuntimeError, ValueError) as error:
        get_logger('asi').fatal(str(error).splitlines()[0])
        return 2
    if others := remove_ros_args()[1:]:
        if help_ := others[0] in ('-h', '--help'):
            print(USAGE)
        else:
            get_logger('asi').fatal(f'{others[0]!r} is not understood: {USAGE}')
        rclpy.try_shutdown()
        return 0 if help_ else 2
    executor = LoopExecutor()
    making = at_once

    def give_up() -> None:
        time.sleep(MAKING_S)
        if making:
            end_by_signal(0)

    def stop(*_: object) -> None:
        executor.stopped = True
        if making:
            threading.Thread(target=give_up, daemon=True).start()

    for number in SIGNALS:
        signal.signal(number, stop)
    made = end_while_compiling(SIGNALS, 0)
    try:
        node = make_node()
        warnings = unused_files(sys.argv, node.get_fully_qualified_name())
    except (ParameterError, rclpy_implementation.RCLError) as error:
        # RCLError: the middleware lacks a feature that the environment requests, such as security.
        get_logger('asi').fatal(' '.join(str(error).split()))
        rclpy.try_shutdown()
        return 2
    finally:
        making = False
        made()
    for warning in (*filter(None, [unprotected]), *warnings):
        node.get_logger().warning(warning)
    if here_alone:
        node.get_logger().info(HERE_ALONE)
    prefer(node)
    executor.add_node(node)
    finished = False
    try:
        executor.spin()
    except RunFinished:
        finished = True
    except RunError as error:
        node.get_logger().fatal(str(error))
        return 1
    finally:
        # A thread outside Python prints where the node hangs, and exits with status 1.
        faulthandler.dump_traceback_later(END_S, exit=True)
        _await_acknowledgement(node, lambda: finished and not executor.stopped)
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()
        faulthandler.cancel_dump_traceback_later()
    return 0


def stay_here(environment: MutableMapping[str, str], rmw: str) -> bool:
    """
    Set the range LOCALHOST unless the user has chosen one; return whether it was set.

    ROS's default is the local network, from which anybody could move the valve. With another
    middleware than Fast DDS that range does not keep them out, so there the default is left.
    """
    if not rmw.startswith('rmw_fastrtps') or any(map(environment.get, CHOICES)):
        return False
    environment['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    return True


def choose_transport(environment: MutableMapping[str, str], rmw: str) -> str:
    """
    Have Fast DDS use UDP alone, on this machine alone if it is asked to, and return a warning.

    environment: gets the profile, unless the user has one; rmw: the middleware's identifier. The
    warning says what ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST does not do here, '' for nothing.

    The shared memory of Fast DDS is guarded by locks. A killed process keeps them, and a loop that
    needs one then stands still for 2 s (doc/explanation/reliability.md). With the range LOCALHOST
    rmw_fastrtps adds shared memory whatever the profile says, and binds its sockets to all
    interfaces; so a profile replaces that range. ROS_LOCALHOST_ONLY=1, its older name, prevails
    over range and peers in rcl, and here.
    """
    if environment.get('ROS_LOCALHOST_ONLY') == '1':
        del environment['ROS_LOCALHOST_ONLY']
        environment['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
        environment.pop('ROS_STATIC_PEERS', None)
    local = environment.get('ROS_AUTOMATIC_DISCOVERY_RANGE') == 'LOCALHOST'
    if not rmw.startswith('rmw_fastrtps'):
        why = f'with {rmw}'
    elif 'FASTRTPS_DEFAULT_PROFILES_FILE' in environment:
        why = 'with FASTRTPS_DEFAULT_PROFILES_FILE'
    elif environment.get('ROS_STATIC_PEERS'):
        why = 'with ROS_STATIC_PEERS'
        environment['FASTRTPS_DEFAULT_PROFILES_FILE'] = str(PROFILES / 'fastdds.xml')
    else:
        why = ''
        if local:
            environment['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'SYSTEM_DEFAULT'
        environment['FASTRTPS_DEFAULT_PROFILES_FILE'] = str(
            PROFILES / ('fastdds_localhost.xml' if local else 'fastdds.xml'))
    return (f'{why} ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST limits whom this node looks for, not '
            'who may reach it: see doc/how_to/security.md') if local and why else ''


def _await_acknowledgement(node: Node, patient: Callable[[], bool]) -> None:
    """Wait until all published messages have been received, so that a recorder loses none."""
    begin = time.monotonic()
    for publisher in node.publishers:
        while not publisher.wait_for_all_acked(Duration(seconds=0.1)):
            if time.monotonic() - begin > (SLOW_SUBSCRIBER_S if patient() else LAST_MESSAGES_S):
                return
