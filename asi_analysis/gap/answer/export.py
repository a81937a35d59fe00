"""`asi gap --export`: what was found, as a file for a simulator, and its replay there."""

import math
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from asi_analysis.errors import InputError, InputWarning
from asi_analysis.gap.answer.joint_files import mjcf, unsaid_in_urdf, urdf
from asi_analysis.gap.answer.joint_model import JointModel, joint_model
from asi_analysis.gap.answer.joint_parameters import node_parameters
from asi_analysis.gap.answer.replay import replay_error
from asi_analysis.gap.diagnose import Diagnosis
from asi_analysis.gap.model.model_file import improved_model
from asi_analysis.gap.words import percent
from asi_common.files import write_text
from asi_common.parameter import Value
from asi_common.parameter_file import write_parameters

FORMATS: Final = {'.xml': 'MJCF', '.mjcf': 'MJCF', '.urdf': 'URDF', '.yaml': 'YAML',
                  '.yml': 'YAML'}
NODE: Final = '/**/asi_actuator'


def format_of(path: Path, plant: str) -> str:
    """Return the format that the ending of a file names. Raises InputError for another."""
    found = FORMATS.get(path.suffix.lower())
    if found is None:
        raise InputError(f'--export {path}: the ending {path.suffix!r} is not allowed: .xml (MJCF '
                         'of MuJoCo), .urdf or .yaml (what --model takes)')
    if plant == 'actuator' and found != 'YAML':
        raise InputError(f'--export {path}: {found} has no words for a valve and its oil; write '
                         'the parameters of the actuator node (.yaml), or diagnose the load alone '
                         '(--plant joint)')
    if plant == 'static':
        raise InputError(f'--export {path}: no format has words for a static characteristic; '
                         '--json has its sizes')
    return found


def write_export(diagnosis: Diagnosis, model: Mapping[str, Value] | None, path: Path
                 ) -> dict[str, Any]:
    """
    Write what was found into a file, in the format of its ending; returns its row of `exports`.

    model: nominal parameters by name. Raises InputError for a format or a joint that cannot be
    written.
    """
    kind = format_of(path, diagnosis.plant)
    row: dict[str, Any] = {'file': str(path), 'format': kind, 'unsaid': [], 'simulator': None,
                           'before_nrmse': None, 'after_nrmse': None, 'shrink': None}
    if diagnosis.plant == 'actuator':
        values, row['unsaid'] = improved_model(model or {}, [diagnosis.best(w).fitted.record
                                                       for w in diagnosis.groups])
        write_parameters(path, NODE, dict(sorted(values.items())))
        return row
    origin = ('Written by asi gap from ' + ', '.join(run.source for run in diagnosis.runs)
              + '; values with their 95 % intervals:')
    if kind == 'YAML':
        values, said, row['unsaid'] = node_parameters(diagnosis, model or {})
        write_parameters(path, NODE, values, [
            origin, *said, *(f'Not in this model: {each}' for each in row['unsaid'])])
        return row
    found = joint_model(diagnosis)
    row['unsaid'] = list(found.unsaid)
    if kind == 'URDF':
        write_text(path, urdf(found, origin))
        row['unsaid'] += unsaid_in_urdf(found)
        return row
    text = mjcf(found, origin)
    write_text(path, text)
    return row | _replayed(diagnosis, found, text)


def _replayed(diagnosis: Diagnosis, found: JointModel, text: str) -> dict[str, Any]:
    """Return the errors of the motion in MuJoCo, nominal and as exported."""
    try:
        import mujoco
    except ImportError:
        return {}
    nominal = joint_model(diagnosis, nominal=True)
    row: dict[str, Any] = {'simulator': f'MuJoCo {mujoco.__version__}'}
    try:
        errors = [replay_error(diagnosis, nominal, mjcf(nominal, '')),
                  replay_error(diagnosis, found, text)]
    except ValueError as error:   # such as an attribute that an older version does not know
        warnings.warn(f'{row["simulator"]} does not load the export: {str(error).splitlines()[0]}',
                      InputWarning, stacklevel=2)
        return row
    if not all(map(math.isfinite, errors)):
        return row
    return row | {'before_nrmse': errors[0], 'after_nrmse': errors[1],
                  'shrink': 1.0 - errors[1] / errors[0] if errors[0] else 0.0}


def in_words(exports: list[Mapping[str, Any]]) -> Iterator[str]:
    """Yield what was exported, in words."""
    for row in exports:
        yield f'export: {row["file"]} ({row["format"]})' + (
            f'; not in it: {"; ".join(row["unsaid"])}' if row['unsaid'] else '')
        if row['shrink'] is not None:
            yield (f'In {row["simulator"]} the error of the motion is '
                   f'{percent(row["after_nrmse"])} of it (rms), and '
                   f'{percent(row["before_nrmse"])} with the nominal model: a shrink of '
                   f'{percent(row["shrink"])}.')
        elif row['format'] == 'MJCF':
            yield (f'{row["simulator"]} could not replay the recording with it.'
                   if row['simulator'] else
                   'With MuJoCo installed (pip install mujoco) the recording is replayed with it.')
