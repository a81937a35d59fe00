"""Arbitrary parameter values, set through the services of running nodes."""

import time
from typing import Any, Final

from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st
from rcl_interfaces.srv import GetParameters, SetParameters, SetParametersAtomically
from rclpy.parameter import Parameter as RosParameter
from rclpy.parameter import parameter_value_to_python

from asi_common.parameter import Parameter
from doc.parameter_tables import NODES
from torture.rig import ACTUATOR, CONTROLLER, NotThere, Rig, Tally, is_alive, until

TABLES: Final = {node.node: {p.name: p for table in node.tables.values() for p in table}
                 for node in NODES}
EXAMPLES: Final = 10


def _values(parameter: Parameter) -> st.SearchStrategy[Any]:
    anything = st.one_of(
        st.booleans(), st.integers(-2**63, 2**63 - 1), st.floats(), st.text(max_size=10),
        st.lists(st.floats(), max_size=3), st.lists(st.booleans(), min_size=1, max_size=2))
    if parameter.choices:
        return st.sampled_from(parameter.choices) | anything
    if isinstance(parameter.default, float):
        return st.floats(max(parameter.low, -1e9), min(parameter.high, 1e9)) | anything
    return anything


def _sets(node: str) -> st.SearchStrategy[dict[str, Any]]:
    one = st.sampled_from(list(TABLES[node].values())).flatmap(
        lambda p: st.tuples(st.just(p.name), _values(p)))
    return st.lists(one, min_size=1, max_size=4).map(dict)


def parameters(rig: Rig, tally: Tally, end: float) -> None:
    """Set values one by one or all at once; what is held must be what the table allows."""
    nodes = {'asi_actuator': rig.start(ACTUATOR, mode='realtime', rate_hz=200.0),
             'asi_controller': rig.start(CONTROLLER, mode='realtime', rate_hz=200.0)}
    states = rig.states()
    until(lambda: len(states) > 10, 'the loop')

    @given(st.sampled_from(sorted(nodes)).flatmap(
        lambda node: st.tuples(st.just(node), _sets(node))), st.booleans())
    @settings(max_examples=EXAMPLES, deadline=None, database=None,
              phases=[Phase.generate], suppress_health_check=list(HealthCheck))
    def fuzz(chosen: tuple[str, dict[str, Any]], atomic: bool) -> None:
        node, new = chosen
        problem = _try(rig, node, new, atomic)
        if not is_alive(nodes[node]):
            problem = f'has ended: {nodes[node].text[-800:]}'
        tally.count(f'{node} {new}', problem, len(new))
        if problem:
            raise NotThere(problem)

    while time.monotonic() < end or not tally.tried:
        try:
            seed(rig.random.randrange(2**32))(fuzz)()
        except NotThere:
            return  # already counted
        count = len(states)
        until(lambda count=count: len(states) > count, 'the next state')
        if trace := rig.tracebacks():
            tally.failures.append(trace)
            return


def _held(rig: Rig, node: str) -> dict[str, Any]:
    names = list(TABLES[node])
    answer = rig.ask(GetParameters, f'/{node}/get_parameters', GetParameters.Request(names=names))
    return {name: parameter_value_to_python(value)
            for name, value in zip(names, answer.values, strict=True)}


def _try(rig: Rig, node: str, new: dict[str, Any], atomic: bool) -> str:
    """Set values; return what is wrong with the values that the node then has."""
    before = _held(rig, node)
    values = [RosParameter(name, value=value).to_parameter_msg() for name, value in new.items()]
    if atomic:
        answer = rig.ask(SetParametersAtomically, f'/{node}/set_parameters_atomically',
                         SetParametersAtomically.Request(parameters=values))
        taken = [answer.result.successful] * len(new)
    else:
        answer = rig.ask(SetParameters, f'/{node}/set_parameters',
                         SetParameters.Request(parameters=values))
        taken = [result.successful for result in answer.results]
    expected = before | {name: value for (name, value), ok in zip(new.items(), taken, strict=True)
                         if ok}
    held = _held(rig, node)
    for name, value in held.items():
        if reason := TABLES[node][name].problem(value):
            return f'the node has a value that is not allowed: {reason}'
        if value != expected[name]:
            return f'the node has {name} = {value!r}, expected {expected[name]!r}'
    return ''
