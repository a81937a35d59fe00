"""Commands about the paper: demo, reproduce, calibrate, ensemble."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from asi_analysis.cli.options import (
    MOST_SEED,
    Dask,
    Jobs,
    Json,
    ParameterFile,
    command,
    directory,
    show,
)
from asi_analysis.terminal import bar


@command('demo', 'asi demo --out runs/demo')
def demo(
    out: Annotated[Path, typer.Option(
        callback=directory,
        help='Directory of report.html; an earlier demo there is replaced')] = Path('runs/demo'),
    as_json: Json = False,
) -> None:
    """Run the experiments of the paper over ROS, diagnose a withheld effect, write a report."""
    from asi_analysis.demo.demo import run_demo
    with bar() as progress:
        result = run_demo(out, progress)
    show(result, as_json)


@command('reproduce', 'asi reproduce --report runs/reproduction')
def reproduce(
    actuator: ParameterFile = None,
    candidate: Annotated[Path | None, typer.Option(
        help='best.json of a calibration: parameters and conditions')] = None,
    report: Annotated[Path | None, typer.Option(
        callback=directory,
        help='Directory for an HTML report with our version of Figs. 3 to 12')] = None,
    over_ros: Annotated[Path | None, typer.Option(
        help='Repeat the closed-loop rows with the real nodes, with their bags in this '
        'directory. Exit status 1 if a value differs')] = None,
    as_json: Json = False,
) -> None:
    """
    Measure every published fact on the simulator and compare it with the paper.

    The exit status is 0 even if some are not met.
    """
    from asi_analysis.experiments.experiment import read_parameters
    from asi_analysis.paper.reproduction.answer import reproduce_paper
    values: Mapping[str, Any] = read_parameters(actuator, 'actuator') if actuator else {}
    conditions = None
    if candidate:
        from asi_analysis.paper.calibration.quantities import read_best
        values, conditions = read_best(candidate)
    with bar() as progress:
        result = reproduce_paper(values, conditions, progress)
        if report:
            progress('report', None)
            result.write_report(report)
        if over_ros:
            result.repeat_over_ros(over_ros, progress)
    show(result, as_json)
    if not all(each['equal'] for each in result.over_ros):
        raise typer.Exit(1)


@command('calibrate', 'asi calibrate --evaluations 2000 --jobs 2 --out runs/calibration')
def calibrate(
    evaluations: Annotated[int | None, typer.Option(
        help='Candidates of the global search, including those of an earlier call; default: 2000, '
             'for a front none', min=0)] = None,
    polish: Annotated[int, typer.Option(
        help='Largest number of successive linear programs from the best candidate', min=0)] = 20,
    structure: Annotated[Literal['side', 'cylinder', 'behind', 'locked', 'spring', 'static',
                                 'widening'], typer.Option(
        help='Structure of the model that is fitted')] = 'side',
    seed: Annotated[int, typer.Option(help='Seed of the search', min=0, max=MOST_SEED)] = 1,
    spread: Annotated[float, typer.Option(
        help='Initial deviation of the search, share of the range of each parameter')] = 0.1,
    start: Annotated[Path | None, typer.Option(
        help='best.json of an earlier calibration to start from; default: the defaults')] = None,
    only: Annotated[list[str] | None, typer.Option(
        help='Vary only this quantity, or those with this prefix; may be repeated')] = None,
    no_table_1: Annotated[bool, typer.Option(
        '--no-table-1', help='Leave out the rows and conditions of Table 1')] = False,
    jobs: Jobs = 1,
    dask: Dask = None,
    out: Annotated[Path, typer.Option(
        callback=directory,
        help='Directory of state and result; a search in it is continued')
    ] = Path('runs/calibration'),
    front: Annotated[str | None, typer.Option(
        help='NAME=V1,V2,…: hold a quantity or a row at each value, fit the others, and show the '
             'cost')
    ] = None,
    as_json: Json = False,
) -> None:
    """Fit the free parameters of the model to the published facts."""
    from asi_analysis.parallel import workers
    result: Any
    with workers(jobs, dask), bar() as progress:
        if front:
            from asi_analysis.paper.calibration.front import Fit
            from asi_analysis.paper.calibration.front import run as run_front
            fit = Fit(evaluations if evaluations is not None else 0, polish, structure, seed,
                      spread, only or [], not no_table_1)
            result = run_front(front, start, fit, out, progress)
        else:
            from asi_analysis.paper.calibration.answer import run as run_calibration
            result = run_calibration(out, structure, 2000 if evaluations is None else evaluations,
                                     polish, seed, spread, start,
                                     only or [], progress, not no_table_1)
    show(result, as_json)


@command('ensemble', 'asi ensemble --count 20')
def ensemble(
    count: Annotated[int, typer.Option(help='Number of members', min=1)] = 20,
    most: Annotated[int, typer.Option(help='Largest number of candidates', min=1)] = 1500,
    seed: Annotated[int, typer.Option(help='Seed of the draws', min=0, max=MOST_SEED)] = 1,
    out: Annotated[Path, typer.Option(
        callback=directory, help='Directory of the members')] = Path('config/ensemble'),
    pictures: Annotated[Path, typer.Option(
        callback=directory,
        help='Directory of the pictures and the sensitivity table')] = Path(
        'doc/explanation/reproduction'),
    jobs: Jobs = 1,
    dask: Dask = None,
    as_json: Json = False,
) -> None:
    """Find other parameter sets that meet the published facts equally well."""
    from asi_analysis.paper.calibration.ensemble import run as run_ensemble
    from asi_analysis.parallel import workers
    with workers(jobs, dask), bar() as progress:
        result = run_ensemble(out, pictures, count, most, seed, progress)
    show(result, as_json)
