"""
The `asi` command: reads the command line, calls, prints.

No logic, and nothing heavy is imported before a command needs it.

A new command is one function with @command; what it raises becomes the exit status (see `main`).
"""

import json
import math
import os
import sys
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
import typer.core

from asi_analysis.errors import InputError
from asi_analysis.terminal import bar
from asi_controller.compensators import COMPENSATORS

app = typer.Typer(
    help='Run, record and understand a force-controlled hydraulic actuator.',
    no_args_is_help=True, add_completion=False, rich_markup_mode='markdown',
    pretty_exceptions_enable=False,
    context_settings={'help_option_names': ['-h', '--help']})

Json = Annotated[bool, typer.Option(
    '--json', help='Print one JSON document (doc/reference/json.md).')]


def _directory(path: Path | None) -> Path | None:
    """Return a directory to write to; raises InputError, before anything is computed."""
    if path is not None:
        there = next((each for each in (path, *path.absolute().parents) if each.exists()), path)
        if not there.is_dir() or not os.access(there, os.W_OK):
            raise InputError(f'{path} cannot be written: {there} is '
                             + ('not writable' if there.is_dir() else 'not a directory'))
    return path


Report = Annotated[Path | None, typer.Option(
    callback=_directory,
    help='Directory for an HTML report and its pictures as PNG')]
Bag = Annotated[Path, typer.Argument(help='A bag: its directory or its .mcap file')]
ParameterFile = Annotated[Path | None, typer.Option(help='ROS parameter file (YAML)')]
Settings = Annotated[list[str] | None, typer.Option(
    '--set', metavar='NODE.NAME=VALUE',
    help='Any other parameter, as actuator.load.mass=0.3; may be repeated')]
Compensator = Annotated[str | None, typer.Option(
    help=', '.join(COMPENSATORS))]
Gain = Annotated[float | None, typer.Option(help='Its gain; 0: its own default')]
Held = Annotated[float, typer.Option(help='Force that the loop is to hold, N')]
Rate = Annotated[float, typer.Option(help='Control rate, Hz')]
Jobs = Annotated[int, typer.Option('--jobs', min=1, help='Processes; the result is the same')]
Dask = Annotated[str | None, typer.Option(
    '--dask', metavar='ADDRESS', help='Scheduler of a Dask cluster to use instead')]


def command(name: str, example: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Make a function a command; `example` is the end of its help."""
    return app.command(name, epilog=f'Example: `{example}`')


def _or_first(default: str) -> type[typer.core.TyperGroup]:
    """Return a group of commands that takes what is none of their names as a call of `default`."""
    class Group(typer.core.TyperGroup):
        def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
            if args and args[0] not in {*self.commands, '-h', '--help'}:
                args = [default, *args]
            return super().parse_args(ctx, args)

    return Group


def answer(document: Mapping[str, Any], as_json: bool, as_text: Callable[[Any], str]) -> None:
    """Print an answer: as one JSON document, or for people as `as_text(document)`."""
    print(json.dumps(document, indent=2, allow_nan=False) if as_json else as_text(document))


@command('run', 'asi run --compensator lead_lag --gain 20 --step 500 --duration 1')
def run(
    compensator: Compensator = None,
    gain: Gain = None,
    step: Annotated[float | None, typer.Option(
        help='Size of a step in the reference, N; the same as --reference step --amplitude')
    ] = None,
    reference: Annotated[str | None, typer.Option(
        help='step, ramp, sine, triangle, chirp, multisine, prbs or topic')] = None,
    amplitude: Annotated[float | None, typer.Option(help='Size of the reference, N')] = None,
    offset: Annotated[float | None, typer.Option(
        help='Force about which it moves, N')] = None,
    frequency: Annotated[float | None, typer.Option(
        help='Its frequency, or the first or lowest, Hz')] = None,
    end_frequency: Annotated[float | None, typer.Option(
        help='Last or highest frequency of chirp or multisine, Hz')] = None,
    load: Annotated[str | None, typer.Option(help='locked, spring, free or prescribed')] = None,
    duration: Annotated[float, typer.Option(help='Length of the run, s')] = 1.0,
    mode: Annotated[str, typer.Option(
        help='lockstep: repeatable, however slow the machine; realtime: by the wall clock')
    ] = 'lockstep',
    rate: Annotated[float, typer.Option(
        help='Control rate, Hz; 0: 5000 in lock-step, 1000 in real time')] = 0.0,
    seed: Annotated[int | None, typer.Option(help='Seed of sensor noise and PRBS', min=0)] = None,
    actuator: ParameterFile = None,
    controller: ParameterFile = None,
    set_: Settings = None,
    out: Annotated[Path | None, typer.Option(
        help='Directory for bag and logs; default: runs/TIME-COMPENSATOR')] = None,
    experiment: Annotated[Literal['isolation'] | None, typer.Option(
        help='isolation: two runs that show whether a limit cycle is isolated')] = None,
    as_json: Json = False,
) -> None:
    """
    Run one experiment over ROS: start the nodes, record a bag, analyse it.

    The later wins: parameter files, then --set, then the options by name.
    """
    from asi_analysis.experiments import experiment as ex
    from asi_analysis.experiments import running
    named = {'compensator': compensator, 'gain': gain, 'reference.shape': reference,
             'reference.amplitude': amplitude, 'reference.offset': offset,
             'reference.frequency': frequency, 'reference.end_frequency': end_frequency,
             'reference.seed': seed}
    if step is not None:
        if reference not in (None, 'step') or amplitude is not None:
            raise InputError('--step is a reference of its own: it goes without --reference '
                             'and --amplitude')
        named |= {'reference.shape': 'step', 'reference.amplitude': step}
    values = ex.gather({'actuator': actuator, 'controller': controller}, set_ or [],
                       {'actuator': {'load.type': load, 'force_sensor.noise_seed': seed},
                        'controller': named}, duration)
    wanted = ex.checked(ex.Experiment(values['actuator'], values['controller'], duration, mode,
                                      rate))
    out = out or running.free_directory(Path('runs'), str(wanted.controller['compensator']))
    if experiment:
        from asi_analysis.limit_cycle.detection import answer as limit_cycle_answer
        from asi_analysis.limit_cycle.detection.experiment import isolation
        with bar() as report:
            document = isolation(wanted, out, report)
        answer(document, as_json, limit_cycle_answer.as_text)
        return
    try:
        with bar() as report:
            bag = running.run_experiment(wanted, out, report)
            document = running.run_as_dict(wanted, bag)
    except KeyboardInterrupt:
        if (out / 'bag').exists():
            _fail(f'what was recorded is in {out / "bag"}', 130)
        raise
    answer(document, as_json, running.run_as_text)


@command('analyze', 'asi analyze runs/demo/lead_lag/bag')
def analyze(
    bag: Bag,
    as_json: Json = False,
) -> None:
    """Measure step response, bandwidth and oscillation of a recorded run."""
    from asi_analysis.measures.analysis import analyze_bag, as_text
    answer(analyze_bag(bag), as_json, as_text)


@command('import', 'asi import log.csv --map time=t[ms] --map force=load_cell*250[N] --out mine')
def import_(
    file: Annotated[Path, typer.Argument(
        help='.csv, .tsv, .txt, .dat (or .gz), .mat, .npz, .parquet, or a rosbag2')],
    out: Annotated[Path, typer.Option(help='The bag to write')],
    map_: Annotated[list[str] | None, typer.Option(
        '--map', metavar='SIGNAL=COLUMN[*SCALE][+OFFSET][UNIT]',
        help='What a column is; once a signal; none for a file of `asi export`')] = None,
    rate: Annotated[float | None, typer.Option(
        help='Samples a second, if no column is the time')] = None,
    skip_lines: Annotated[int, typer.Option(help='Lines before the header', min=0)] = 0,
    delimiter: Annotated[str | None, typer.Option(help='Default: found out')] = None,
    columns: Annotated[str | None, typer.Option(
        help='Names, with commas between, for a file without a header')] = None,
    zero: Annotated[float, typer.Option(
        help='Take off each signal its mean over so many seconds from the start')] = 0.0,
    as_json: Json = False,
) -> None:
    """
    Make a bag of someone else's recording, so that every analysis runs on it.

    Signals: time, reference, command, force, valve_position, position, velocity. A column of a
    rosbag2 is TOPIC/FIELD, or TOPIC/JOINT/FIELD. More in doc/how_to/importing.md.
    """
    from asi_analysis.bags.exchange.importing import import_recording
    with bar() as report:
        report(f'reading {file}', None)
        imported = import_recording(
            file, map_ or [], rate, skip_lines=skip_lines, delimiter=delimiter,
            columns=columns.split(',') if columns else None, zero_s=zero, out=out)
    answer({'bag': str(out), 'samples': len(imported), 'duration_s': imported.duration_s,
            'rate_hz': imported.rate_hz, 'signals': list(imported.signals())}, as_json,
           lambda document: f'{imported}\nbag: {out}')


@command('export', 'asi export runs/demo/lead_lag/bag --out lead_lag.csv')
def export(
    bag: Bag,
    out: Annotated[Path, typer.Option(help='The .csv or .parquet file to write')],
    as_json: Json = False,
) -> None:
    """Write a bag's signals as a table: CSV or Parquet, with the units in the names."""
    from asi_analysis.bags.bag import read_bag
    from asi_analysis.bags.exchange.exporting import export as write_table
    recorded = read_bag(bag)
    write_table(recorded, out)
    answer({'file': str(out), 'samples': len(recorded), 'signals': list(recorded.signals())},
           as_json, lambda document: f'{out}: {document["samples"]} rows, '
           + ', '.join(document['signals']))


@command('demo', 'asi demo --out runs/demo')
def demo(
    out: Annotated[Path, typer.Option(
        callback=_directory,
        help='Directory of the report; an earlier demo there is replaced')] = Path('runs/demo'),
    as_json: Json = False,
) -> None:
    """Run the paper's experiments over ROS and write a report: OUT/report.html."""
    from asi_analysis.paper.demo import as_text, run_demo
    with bar() as report:
        document = run_demo(out, report)
    answer(document, as_json, as_text)


@command('reproduce', 'asi reproduce --report runs/reproduction')
def reproduce(
    actuator: ParameterFile = None,
    candidate: Annotated[Path | None, typer.Option(
        help='best.json of a calibration: parameters and conditions')] = None,
    report: Annotated[Path | None, typer.Option(
        callback=_directory,
        help='Directory for an HTML report with our version of Figs. 3 to 12')] = None,
    over_ros: Annotated[Path | None, typer.Option(
        help='Make the closed-loop rows with the real nodes as well; their bags go into this '
        'directory. A value that differs: exit status 1')] = None,
    as_json: Json = False,
) -> None:
    """
    Measure every fact that the paper publishes on the simulator, each beside its value.

    Exit status 0, whether all are met or not: the table says so.
    """
    from asi_analysis.experiments.experiment import read_parameters
    from asi_analysis.paper.reproduction import answer as reproduction
    values: Mapping[str, Any] = read_parameters(actuator, 'actuator') if actuator else {}
    conditions = None
    if candidate:
        from asi_analysis.paper.calibration.quantities import read_best
        values, conditions = read_best(candidate)
    with bar() as told:
        result = reproduction.reproduce(values, conditions, told)
        document = reproduction.as_document(result)
        if report:
            from asi_analysis.paper.reproduction.report import write_reproduction_report
            told('report', None)
            document['report'] = str(write_reproduction_report(result, report))
        if over_ros:
            document['over_ros'] = [reproduction.as_dict(each) for each
                                    in reproduction.over_ros(result, over_ros, told)]
    answer(document, as_json, reproduction.as_text)
    if not all(each['equal'] for each in document['over_ros']):
        raise typer.Exit(1)


@command('limit-cycle', 'asi limit-cycle runs/from_inside/bag runs/from_outside/bag')
def limit_cycle(
    bags: Annotated[list[Path] | None, typer.Argument(
        help='Bags of the same loop, judged together')] = None,
    signal: Annotated[str | None, typer.Option(
        help='Signal to judge; by default the force, or the first other that is there')] = None,
    report: Report = None,
    check: Annotated[int | None, typer.Option(
        min=1, help='No bag: so many signals of known truth in each class instead')] = None,
    seed: Annotated[int, typer.Option(min=0, help='Of --check: which signals')] = 1,
    as_json: Json = False,
) -> None:
    """Say of each stretch of a recording whether it is a limit cycle, and how surely."""
    from asi_analysis.limit_cycle.detection import answer as limit_cycle_answer
    if check is not None:
        from asi_analysis.limit_cycle.detection import check as limit_cycle_check
        with bar() as told:
            document = limit_cycle_check.check(check, seed, told)
        answer(document, as_json, limit_cycle_check.as_text)
        return
    from asi_analysis.bags.bag import read_bag
    if not bags:
        raise InputError('limit-cycle takes at least one bag, or --check')
    with bar() as told:
        told('reading', None)
        runs = [read_bag(bag) for bag in bags]
        told('judging', None)
        document = limit_cycle_answer.limit_cycle(runs, signal)
        if report:
            from asi_analysis.limit_cycle.detection.figure import drawn
            from asi_analysis.reporting.report import write_pictures
            write_pictures(report, 'Limit cycles', limit_cycle_answer.as_text(document),
                           drawn(runs, document))
    answer(document, as_json, limit_cycle_answer.as_text)


@command('predict', 'asi predict --steps 20,100,300,600 --report runs/prediction')
def predict(
    compensator: Compensator = None,
    gain: Annotated[float, typer.Option(
        help='Where the search for a cycle begins: below the onset')] = 5.0,
    step: Held = 100.0,
    steps: Annotated[str, typer.Option(
        help='Steps (N, with commas) for which the onset is wanted too: Fig. 7')] = '',
    rate: Rate = 5000.0,
    set_: Settings = None,
    report: Report = None,
    as_json: Json = False,
) -> None:
    """
    Predict the limit cycles of a loop from its model, and simulate them beside.

    By the describing function of the hysteresis alone, as the paper, and by the harmonic balance
    of all nonlinearities; the rate and its hold included.
    """
    values = _configured(set_, compensator, gain, step, rate)
    sizes = _numbers('--steps', steps)
    from asi_analysis.limit_cycle.prediction import predict as prediction
    with bar() as told:
        document = prediction.predict(values['actuator'], values['controller'], rate, gain,
                                      sizes, told)
        if report:
            from asi_analysis.limit_cycle.prediction.figures import drawn
            from asi_analysis.reporting.report import write_pictures
            at = document['onset_gain'] or gain
            loop = prediction.loop_of(values['actuator'],
                                      prediction.with_gain(values['controller'], 1.2 * at), rate)
            write_pictures(report, 'Predicted limit cycles', prediction.as_text(document),
                           drawn(loop, document))
    answer(document, as_json, prediction.as_text)


@command('attribute', 'asi attribute --step 100')
def attribute(
    bag: Annotated[Path | None, typer.Argument(
        help='A bag with an oscillation; without one, the model is asked')] = None,
    compensator: Compensator = None,
    gain: Annotated[float | None, typer.Option(
        help='Gain at which cycles are compared; by default a little above the onset')] = None,
    step: Held = 100.0,
    rate: Rate = 5000.0,
    set_: Settings = None,
    signal: Annotated[str | None, typer.Option(help='Output to judge in the bag')] = None,
    report: Report = None,
    as_json: Json = False,
) -> None:
    """
    Say which nonlinearity causes a limit cycle.

    Of the model: each alone, and all but it. Of a bag: by the shape of command and output, for
    any loop; a bag of this actuator is compared with what its model makes of each.
    """
    if bag is not None:
        from asi_analysis.bags.bag import read_bag
        from asi_analysis.limit_cycle.attribution import recording
        with bar() as told:
            run = read_bag(bag)
            document = recording.attribute_run(run, signal, told)
            if report:
                from asi_analysis.limit_cycle.attribution import figure
                from asi_analysis.reporting.report import write_pictures
                # A bag of this actuator is judged by its model.
                drawn = (figure.model(document) if document['causes'][0]['share'] is not None else
                         figure.recorded(run, document, signal))
                write_pictures(report, 'What makes it swing', recording.as_text(document),
                               {'attribution': (drawn, document['verdict'])})
        answer(document, as_json, recording.as_text)
        return
    values = _configured(set_, compensator, gain, step, rate)
    from asi_analysis.limit_cycle.attribution import ablation
    with bar() as told:
        document = ablation.attribute(values['actuator'], values['controller'], rate, gain, told)
        if report:
            from asi_analysis.limit_cycle.attribution import figure
            from asi_analysis.reporting.report import write_pictures
            write_pictures(report, 'Which nonlinearity', ablation.as_text(document),
                           {'attribution': (figure.model(document), document['verdict'])})
    answer(document, as_json, ablation.as_text)


@command('quench', 'asi quench --compensator lead4 --conditions 300 --designs 200')
def quench(
    compensator: Compensator = None,
    gain: Gain = None,
    step: Annotated[float, typer.Option(help='Force at which dither is tried, N')] = 100.0,
    conditions: Annotated[int, typer.Option(
        help='Conditions that the attack tries', min=1)] = 200,
    rates: Annotated[str, typer.Option(
        help='Control rates of the attack, Hz; the first is that of margin and design')] = '5000',
    designs: Annotated[int, typer.Option(
        help='Candidates of the design helper; 0: none', min=0)] = 0,
    seed: Annotated[int, typer.Option(help='Seed of attack and design', min=0)] = 1,
    replay: Annotated[int, typer.Option(
        help='How many of the worst finds to run over ROS', min=0)] = 0,
    out: Annotated[Path, typer.Option(
        callback=_directory,
        help='Directory for the bags of --replay')] = Path('runs/quench'),
    set_: Settings = None,
    report: Report = None,
    jobs: Jobs = 1,
    dask: Dask = None,
    as_json: Json = False,
) -> None:
    """
    Measure how far a compensator is from a limit cycle, and attack it.

    Exit status 1 if a sustained oscillation was found.
    """
    rates_hz = _numbers('--rates', rates)
    values = _configured(set_, compensator, gain, step, *rates_hz)
    from asi_analysis.limit_cycle.quench import answer as quench_answer
    from asi_analysis.parallel import workers
    with workers(jobs, dask), bar() as told:
        document = quench_answer.quench(values['actuator'], values['controller'], rates_hz,
                                        conditions, seed, designs,
                                        (replay, out) if replay else None, told)
        if report:
            from asi_analysis.limit_cycle.quench.figure import draw
            from asi_analysis.reporting.report import write_pictures
            write_pictures(report, 'Limit cycles quenched', quench_answer.as_text(document), {
                'quench': (draw(values['actuator'], values['controller'], document),
                           'Loop and -1/N where the margin is least; the trade-off of designs')})
    answer(document, as_json, quench_answer.as_text)
    if document['sustained_found']:
        raise typer.Exit(1)


def _configured(settings: list[str] | None, compensator: str | None, gain: float | None,
                step: float, *rates_hz: float) -> dict[str, dict[str, Any]]:
    """Return parameters of actuator and controller, checked at each rate; a step is asked."""
    from asi_analysis.experiments import experiment as ex
    values = ex.gather({'actuator': None, 'controller': None}, settings or [],
                       {'controller': {'compensator': compensator, 'gain': gain,
                                       'reference.shape': 'step', 'reference.amplitude': step}},
                       1.0)
    if not rates_hz or 0.0 in rates_hz:
        raise InputError('a control rate is needed, above 0 Hz')
    for rate in rates_hz:
        ex.checked(ex.Experiment(values['actuator'], values['controller'], 1.0, 'lockstep', rate))
    return values


def _numbers(option: str, text: str) -> list[float]:
    try:
        numbers = [float(part) for part in text.split(',') if part.strip()]
        if not all(map(math.isfinite, numbers)):
            raise ValueError
        return numbers
    except ValueError:
        raise InputError(f'{option} {text}: it takes numbers with commas between') from None


gap_app = typer.Typer(cls=_or_first('of'), help='The sim-to-real gap: where, which effect, how '
                      'far it shrinks, what to record next.\n\n`asi gap BAG...` diagnoses '
                      'recordings; its options: `asi gap of --help`.', no_args_is_help=True,
                      context_settings={'help_option_names': ['-h', '--help']})
app.add_typer(gap_app, name='gap', epilog='Example: `asi gap real_1 real_2 --model m.yaml`')


@gap_app.command('of', epilog='Example: `asi gap real_1 real_2 --model m.yaml --report why`')
def gap(
    bags: Annotated[list[Path], typer.Argument(help='Recordings of the real machine')],
    model: Annotated[Path | None, typer.Option(
        help='Nominal parameters: a ROS parameter file; default: config/actuator.yaml')] = None,
    plant: Annotated[Literal['actuator', 'joint'], typer.Option(
        help='actuator: the hydraulic one; joint: any rigid joint or drive')] = 'actuator',
    held_out: Annotated[list[Path] | None, typer.Option(
        help='A recording that is only judged on; may be repeated')] = None,
    tolerance: Annotated[float, typer.Option(
        help='How far off the nominal parameters may be, as a share')] = 0.2,
    drive: Annotated[Literal['force', 'position'] | None, typer.Option(
        help='Of a joint; default: told from the signals')] = None,
    report: Annotated[Path | None, typer.Option(
        callback=_directory,
        help='Directory for an HTML report and the improved model file')] = None,
    as_json: Json = False,
) -> None:
    """Tell where recordings differ from the simulator, why, and how far that can be mended."""
    from asi_analysis.gap.answer import command as gap_command
    from asi_analysis.gap.answer.show import as_text
    with bar() as told:
        document = gap_command.run(bags, model, plant, held_out or [], tolerance, drive, report,
                                   told)
    answer(document, as_json, as_text)


@gap_app.command('check', epilog='Example: `asi gap check --cases 60 --seed 20000`')
def gap_check(
    directory: Annotated[Path | None, typer.Argument(
        help='Blind cases of any examiner (doc/explanation/gap.md); '
             'default: new ones are written')] = None,
    cases: Annotated[int, typer.Option(help='How many new cases to write', min=1)] = 300,
    seed: Annotated[int, typer.Option(
        min=0, help='First seed of the new cases; those below 10000 were developed on')] = 20000,
    world: Annotated[Literal['textbook', 'full', 'foreign'], typer.Option(
        help='Nominal model of new cases; textbook: every effect off; foreign: other machines, '
             'courses and noise, small effects everywhere')] = 'textbook',
    load: Annotated[Literal['spring', 'locked'], typer.Option(
        help='Load of new cases')] = 'spring',
    signals: Annotated[
        Literal['all', 'no_valve', 'no_velocity', 'no_position', 'force_only'], typer.Option(
            help='What new cases record')] = 'all',
    jobs: Jobs = 2,
    dask: Dask = None,
    out: Annotated[Path, typer.Option(
        callback=_directory,
        help='Directory for new cases; one that the same call left undone is gone on with')
    ] = Path('runs/gap_check'),
    as_json: Json = False,
) -> None:
    """Diagnose blind cases, then open the sealed answers and say how often it was right."""
    from asi_analysis.gap.check.check import as_text, check
    from asi_analysis.parallel import workers
    with workers(jobs, dask), bar() as told:
        if directory is None:
            from asi_examiner.bags import write_cases
            for done in write_cases(out, cases, seed, world, load, signals):
                told(f'{done} of {cases} cases written', done / cases)
        document = check(directory or out, told)
    answer(document, as_json, as_text)


@command('calibrate', 'asi calibrate --evaluations 2000 --jobs 2 --out runs/calibration')
def calibrate(
    evaluations: Annotated[int, typer.Option(
        help='Candidates of the global search, with those of an earlier call', min=0)] = 2000,
    polish: Annotated[int, typer.Option(
        help='Most rounds of successive linear programs from the best', min=0)] = 20,
    structure: Annotated[Literal['side', 'cylinder', 'one-load'], typer.Option(
        help='What is searched')] = 'side',
    seed: Annotated[int, typer.Option(help='Seed of the search', min=0)] = 1,
    spread: Annotated[float, typer.Option(
        help='First spread of the search, share of the range of each parameter')] = 0.1,
    start: Annotated[Path | None, typer.Option(
        help='best.json of an earlier calibration to start from; default: the defaults')] = None,
    only: Annotated[list[str] | None, typer.Option(
        help='Leave free only this quantity; may be repeated')] = None,
    jobs: Jobs = 1,
    dask: Dask = None,
    out: Annotated[Path, typer.Option(
        callback=_directory,
        help='Directory of state and result; a search that is there is gone on with')
    ] = Path('runs/calibration'),
    front: Annotated[str | None, typer.Option(
        help='NAME=V1,V2,…: hold a quantity at each value, polish the rest, and show the cost')
    ] = None,
    as_json: Json = False,
) -> None:
    """Fit the model's free parameters to the facts that the paper publishes."""
    if front:
        from asi_analysis.paper.calibration import front as front_
        with bar() as told:
            document = front_.run(front, start, polish, out, told)
        answer(document, as_json, front_.as_text)
        return
    from asi_analysis.paper.calibration import answer as calibration
    from asi_analysis.parallel import workers
    with workers(jobs, dask), bar() as told:
        document = calibration.run(out, structure, evaluations, polish, seed, spread, start,
                                   only or [], told)
    answer(document, as_json, calibration.as_text)


@command('ensemble', 'asi ensemble --count 20')
def ensemble(
    count: Annotated[int, typer.Option(help='Members wanted', min=1)] = 20,
    most: Annotated[int, typer.Option(help='Candidates to try at most', min=1)] = 1500,
    seed: Annotated[int, typer.Option(help='Seed of the draws', min=0)] = 1,
    out: Annotated[Path, typer.Option(
        callback=_directory, help='Directory of the members')] = Path('config/ensemble'),
    pictures: Annotated[Path, typer.Option(
        callback=_directory,
        help='Directory of the pictures and the sensitivity table')] = Path(
        'doc/explanation/reproduction'),
    jobs: Jobs = 1,
    dask: Dask = None,
    as_json: Json = False,
) -> None:
    """Find parameter sets about the defaults that meet the paper's facts about equally well."""
    from asi_analysis.paper.calibration import ensemble as ensemble_
    from asi_analysis.parallel import workers
    with workers(jobs, dask), bar() as told:
        document = ensemble_.run(out, pictures, count, most, seed, told)
    answer(document, as_json, ensemble_.as_text)


def main() -> int:
    """
    Run the command; return the exit status.

    0: answered; 1: a check or a run failed; 2: the input or the call is wrong (InputError, or a
    file that cannot be read or written), said in one line on stderr; 130: Ctrl-C.
    """
    warnings.showwarning = lambda message, *_: print(f'asi: {message}', file=sys.stderr)
    # Typer brings its own copy of click; this is its ClickException.
    click_exception: Any = typer.BadParameter.__mro__[2]
    try:
        status = app(prog_name='asi', standalone_mode=False) or 0
        return _fail('interrupted', status) if status == 130 else status   # typer's, of Ctrl-C
    except InputError as error:
        return _fail(str(error), 2)
    except ValueError as error:
        from asi_common.parameter import ParameterError
        if not isinstance(error, ParameterError):
            raise
        return _fail(str(error), 2)
    except MemoryError:
        return _fail('there is not enough memory for this', 2)
    except OSError as error:
        return _fail(f'{error.filename}: {error.strerror}' if error.filename else str(error), 2)
    except RuntimeError as error:
        return _fail(str(error), 1)
    except click_exception as error:
        said = error.format_message().rstrip('.')
        where = error.ctx.command_path if getattr(error, 'ctx', None) else 'asi'
        # Called without anything, a command has shown its help already.
        return _fail(f'{said} (see {where} --help)', 2) if said else 2


def _fail(text: str, status: int) -> int:
    print(f'asi: {" ".join(text.split())}', file=sys.stderr)
    return status


if __name__ == '__main__':
    sys.exit(main())
