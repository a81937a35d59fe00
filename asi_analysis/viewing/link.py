"""The ROS side of the live page: subscribes to the loop, reads and sets its parameters."""

import asyncio
import threading
import time
from collections.abc import Mapping
from typing import Any, Final

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import ParameterDescriptor, ParameterEvent
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    ListParameters,
    SetParametersAtomically,
)
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import SetBool, Trigger

from asi_actuator.node_parameters import ACTUATOR_NODE_PARAMETERS
from asi_analysis.viewing.recent import HEARD, Recent, Taken
from asi_common.node.executor import LoopExecutor, Polled
from asi_common.node.ros_parameters import OF_EVERY_NODE
from asi_common.node.topics import message_class
from asi_common.topics import TOPICS
from asi_common.writable import choose_log_folder

NAME: Final = 'asi_live'
ACTUATOR: Final = 'asi_actuator'
NOT_OF_PLANT: Final = {parameter.name for parameter in ACTUATOR_NODE_PARAMETERS}
POLL_S: Final = 0.015
DEPTH: Final = 5000
# How long a node may take to answer, s; a busy machine is slow.
ANSWER_S: Final = 10.0


class LinkError(Exception):
    """A node has refused, or not answered; the text says which and why."""


class Link:
    """
    A node in a thread of its own.

    values: of each known node, its parameters by name; descriptors: theirs. diagnostics: of each
    status the last level and message, and when it came, s of the steady clock.
    """

    def __init__(self, namespace: str = '') -> None:
        """Join the loop in a namespace, in the ROS domain of the environment."""
        self.recent = Recent()
        self.values: dict[str, dict[str, Any]] = {}
        self.descriptors: dict[str, dict[str, ParameterDescriptor]] = {}
        self.diagnostics: dict[str, tuple[int, str, float]] = {}
        choose_log_folder()
        self._context = rclpy.Context()
        rclpy.init(args=[], context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        self._node = node = rclpy.create_node(
            NAME, context=self._context, namespace=namespace, start_parameter_services=False)
        self._clients: dict[str, Any] = {}
        # Best effort: a slow page loses messages, and never delays the loop.
        profile = QoSProfile(depth=DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT)
        self._heard = {name: node.create_subscription(
            message_class(TOPICS[name].type), name, lambda _: None, profile, raw=True,
            callback_group=Polled()) for name in HEARD}
        node.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)
        node.create_subscription(ParameterEvent, '/parameter_events', self._on_event, 100)
        node.create_timer(POLL_S, self._poll, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._executor = LoopExecutor(context=self._context)
        self._executor.add_node(node)
        self._thread = threading.Thread(target=self._executor.spin, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread and leave the loop."""
        self._executor.stopped = True
        self._thread.join()
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()

    def nodes(self) -> dict[str, set[bytes]]:
        """
        Return the other nodes in this namespace that have parameters, by name.

        With the ids of their publishers of parameter events: a node that was started again has
        another one.
        """
        own = self._node.get_namespace()
        served = {name for name, types in self._node.get_service_names_and_types()
                  if 'rcl_interfaces/srv/ListParameters' in types}
        found: dict[str, set[bytes]] = {}
        for each in self._node.get_publishers_info_by_topic('/parameter_events'):
            if (each.node_namespace == own and each.node_name != NAME
                    and f'{own.rstrip("/")}/{each.node_name}/list_parameters' in served):
                found.setdefault(each.node_name, set()).add(bytes(each.endpoint_gid))
        return dict(sorted(found.items()))

    async def read(self, node: str) -> None:
        """Read all parameters of a node and their descriptors. Raises LinkError."""
        listed = await self._call(ListParameters, node, 'list_parameters')
        names = sorted(name for name in listed.result.names if not name.startswith(OF_EVERY_NODE))
        described = await self._call(DescribeParameters, node, 'describe_parameters', names=names)
        values = await self._call(GetParameters, node, 'get_parameters', names=names)
        self.descriptors[node] = dict(zip(names, described.descriptors, strict=True))
        self.values[node] = dict(zip(names, map(parameter_value_to_python, values.values),
                                     strict=True))

    async def set(self, node: str, values: Mapping[str, Any]) -> None:
        """Set parameters of a node, all or none. Raises LinkError with the node's reason."""
        answer = await self._call(
            SetParametersAtomically, node, 'set_parameters_atomically',
            parameters=[Parameter(name, value=value).to_parameter_msg()
                        for name, value in values.items()])
        if not answer.result.successful:
            raise LinkError(answer.result.reason)
        self.values.setdefault(node, {}).update(values)

    async def serve(self, node: str, service: str, data: bool | None = None) -> str:
        """Call a service of a node, SetBool or, without data, Trigger; return its message."""
        given = {} if data is None else {'data': data}
        answer = await self._call(Trigger if data is None else SetBool, node, service, **given)
        if not answer.success:
            raise LinkError(answer.message)
        return str(answer.message)

    async def _call(self, kind: Any, node: str, service: str, **request: Any) -> Any:
        name = f'{node}/{service}'
        if name not in self._clients:
            self._clients[name] = self._node.create_client(kind, name)
        client, end = self._clients[name], asyncio.get_running_loop().time() + ANSWER_S
        future = None
        while asyncio.get_running_loop().time() < end:
            if future is None and client.service_is_ready():
                future = client.call_async(kind.Request(**request))
            if future is not None and future.done():
                return future.result()
            await asyncio.sleep(0.01)
        raise LinkError(f'{name} has not answered within {ANSWER_S:g} s')

    def _poll(self) -> None:
        for name, subscription in self._heard.items():
            taken = []
            with subscription.handle:
                while (each := subscription.handle.take_message(subscription.msg_type, True)):
                    data, info = each
                    taken.append(Taken(data, info['publication_sequence_number'] or 0,
                                       info['source_timestamp']))
            if taken:
                self.recent.add(name, taken)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.diagnostics[status.name] = (int.from_bytes(status.level), status.message,
                                             time.monotonic())

    def _on_event(self, event: ParameterEvent) -> None:
        known = self.values.get(event.node.rpartition('/')[2])
        if known is not None and event.node.rpartition('/')[0] == (
                self._node.get_namespace().rstrip('/')):
            changed = {each.name: parameter_value_to_python(each.value)
                       for each in (*event.new_parameters, *event.changed_parameters)
                       if each.name in known}   # others are of a new node
            known |= changed
            if changed.keys() - NOT_OF_PLANT and event.node.endswith(f'/{ACTUATOR}'):
                self._poll()   # what has come is of the plant before
                self.recent.plant_changed()
