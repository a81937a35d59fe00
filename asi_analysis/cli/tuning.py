"""Commands of the design of the controller: tune, compare, sweep."""

import shlex
import sys
from pathlib import Path
from typing import Annotated

import typer

from asi_analysis.cli.options import (
    MOST_SEED,
    Compensator,
    Dask,
    Gain,
    Jobs,
    Json,
    ParameterFile,
    Rate,
    Report,
    Settings,
    checked_step,
    command,
    directory,
    new_file,
    numbers,
    show,
)
from asi_analysis.terminal import bar


@command('tune', 'asi tune --actuator runs/gap/improved.yaml --out runs/tune')
def tune(
    actuator: ParameterFile = None,
    controller: Annotated[Path | None, typer.Option(
        help='ROS parameter file of the controller from which the search starts')] = None,
    prefer: Annotated[str, typer.Option(
        help='What counts most: balanced, stiff, transparent or quiet')] = 'balanced',
    evaluations: Annotated[int, typer.Option(
        help='Number of settings to try; 0: only check those of the start', min=0)
        ] = 480,
    conditions: Annotated[int, typer.Option(
        help='Conditions of the final search for an oscillation (`asi quench`)', min=1)] = 300,
    seed: Annotated[int, typer.Option(help='Seed of both searches', min=0, max=MOST_SEED)] = 1,
    rate: Rate = 5000.0,
    out: Annotated[Path | None, typer.Option(
        callback=directory, help='Directory for controller.yaml')] = None,
    report: Report = None,
    as_json: Json = False,
) -> None:
    """
    Search the settings of the controller for an actuator.

    The cost includes a search for oscillations (`asi quench`). Exit status 1 if a final such
    search finds a sustained one.
    """
    from asi_analysis.experiments.experiment import read_parameters
    from asi_analysis.tuning.answer import tune_controller
    with bar() as progress:
        result = tune_controller(
            read_parameters(actuator, 'actuator') if actuator else {},
            read_parameters(controller, 'controller') if controller else {},
            prefer, evaluations, conditions, seed, out, rate, progress)
    show(result, as_json, report)
    if result.sustained_found:
        raise typer.Exit(1)


@command('compare', 'asi compare lead4 config/quiet.yaml --report runs/compare')
def compare(
    what: Annotated[list[str], typer.Argument(
        help='Compensators by name, controller parameter files (.yaml) and bags')],
    actuator: ParameterFile = None,
    set_: Settings = None,
    rates: Annotated[str, typer.Option(
        help='Control rates, Hz; noise, plants and springs use the first')] = '5000,2000,1000',
    springs: Annotated[str, typer.Option(
        help="Spring loads, N/m; a free load is added; '': none")] = '1e4,1e5,1e6',
    plants: Annotated[int, typer.Option(
        help='Number of actuators with parameter errors of up to 20 %', min=0, max=10_000)] = 12,
    noise: Annotated[float, typer.Option(
        help='Noise of the force sensor, N rms; 0: none', min=0.0, max=1e4)] = 1.0,
    conditions: Annotated[int, typer.Option(
        help='Conditions of the search for an oscillation (`asi quench`); 0: none', min=0)] = 300,
    seed: Annotated[int, typer.Option(
        help='Seed of the plants and of that search', min=0, max=MOST_SEED)] = 1,
    gains: Annotated[str, typer.Option(
        help='Factors on gain and integrator for the impedance and its range, the Z-width: '
             "0.5,1,1.5; '': none")] = '',
    markdown: Annotated[Path | None, typer.Option(
        callback=new_file, help='File for the tables as Markdown')] = None,
    report: Report = None,
    as_json: Json = False,
) -> None:
    """
    Compare controllers in many simulated conditions, and with recordings.

    Steps of 20 to 700 N, sines and a moved piston; the figures are those of `asi tune`.
    """
    from asi_analysis.experiments.experiment import gather
    from asi_analysis.tuning.compare import compare_controllers, read_compared
    values = gather({'actuator': actuator}, set_ or [], {}, 1.0)
    with bar() as progress:
        progress('reading', None)
        controllers, recordings = read_compared(what)
        result = compare_controllers(
            {name: {**each, **values['controller']} for name, each in controllers.items()},
            recordings, values['actuator'], numbers('--rates', rates),
            numbers('--springs', springs), plants, noise, conditions, seed,
            numbers('--gains', gains), progress)
        if markdown:
            result.write_markdown(markdown, shlex.join(['asi', *sys.argv[1:]]))
    show(result, as_json, report)


@command('sweep', 'asi sweep --over controller.gain=1:10:10 --step 300 --csv gains.csv')
def sweep(
    over: Annotated[list[str], typer.Option(
        '--over', metavar='NODE.NAME=VALUES',
        help='Values of a parameter: A,B,C or START:STOP:COUNT; may be repeated, for a grid')],
    compensator: Compensator = None,
    gain: Gain = None,
    step: Annotated[float, typer.Option(
        callback=checked_step, help='Size of the step in the reference, N')] = 100.0,
    load: Annotated[str | None, typer.Option(help='locked, spring, free or prescribed')] = None,
    duration: Annotated[float, typer.Option(help='Length of each run, s')] = 0.5,
    rate: Rate = 5000.0,
    actuator: ParameterFile = None,
    controller: ParameterFile = None,
    set_: Settings = None,
    csv: Annotated[Path | None, typer.Option(
        callback=new_file, help='CSV file to write the table to')] = None,
    bags: Annotated[Path | None, typer.Option(
        callback=directory, help='Directory for a bag of each run, as of `asi run`')] = None,
    jobs: Jobs = 1,
    dask: Dask = None,
    as_json: Json = False,
) -> None:
    """
    Measure the step response over a grid of parameters, without ROS.

    Loops are simulated on all cores; --jobs distributes the analysis and writing too.
    """
    from asi_analysis.experiments.experiment import gather
    from asi_analysis.loop.sweep import grid
    from asi_analysis.loop.sweep import sweep as run_sweep
    from asi_analysis.parallel import workers
    values = gather({'actuator': actuator, 'controller': controller}, set_ or [], {
        'actuator': {'load.type': load},
        'controller': {'compensator': compensator, 'gain': gain, 'reference.shape': 'step',
                       'reference.amplitude': step}}, duration)
    with workers(jobs, dask), bar() as progress:
        result = run_sweep(grid(over), values['actuator'], values['controller'], duration, rate,
                           bags=bags, progress=progress)
        if csv:
            result.write_csv(csv)
    show(result, as_json)
