"""`asi gap --export`: what was found, as a file for a simulator, and its replay there."""

import math
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

from asi_analysis.bags.exchange.joints import folder_name
from asi_analysis.errors import InputError, InputWarning
from asi_analysis.gap.answer.joint_files import (
    JOINT,
    isaac,
    mjcf,
    unsaid_in_isaac,
    unsaid_in_urdf,
    urdf,
)
from asi_analysis.gap.answer.joint_model import JointModel, joint_model, node_parameters
from asi_analysis.gap.answer.replay import replay_error
from asi_analysis.gap.diagnosis import Diagnosis
from asi_analysis.gap.model.model_file import improved_model
from asi_analysis.gap.words import percent
from asi_common.files import write_text
from asi_common.parameter import Value
from asi_common.parameter_file import parameter_file, parameter_lines, write_parameters

FORMATS: Final = {'.xml': 'MJCF', '.mjcf': 'MJCF', '.urdf': 'URDF', '.yaml': 'YAML',
                  '.yml': 'YAML'}
ISAAC: Final = ('.isaac.yaml', '.isaac.yml')
NODE: Final = '/**/asi_actuator'
EACH: Final = '{joint}'     # in the name of a file: one of each joint


class Exported(NamedTuple):
    """
    A joint, ready to be written.

    model: as other simulators take it; parameters: those of our node, in words, what is left out.
    """

    model: JointModel
    parameters: tuple[dict[str, Value], list[str], list[str]]


def format_of(path: Path, plant: str) -> str:
    """Return the format that the ending of a file names. Raises InputError for another."""
    found = 'Isaac Lab' if path.name.endswith(ISAAC) else FORMATS.get(path.suffix.lower())
    if found is None:
        raise InputError(f'--export {path}: the ending {path.suffix!r} is not allowed: .xml (MJCF '
                         'of MuJoCo), .urdf, .isaac.yaml (Isaac Lab) or .yaml (our nodes, and '
                         '--model)')
    if plant == 'actuator' and found != 'YAML':
        raise InputError(f'--export {path}: {found} has no words for a valve and its oil; write '
                         'the parameters of the actuator node (.yaml), or diagnose the load alone '
                         '(--plant joint)')
    if plant == 'static':
        raise InputError(f'--export {path}: no format has words for a static characteristic; '
                         '--json has its sizes')
    return found


def for_each_joint(path: Path) -> Path | None:
    """
    Return the file of each joint, with {joint} in its name; None: one file holds all joints.

    A directory, or a name without an ending, gets a parameter file of each.
    """
    if EACH in path.name:
        return path
    return path / f'{EACH}.yaml' if path.is_dir() or not path.suffix else None


def file_of(path: Path, joint: str) -> Path:
    """Return the file of a joint."""
    return path.with_name(path.name.replace(EACH, folder_name(joint)))


def _row(path: Path, kind: str, unsaid: list[str]) -> dict[str, Any]:
    return {'file': str(path), 'format': kind, 'unsaid': unsaid, 'simulator': None,
            'before_nrmse': None, 'after_nrmse': None, 'shrink': None}


def _origin(sources: list[str]) -> str:
    return ('Written by asi gap from ' + ', '.join(dict.fromkeys(sources))
            + '; values with their 95 % intervals:')


def exported(diagnosis: Diagnosis, given: Mapping[str, Value]) -> Exported:
    """Return a joint, ready to be written; given: its nominal parameters. Raises InputError."""
    return Exported(joint_model(diagnosis), node_parameters(diagnosis, given))


def write_export(diagnosis: Diagnosis, model: Mapping[str, Value] | None, path: Path
                 ) -> dict[str, Any]:
    """
    Write what was found into a file, in the format of its ending; returns its row of `exports`.

    model: nominal parameters by name. Raises InputError for a format or a joint that cannot be
    written.
    """
    kind = format_of(path, diagnosis.plant)
    if diagnosis.plant == 'actuator':
        values, unsaid = improved_model(model or {}, [diagnosis.best(w).fitted.record
                                                      for w in diagnosis.groups])
        write_parameters(path, NODE, dict(sorted(values.items())))
        return _row(path, kind, unsaid)
    found = exported(diagnosis, model or {})
    row = write_joints({JOINT: found}, path, [run.source for run in diagnosis.runs])
    return row | (_replayed(diagnosis, found.model) if kind == 'MJCF' else {})


def write_joints(found: Mapping[str, Exported], path: Path, sources: list[str]
                 ) -> dict[str, Any]:
    """
    Write joints by name into one file; returns its row of `exports`.

    A parameter file has a section for the node of each joint, in the namespace of its name; one
    alone is for a node in any namespace.
    """
    kind, origin = format_of(path, 'joint'), _origin(sources)
    models = {name: each.model for name, each in found.items()}
    unsaid = {name: list(each.parameters[2] if kind == 'YAML' else each.model.unsaid)
              for name, each in found.items()}
    if kind == 'YAML':
        texts = [_section(name, each, origin) for name, each in found.items()]
        write_text(path, '\n'.join(texts))
    elif kind == 'URDF':
        write_text(path, urdf(models, origin))
        unsaid = {name: each + unsaid_in_urdf(models[name]) for name, each in unsaid.items()}
    elif kind == 'MJCF':
        write_text(path, mjcf(models, origin))
    else:
        write_text(path, isaac(models, origin))
        unsaid = {name: each + unsaid_in_isaac(models[name]) for name, each in unsaid.items()}
    return _row(path, kind, [text if name == JOINT else f'{name}: {text}'
                             for name, texts in unsaid.items() for text in texts])


def _section(name: str, found: Exported, origin: str) -> str:
    """Return the section of a joint's node in a parameter file."""
    values, said, unsaid = found.parameters
    node = NODE if name == JOINT else f'/{folder_name(name)}/asi_actuator'
    return parameter_file(node, parameter_lines(values), [
        origin, *said, *(f'Not in this model: {each}' for each in unsaid)])


def _replayed(diagnosis: Diagnosis, found: JointModel) -> dict[str, Any]:
    """Return the errors of the motion in MuJoCo, nominal and as exported."""
    try:
        import mujoco
    except ImportError:
        return {}
    nominal = joint_model(diagnosis, nominal=True)
    row: dict[str, Any] = {'simulator': f'MuJoCo {mujoco.__version__}'}
    try:
        errors = [replay_error(diagnosis, each, mjcf({JOINT: each}, ''))
                  for each in (nominal, found)]
    except ValueError as error:   # such as an attribute that an older version does not know
        warnings.warn(f'{row["simulator"]} does not load the export: {str(error).splitlines()[0]}',
                      InputWarning, stacklevel=2)
        return row
    if not all(map(math.isfinite, errors)):
        return row
    return row | {'before_nrmse': errors[0], 'after_nrmse': errors[1],
                  'shrink': 1.0 - errors[1] / errors[0] if errors[0] else 0.0}


def in_words(exports: list[Mapping[str, Any]], several: bool = False) -> Iterator[str]:
    """Yield what was exported, in words; several: joints, which are not replayed together."""
    for row in exports:
        yield f'export: {row["file"]} ({row["format"]})' + (
            f'; not in it: {"; ".join(row["unsaid"])}' if row['unsaid'] else '')
        if row['shrink'] is not None:
            yield (f'In {row["simulator"]} the error of the motion is '
                   f'{percent(row["after_nrmse"])} of it (rms), and '
                   f'{percent(row["before_nrmse"])} with the nominal model: a shrink of '
                   f'{percent(row["shrink"])}.')
        elif row['format'] == 'MJCF' and not several:
            yield (f'{row["simulator"]} could not replay the recording with it.'
                   if row['simulator'] else
                   'With MuJoCo installed (pip install mujoco) the recording is replayed with it.')
