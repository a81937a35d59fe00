"""
`Experiment`: parameters, duration and mode of a run, from files, --set and options.

`running.py` runs it.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from asi_actuator import joint_parameters
from asi_actuator.node_parameters import ACTUATOR_NODE_PARAMETERS, PHYSICS
from asi_actuator.parameters import ACTUATOR_PARAMETERS
from asi_analysis.errors import InputError
from asi_analysis.versions import versions
from asi_common import parameter_file
from asi_common.loop_parameters import DEFAULT_RATE_HZ
from asi_common.parameter import Parameter, ParameterError, Value, completed, with_its_type
from asi_controller.parameters import (
    COMPENSATOR_PARAMETERS,
    CONTROLLER_NODE_PARAMETERS,
    REFERENCE_PARAMETERS,
)

CONTROLLER_PARAMETERS: Final = COMPENSATOR_PARAMETERS + REFERENCE_PARAMETERS
TABLES: Final = {'actuator': ACTUATOR_PARAMETERS, 'controller': CONTROLLER_PARAMETERS}
NODE_PARAMETERS: Final = frozenset(
    parameter.name for parameter in ACTUATOR_NODE_PARAMETERS + CONTROLLER_NODE_PARAMETERS)
# Of the watchdogs, limits as wide as they go.
WIDEST: Final = {p.name: p.high for p in ACTUATOR_NODE_PARAMETERS
                 if p.name in ('limit.force', 'limit.force_rate', 'limit.velocity')}
# Gain with which the command to a joint is the reference itself: 0 would be the compensator's own.
OPEN_LOOP: Final = 1e-12


@dataclass(frozen=True)
class Experiment:
    """
    An experiment: parameters by name, the others at their defaults.

    plant: what the actuator's node simulates, 'actuator' or 'joint'.
    """

    actuator: Mapping[str, Value] = field(default_factory=dict)
    controller: Mapping[str, Value] = field(default_factory=dict)
    duration_s: float = 1.0
    mode: str = 'lockstep'
    rate_hz: float = 0.0      # 0: the default of the mode
    plant: str = 'actuator'

    @property
    def control_rate_hz(self) -> float:
        """Control rate, Hz."""
        return self.rate_hz or DEFAULT_RATE_HZ[self.mode]

    @property
    def node_parameters(self) -> dict[str, Value]:
        """Parameters of the actuator's node that are not of the physics."""
        # The limits of the node are made for the actuator; a simulated joint may be of any size.
        plant: dict[str, Value] = {} if self.plant == 'actuator' else {
            'plant': self.plant, **WIDEST}
        return {'mode': self.mode, 'rate_hz': float(self.rate_hz),
                'duration': float(self.duration_s), **plant}

    @property
    def ticks(self) -> int:
        """Number of states that the actuator publishes."""
        return math.ceil(self.duration_s * self.control_rate_hz - 1e-9)


def checked(experiment: Experiment) -> Experiment:
    """Return the experiment with every parameter; raises InputError if one is not allowed."""
    try:
        from asi_controller.compensator import design, discretise
        from asi_controller.reference import check_frequencies
        completed(experiment.node_parameters, ACTUATOR_NODE_PARAMETERS)
        controller = completed(experiment.controller, CONTROLLER_PARAMETERS)
        rate_hz = experiment.control_rate_hz
        discretise(design({p.name: controller[p.name] for p in COMPENSATOR_PARAMETERS}, rate_hz),
                   rate_hz)
        check_frequencies(controller, rate_hz)
        complete = replace(experiment, controller=controller, actuator=completed(
            experiment.actuator, PHYSICS[experiment.plant]))
        if experiment.plant == 'joint':
            joint_parameters.check_delay(complete.actuator, 1.0 / complete.control_rate_hz)
    except ParameterError as error:
        raise InputError(str(error)) from None
    if complete.duration_s * complete.control_rate_hz < 1.0 - 1e-9:
        raise InputError(f'duration = {complete.duration_s:g} s is not allowed: it takes at least '
                         f'a period of {1.0 / complete.control_rate_hz:g} s')
    return complete


def planned(actuator: Mapping[str, Value], controller: Mapping[str, Value], duration_s: float,
            mode: str, rate_hz: float, plant: str = 'actuator') -> Experiment:
    """Return an experiment with every parameter; the reference is a step if none is given."""
    values = gather({}, [], {'actuator': actuator, 'controller': controller}, duration_s, plant)
    return checked(Experiment(values['actuator'], values['controller'], duration_s, mode, rate_hz,
                              plant))


def stepping(actuator: Mapping[str, Value], controller: Mapping[str, Value], *rates_hz: float
             ) -> dict[str, Value]:
    """
    Return the controller's parameters, with a step as reference by default.

    Raises InputError for a parameter of either that is not allowed at one of the rates.
    """
    if not rates_hz or 0.0 in rates_hz:
        raise InputError('a control rate is needed, above 0 Hz')
    controller = {'reference.shape': 'step', **controller}
    for rate in rates_hz:
        checked(Experiment(actuator, controller, 1.0, 'lockstep', rate))
    return controller


def table_of(which: str, plant: str = 'actuator') -> tuple[Parameter, ...]:
    """Return the table of 'actuator', of a plant, or 'controller'."""
    if which != 'actuator':
        return TABLES[which]
    if plant not in PHYSICS:
        raise InputError(f'plant = {plant!r} is not allowed: one of {", ".join(PHYSICS)}')
    return PHYSICS[plant]


def read_parameters(path: Path, which: str, plant: str = 'actuator') -> dict[str, Value]:
    """
    Return the parameters of a ROS parameter file for 'actuator' or 'controller', by dotted name.

    Parameters of the node alone, such as its mode, are left out: `asi run` sets them. Raises
    InputError if the file cannot be read or has nothing for the node.
    """
    try:
        values = parameter_file.read_parameters(path, f'asi_{which}')
    except ParameterError as error:
        raise InputError(str(error)) from None
    known = {parameter.name: parameter for parameter in table_of(which, plant)}
    return {name: with_its_type(known[name], value) if name in known else value
            for name, value in values.items() if name not in NODE_PARAMETERS}


def parse_setting(text: str, plant: str = 'actuator') -> tuple[str, str, Value]:
    """
    Return (actuator or controller, parameter, value) of 'actuator.load.type=spring'.

    Raises InputError if it is not of that form or names no parameter.
    """
    name, sign, value = text.partition('=')
    which, _, parameter = name.strip().partition('.')
    if not sign or which not in TABLES:
        raise InputError(f'--set {text}: it takes actuator.NAME=VALUE or controller.NAME=VALUE')
    known = {each.name: each for each in table_of(which, plant)}
    if parameter not in known:
        import difflib
        near = difflib.get_close_matches(parameter, known, 3)
        hint = f'; did you mean {", ".join(near)}?' if near else ''
        whose = plant if which == 'actuator' else which
        raise InputError(f'--set {text}: {parameter!r} is not a parameter of the {whose}{hint}')
    table_entry = known[parameter]
    if isinstance(table_entry.default, str):
        return which, parameter, value.strip()
    return which, parameter, with_its_type(table_entry, parameter_file.read_scalar(value.strip()))


def gather(files: Mapping[str, Path | None], settings: list[str],
           named: Mapping[str, Mapping[str, Value | None]], duration_s: float,
           plant: str = 'actuator') -> dict[str, dict[str, Value]]:
    """
    Return the parameters of 'actuator' and 'controller' from files, --set and named options.

    Later ones take precedence; an option that is None is ignored. The default reference is a step;
    a chirp or ramp without a duration lasts to the end of the run. The command to a joint is the
    reference, unless compensator or gain are given.
    """
    values = {which: read_parameters(path, which, plant) if (path := files.get(which)) else {}
              for which in TABLES}
    for text in settings:
        which, name, value = parse_setting(text, plant)
        values[which][name] = value
    for which, options in named.items():
        values[which] |= {name: value for name, value in options.items() if value is not None}
    controller = values['controller']
    if plant == 'joint' and not {'compensator', 'gain'} & controller.keys():
        controller['gain'] = OPEN_LOOP
    shape = controller.setdefault('reference.shape', 'step')
    if shape in ('chirp', 'ramp') and 'reference.duration' not in controller:
        start = float(controller.get('reference.start', 0.05))
        controller['reference.duration'] = max(duration_s - start, 1e-3)
    return values


def information(experiment: Experiment) -> dict[str, Any]:
    """Return the metadata `asi.run` of the bag; it depends on the experiment only."""
    own = {} if experiment.plant == 'actuator' else {
        'plant': experiment.plant, 'signals': joint_parameters.units(experiment.actuator)}
    return {
        'experiment': {'mode': experiment.mode, 'rate_hz': experiment.control_rate_hz,
                       'duration_s': experiment.duration_s, 'ticks': experiment.ticks},
        'actuator': dict(experiment.actuator),
        'controller': dict(experiment.controller),
        'seed': {'noise': experiment.actuator['force_sensor.noise_seed'],
                 'reference': experiment.controller['reference.seed']},
        'versions': versions(),
        **own,
    }
