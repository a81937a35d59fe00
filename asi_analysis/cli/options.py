"""What the commands share: the application, their options, how an answer is printed."""

import json
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from asi_analysis.errors import InputError
from asi_controller.compensators import COMPENSATORS

HELP = {'help_option_names': ['-h', '--help']}
app = typer.Typer(
    help='Run, record and understand a force-controlled hydraulic actuator.',
    no_args_is_help=True, add_completion=False, rich_markup_mode='markdown',
    pretty_exceptions_enable=False, context_settings=HELP)

Json = Annotated[bool, typer.Option(
    '--json', help='Print one JSON document (doc/reference/json.md).')]


def directory(path: Path | None) -> Path | None:
    """Return a directory to write to; raises InputError, before anything is computed."""
    if path is not None:
        there = next((each for each in (path, *path.absolute().parents) if each.exists()), path)
        if not there.is_dir() or not os.access(there, os.W_OK):
            raise InputError(f'{path} cannot be written: {there} is '
                             + ('not writable' if there.is_dir() else 'not a directory'))
    return path


Report = Annotated[Path | None, typer.Option(
    callback=directory, help='Directory for an HTML report and its pictures as PNG')]
Bag = Annotated[Path, typer.Argument(help='A bag: its directory or its .mcap file')]
ParameterFile = Annotated[Path | None, typer.Option(help='ROS parameter file (YAML)')]
Settings = Annotated[list[str] | None, typer.Option(
    '--set', metavar='NODE.NAME=VALUE',
    help='Any other parameter, as actuator.load.mass=0.3; may be repeated')]
Compensator = Annotated[str | None, typer.Option(help=', '.join(COMPENSATORS))]
Gain = Annotated[float | None, typer.Option(help='Its gain; 0: its own default')]
Held = Annotated[float, typer.Option(help='Force that the loop is to hold, N')]
Rate = Annotated[float, typer.Option(help='Control rate, Hz')]
Jobs = Annotated[int, typer.Option('--jobs', min=1, help='Processes; the result is the same')]
Dask = Annotated[str | None, typer.Option(
    '--dask', metavar='ADDRESS', help='Scheduler of a Dask cluster to use instead')]


def command(name: str, example: str, of: typer.Typer = app
            ) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Make a function a command; `example` is the end of its help."""
    return of.command(name, epilog=f'Example: `{example}`')


def show(result: Any, as_json: bool) -> None:
    """Print a result: as one JSON document, or for people."""
    print(json.dumps(result.to_dict(), indent=2) if as_json else result)


def numbers(option: str, text: str) -> list[float]:
    """Return the numbers of an option, which have commas between them."""
    try:
        found = [float(part) for part in text.split(',') if part.strip()]
        if not all(map(math.isfinite, found)):
            raise ValueError
        return found
    except ValueError:
        raise InputError(f'{option} {text}: it takes numbers with commas between') from None
