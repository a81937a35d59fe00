"""Command of the design of the controller: tune."""

from pathlib import Path
from typing import Annotated

import typer

from asi_analysis.cli.options import (
    MOST_SEED,
    Json,
    ParameterFile,
    Report,
    command,
    directory,
    show,
)
from asi_analysis.terminal import bar


@command('tune', 'asi tune --actuator runs/gap/improved.yaml --out runs/tune')
def tune(
    actuator: ParameterFile = None,
    controller: Annotated[Path | None, typer.Option(
        help='ROS parameter file of the controller with which the search begins')] = None,
    prefer: Annotated[str, typer.Option(
        help='What counts most: balanced, stiff, transparent or quiet')] = 'balanced',
    evaluations: Annotated[int, typer.Option(
        help='Settings of the controller that are tried; 0: only those of the start', min=0)
        ] = 800,
    conditions: Annotated[int, typer.Option(
        help='Conditions of the attack on what is found', min=1)] = 300,
    seed: Annotated[int, typer.Option(help='Seed of search and attack', min=0, max=MOST_SEED)] = 1,
    out: Annotated[Path | None, typer.Option(
        callback=directory, help='Directory for controller.yaml')] = None,
    report: Report = None,
    as_json: Json = False,
) -> None:
    """
    Search the settings of the controller for an actuator, with the attack of `asi quench` inside.

    Exit status 1 if the attack finds a sustained oscillation in the end.
    """
    from asi_analysis.experiments.experiment import read_parameters
    from asi_analysis.tuning.answer import tune_controller
    with bar() as progress:
        result = tune_controller(
            read_parameters(actuator, 'actuator') if actuator else {},
            read_parameters(controller, 'controller') if controller else {},
            prefer, evaluations, conditions, seed, out, progress)
        if report:
            result.write_report(report)
    show(result, as_json)
    if result.sustained_found:
        raise typer.Exit(1)
