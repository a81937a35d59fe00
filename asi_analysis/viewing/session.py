"""What the pages of one `asi live` share, and what their buttons do."""

import asyncio
from typing import Any, Final

import numpy as np
from rclpy.exceptions import InvalidNamespaceException
from rclpy.validate_namespace import validate_namespace

from asi_actuator.model.effects import EFFECT
from asi_analysis.errors import InputError
from asi_analysis.experiments.running import free_directory
from asi_analysis.viewing.link import ACTUATOR, Link
from asi_analysis.viewing.processes import RUNS, NodeProcess
from asi_common.parameter import Value

CONTROLLER = 'asi_controller'
# In lock-step: a busy machine slows the simulation down, and nothing is lost.
SIMULATED: Final[dict[str, dict[str, Any]]] = {
    'controller': {'mode': 'lockstep', 'rate_hz': 1000.0},
    'actuator': {'mode': 'lockstep', 'rate_hz': 1000.0, 'real_time_factor': 1.0,
                 'give_up_after': 0.0}}


class Session:
    """
    The link to a loop, the processes started with it, and the effect put into the plant.

    effect: its name, '' for none; withheld: the parameters that it changed, as they were before.
    """

    def __init__(self, namespace: str = '', simulate: bool = False) -> None:
        """
        Join the loop in a namespace; simulate: start its nodes first.

        Raises InputError for a namespace that is none.
        """
        self.namespace = f'/{namespace.strip("/")}' if namespace.strip('/') else ''
        try:
            validate_namespace(self.namespace or '/')
        except InvalidNamespaceException as error:
            reason = str(error).splitlines()[0].partition(': ')[2].rstrip(':')
            raise InputError(f'namespace {namespace!r} is not allowed: {reason}') from None
        self.nodes = [NodeProcess(name, self.namespace, **parameters)
                      for name, parameters in SIMULATED.items()] if simulate else []
        self.link = Link(self.namespace)
        self.recorder: NodeProcess | None = None
        self.bag = RUNS
        self._one_at_a_time = asyncio.Lock()
        self.withheld: dict[str, Any] = {}
        self.effect = ''
        self.hidden = False

    def end_nodes(self) -> None:
        """Let the processes that were started end, all at once; does not wait for that."""
        for node in self._started():
            node.end()

    def close(self) -> None:
        """Leave the loop, end the processes that were started, and wait for that."""
        self.end_nodes()
        self.link.close()
        for node in self._started():
            node.wait()

    def _started(self) -> list[NodeProcess]:
        return [*([self.recorder] if self.recorder else []), *self.nodes]

    @property
    def nominal(self) -> dict[str, dict[str, Any]]:
        """The parameters by node, those of the actuator without the effect."""
        return {node: values | (self.withheld if node == ACTUATOR else {})
                for node, values in self.link.values.items()}

    @property
    def shown(self) -> dict[str, dict[str, Any]]:
        """The parameters by node; a hidden effect is not among them."""
        return self.nominal if self.hidden else self.link.values

    async def read(self, node: str) -> None:
        """Read a node's parameters; an actuator that was started again has no effect."""
        await self.link.read(node)
        if node == ACTUATOR and self.withheld.items() <= self.link.values[node].items():
            self.withheld, self.effect, self.hidden = {}, '', False

    async def change(self, node: str, name: str, value: Any) -> None:
        """Set a parameter because the user means it so."""
        await self.link.set(node, {name: value})
        if node == ACTUATOR and name in self.withheld:
            self.withheld[name] = value

    async def inject(self, effect: str, hidden: bool) -> None:
        """Give the actuator an effect, in place of the last one; '' for none."""
        async with self._one_at_a_time:
            if ACTUATOR not in self.link.values:
                await self.read(ACTUATOR)
            given: dict[str, Value] = dict(EFFECT[effect].example) if effect else {}
            before = {name: self.nominal[ACTUATOR][name] for name in given}
            await self.link.set(ACTUATOR, self.withheld | given)
            self.withheld, self.effect, self.hidden = before, effect, hidden

    async def step(self, to_n: float) -> None:
        """Have the reference step from where it is."""
        run = self.link.recent.run(0.1)
        from_n = 0.0
        if run is not None and run.reference_n is not None:
            from_n = float(np.append(0.0, run.reference_n[np.isfinite(run.reference_n)])[-1])
        await self.link.set(CONTROLLER, {
            'reference.shape': 'step', 'reference.offset': from_n,
            'reference.amplitude': to_n - from_n})

    async def record(self) -> str:
        """Start the recorder, or end it; return what happened."""
        if self.recorder is None:
            RUNS.mkdir(exist_ok=True)
            self.bag = free_directory(RUNS, 'recording')
            self.recorder = NodeProcess('recorder', self.namespace, output=self.bag)
            return f'recording to {self.bag}'
        recorder, self.recorder = self.recorder, None
        recorder.end()
        await asyncio.to_thread(recorder.wait)
        return f'recorded: {self.bag}'
