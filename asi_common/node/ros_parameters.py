"""
A table of parameters as ROS parameters: the same for every node.

The on-set callback checks a whole set and changes nothing; the post-set callback applies it.
"""

import math
from collections.abc import Callable, Mapping

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import ParameterNotDeclaredException
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from asi_common.node.topics import QOS_OVERRIDES, check_qos_override
from asi_common.parameter import Parameter, ParameterError, Value, completed, is_number
from asi_common.parameter_file import read_scalar

# What rclpy declares by itself.
OF_EVERY_NODE = ('use_sim_time', 'start_type_description_service', QOS_OVERRIDES)


def descriptor(parameter: Parameter) -> ParameterDescriptor:
    """Return the ROS descriptor of a parameter."""
    unit = f' [{parameter.unit}]' if parameter.unit else ''
    source = f'; source: {parameter.source}' if parameter.source else ''
    # Typed dynamically so that a wrong type comes to our own check, whose reason says what is
    # allowed; rclpy's does not even name the parameter.
    result = ParameterDescriptor(
        name=parameter.name, description=parameter.description + unit + source,
        additional_constraints=parameter.allowed, read_only=parameter.read_only,
        dynamic_typing=True)
    # A step of a float would have rclpy refuse all values between.
    if isinstance(parameter.default, float):
        result.floating_point_range = [FloatingPointRange(
            from_value=float(parameter.low), to_value=float(parameter.high))]
    elif isinstance(parameter.default, int) and not isinstance(parameter.default, bool):
        result.integer_range = [IntegerRange(
            from_value=int(parameter.low), to_value=int(parameter.high), step=1)]
    return result


def take_overrides(node: Node) -> dict[str, RosParameter]:
    """
    Return and undeclare what YAML file and command line gave, by name; QoS overrides are checked.

    The node was made with automatically_declare... from overrides. Raises ParameterError.
    """
    given = {name: node.get_parameter(name) for name in node.get_parameters_by_prefix('')}
    for name, parameter in given.items():
        if name.startswith(QOS_OVERRIDES):
            check_qos_override(node, name, parameter.value)
            # Publisher or subscription declares it anew, as read-only.
            node.undeclare_parameter(name)
    given = {name: parameter for name, parameter in given.items()
             if not name.startswith(OF_EVERY_NODE)}
    for name in given:
        node.undeclare_parameter(name)
    return given


class RosParameters:
    """The parameters of a node: `values`, by name, always complete and allowed."""

    def __init__(self, node: Node, table: tuple[Parameter, ...],
                 check: Callable[[Mapping[str, Value]], object] = lambda values: None):
        """
        Declare a table on a node that was made with automatically_declare... from overrides.

        check(values) raises ParameterError for a combination that is not allowed. Raises
        ParameterError if the YAML file or the command line gave something that is not allowed.
        """
        self._node = node
        self._table = {parameter.name: parameter for parameter in table}
        self._check = check
        self._apply: Callable[[set[str]], None] = lambda changed: None
        given = {name: self._typed(each).value for name, each in take_overrides(node).items()}
        self.values = completed(given, table)
        check(self.values)
        node.declare_parameters(
            '', [(p.name, self.values[p.name], descriptor(p)) for p in table],
            ignore_override=True)
        node.add_pre_set_parameters_callback(self._pre_set)
        node.add_on_set_parameters_callback(self._on_set)
        node.add_post_set_parameters_callback(self._post_set)

    def when_changed(self, apply: Callable[[set[str]], None]) -> None:
        """Call apply(names) after each change, when `values` holds the new ones."""
        self._apply = apply

    def _typed(self, given: RosParameter) -> RosParameter:
        """Return a parameter, an integer converted where a float is meant: users type 8."""
        wanted = self._table.get(given.name)
        if (wanted is not None and isinstance(wanted.default, float)
                and given.type_ == RosParameter.Type.INTEGER):
            return RosParameter(given.name, RosParameter.Type.DOUBLE, float(given.value))
        return given

    def _number(self, given: RosParameter) -> RosParameter:
        """
        Return a text that is a number as one, where a float is meant.

        `ros2 param set` and `ros2 param load` read numbers by YAML 1.1, for which 1e-05 is a text;
        load sends 1.0e-05, as `ros2 param dump` writes it, as this text too.
        """
        wanted = self._table.get(given.name)
        if (wanted is not None and isinstance(wanted.default, float)
                and given.type_ == RosParameter.Type.STRING):
            number = read_scalar(given.value)
            if is_number(number) and math.isfinite(number):
                return RosParameter(given.name, RosParameter.Type.DOUBLE, float(number))
        return given

    def _pre_set(self, given: list[RosParameter]) -> list[RosParameter]:
        unknown = [p.name for p in given if not self._node.has_parameter(p.name)]
        given = [self._typed(self._number(parameter)) for parameter in given]
        for reason in filter(None, map(self._problem, given)):
            self._refused(reason)
        if unknown:
            # rclpy would raise the same but forget the names.
            raise ParameterNotDeclaredException(unknown)
        return given

    def _problem(self, given: RosParameter) -> str | None:
        """Return why a single value is refused, by us or before that by rclpy; None if not."""
        wanted = self._table.get(given.name)
        if wanted is None:
            return None if self._node.has_parameter(given.name) else (
                f'{given.name} is not a parameter')
        if wanted.read_only:
            return f'{given.name} = {given.value!r}: it is fixed while the node runs'
        return wanted.problem(given.value)

    def _on_set(self, given: list[RosParameter]) -> SetParametersResult:
        new = {p.name: p.value for p in given if p.name in self._table}
        for name in new:
            # Dynamic typing has put the type of the value here, even if it is refused.
            self._node.describe_parameter(name).type = self._node.get_parameter(name).type_.value
        try:
            self._check(completed(self.values | new, tuple(self._table.values())))
        except ParameterError as error:
            if not any(map(self._problem, given)):
                self._refused(str(error))
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _post_set(self, given: list[RosParameter]) -> None:
        new = {p.name: p.value for p in given if p.name in self._table}
        if new:
            self.values = self.values | new
            for name, value in new.items():
                self._node.get_logger().info(f'{name} = {value!r}')
            self._apply(set(new))

    def _refused(self, reason: str) -> None:
        self._node.get_logger().warning(f'refused: {reason}')
