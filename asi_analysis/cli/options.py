"""Shared by the commands: the application, common options, printing of results."""

import json
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from asi_analysis.errors import InputError
from asi_analysis.terminal import bar
from asi_controller.compensators import COMPENSATORS

HELP = {'help_option_names': ['-h', '--help']}
app = typer.Typer(
    help='Run, record and understand a force-controlled hydraulic actuator.',
    no_args_is_help=True, add_completion=False, rich_markup_mode='markdown',
    pretty_exceptions_enable=False, context_settings=HELP)

Json = Annotated[bool, typer.Option(
    '--json', help='Print one JSON document (doc/reference/json.md).')]


def directory(path: Path | None) -> Path | None:
    """Return a directory to write to; raises InputError if it is not writable."""
    if path is not None:
        parent = next((each for each in (path, *path.absolute().parents) if each.exists()), path)
        if not parent.is_dir() or not os.access(parent, os.W_OK):
            raise InputError(f'{path} cannot be written: {parent} is '
                             + ('not writable' if parent.is_dir() else 'not a directory'))
    return path


def new_file(path: Path | None) -> Path | None:
    """Return a file to write; raises InputError before hours of computing if it cannot be."""
    if path is not None and ((path.exists() and not path.is_file()) or not path.parent.is_dir()):
        raise InputError(f'{path} cannot be written: '
                         + (f'{path} is a directory' if path.is_dir() else
                            f'{path} is not a file' if path.exists() else
                            f'{path.parent} is not a directory'))
    directory(path and path.parent)
    return path


def checked_step(step_n: float | None) -> float | None:
    """Return the step of --step; raises InputError if the reference does not take it."""
    if step_n is not None:
        from asi_controller.parameters import REFERENCE_PARAMETERS
        problem = next(each.problem(step_n) for each in REFERENCE_PARAMETERS
                       if each.name == 'reference.amplitude')
        if problem:
            raise InputError(f'--step: {problem}')
    return step_n


Report = Annotated[Path | None, typer.Option(
    callback=directory, help='Directory for an HTML report and its pictures as PNG')]
Bag = Annotated[Path, typer.Argument(help='A bag: its directory or its .mcap file')]
ParameterFile = Annotated[Path | None, typer.Option(help='ROS parameter file (YAML) of the node')]
Settings = Annotated[list[str] | None, typer.Option(
    '--set', metavar='NODE.NAME=VALUE',
    help='Any other parameter, for example actuator.load.mass=0.3; may be repeated')]
Compensator = Annotated[str | None, typer.Option(help=f'Compensator: {", ".join(COMPENSATORS)}')]
Gain = Annotated[float | None, typer.Option(help='Gain of the compensator; 0: its default')]
Held = Annotated[float, typer.Option(
    callback=checked_step, help='Force reference of the loop, N')]
Rate = Annotated[float, typer.Option(help='Control rate, Hz')]
# Sums of a seed and a number of cases are a seed too, of 31 bits.
MOST_SEED = 10**9
Jobs = Annotated[int, typer.Option(
    '--jobs', min=1, max=256, help='Number of processes; the result does not depend on it')]
Dask = Annotated[str | None, typer.Option(
    '--dask', metavar='ADDRESS', help='Scheduler of a Dask cluster, in place of local processes')]


def command(name: str, example: str, of: typer.Typer = app
            ) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return a decorator that makes a function a command; `example` ends its help."""
    return of.command(name, epilog=f'Example: `{example}`')


def show(result: Any, as_json: bool, report: Path | None = None) -> None:
    """Print a result as one JSON document, or as text; with a directory, write its report too."""
    if report:
        with bar() as progress:
            progress('report', None)
            result.write_report(report)
    print(json.dumps(result.to_dict(), indent=2) if as_json else result)


def numbers(option: str, text: str) -> list[float]:
    """Return the numbers of an option, separated by commas."""
    try:
        found = [float(part) for part in text.split(',') if part.strip()]
        if not all(map(math.isfinite, found)):
            raise ValueError
        return found
    except ValueError:
        raise InputError(f'{option} {text}: it takes numbers separated by commas') from None
