"""
The `asi` command: reads the command line, calls, prints.

No logic, and nothing heavy is imported before a command needs it.

A new command is one function with @command; what it raises becomes the exit status (see `main`).
"""

import json
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
import typer.core

from asi_analysis.errors import InputError

app = typer.Typer(
    help='Run, record and understand a force-controlled hydraulic actuator.',
    no_args_is_help=True, add_completion=False, rich_markup_mode='markdown',
    pretty_exceptions_enable=False,
    context_settings={'help_option_names': ['-h', '--help']})

Json = Annotated[bool, typer.Option('--json', help='Print one JSON document (doc/json.md).')]


Report = Annotated[Path | None, typer.Option(
    help='Directory for an HTML report and its pictures as PNG')]


Settings = Annotated[list[str] | None, typer.Option(
    '--set', metavar='NODE.NAME=VALUE',
    help='Any other parameter, as actuator.load.mass=0.3; may be repeated')]


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


def answer(document: Mapping[str, Any], as_json: bool, show: Callable[[Any], None]) -> None:
    """Print an answer: as one JSON document, or for people by `show(document)`."""
    if as_json:
        print(json.dumps(document, indent=2, allow_nan=False))
    else:
        show(document)


@contextmanager
def progress() -> Iterator[Callable[[str, float | None], None]]:
    """Give report(what is going on, share done or None): a bar on stderr, gone at the end."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
    console = Console(stderr=True)
    with Progress(SpinnerColumn(), TextColumn('{task.description}'), BarColumn(),
                  TimeElapsedColumn(), console=console, transient=True,
                  disable=not console.is_terminal) as bars:
        task = bars.add_task('', total=None)

        def report(text: str, share: float | None = None) -> None:
            bars.update(task, description=text, total=None if share is None else 1.0,
                        completed=share or 0.0)

        yield report


@command('run', 'asi run --compensator lead_lag --gain 20 --step 500 --duration 1')
def run(
    compensator: Annotated[str | None, typer.Option(
        help='proportional, lead_lag, lead2, lead4 or custom')] = None,
    gain: Annotated[float | None, typer.Option(help='Its gain; 0: its own default')] = None,
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
    seed: Annotated[int | None, typer.Option(help='Seed of sensor noise and PRBS')] = None,
    actuator: Annotated[Path | None, typer.Option(help='ROS parameter file (YAML)')] = None,
    controller: Annotated[Path | None, typer.Option(help='ROS parameter file (YAML)')] = None,
    set_: Annotated[list[str] | None, typer.Option(
        '--set', metavar='NODE.NAME=VALUE',
        help='Any other parameter, as actuator.load.mass=0.3; may be repeated')] = None,
    out: Annotated[Path | None, typer.Option(
        help='Directory for bag and logs; default: runs/TIME-COMPENSATOR')] = None,
    experiment: Annotated[str | None, typer.Option(
        help='isolation: two runs that show whether a limit cycle is isolated')] = None,
    as_json: Json = False,
) -> None:
    """
    Run one experiment over ROS: start the nodes, record a bag, analyse it.

    The later wins: parameter files, then --set, then the options by name.
    """
    from asi_analysis import experiment as ex
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
    if experiment not in (None, 'isolation'):
        raise InputError(f'--experiment {experiment}: it takes isolation')
    out = out or ex.free_directory(Path('runs'), str(wanted.controller['compensator']))
    if experiment:
        from asi_analysis.limit_cycle import answer as limit_cycle_answer
        from asi_analysis.limit_cycle.experiment import isolation
        with progress() as report:
            document = isolation(wanted, out, report)
        answer(document, as_json, lambda d: print(limit_cycle_answer.as_text(d)))
        return
    try:
        with progress() as report:
            bag = ex.run_experiment(wanted, out, report)
            document = ex.run_as_dict(wanted, bag)
    except KeyboardInterrupt:
        raise typer.Exit(_fail(f'interrupted; what was recorded is in {out / "bag"}', 130)
                         ) from None
    answer(document, as_json, _show_run)


@command('analyze', 'asi analyze runs/demo/lead_lag/bag')
def analyze(
    bag: Annotated[Path, typer.Argument(help='A bag: its directory or its .mcap file')],
    as_json: Json = False,
) -> None:
    """Measure step response, bandwidth and oscillation of a recorded run."""
    from asi_analysis.analysis import analyze_bag
    answer(analyze_bag(bag), as_json, _show_analysis)


@command('import', 'asi import log.csv --map time=t[ms] --map force=load_cell*250[N] --out mine')
def import_(
    file: Annotated[Path, typer.Argument(
        help='.csv, .tsv, .txt, .dat (or .gz), .mat, .npz, .parquet')],
    out: Annotated[Path, typer.Option(help='The bag to write')],
    map_: Annotated[list[str] | None, typer.Option(
        '--map', metavar='SIGNAL=COLUMN[*SCALE][+OFFSET][UNIT]',
        help='What a column is; once a signal; none for a file of `asi export`')] = None,
    rate: Annotated[float | None, typer.Option(
        help='Samples a second, if no column is the time')] = None,
    skip_lines: Annotated[int, typer.Option(help='Lines before the header')] = 0,
    delimiter: Annotated[str | None, typer.Option(help='Default: found out')] = None,
    columns: Annotated[str | None, typer.Option(
        help='Names, with commas between, for a file without a header')] = None,
    zero: Annotated[float, typer.Option(
        help='Take off each signal its mean over so many seconds from the start')] = 0.0,
    as_json: Json = False,
) -> None:
    """
    Make a bag of someone else's recording, so that every analysis runs on it.

    Signals: time, reference, command, force, valve_position, position, velocity. More in
    doc/importing.md.
    """
    from asi_analysis.importing import import_recording
    with progress() as report:
        report(f'reading {file}', None)
        imported = import_recording(
            file, map_ or [], rate, skip_lines=skip_lines, delimiter=delimiter,
            columns=columns.split(',') if columns else None, zero_s=zero, out=out)
    answer({'bag': str(out), 'samples': len(imported), 'duration_s': imported.duration_s,
            'rate_hz': imported.rate_hz, 'signals': list(imported.signals())}, as_json,
           lambda document: print(f'{imported}\nbag: {out}'))


@command('export', 'asi export runs/demo/lead_lag/bag --out lead_lag.csv')
def export(
    bag: Annotated[Path, typer.Argument(help='A bag: its directory or its .mcap file')],
    out: Annotated[Path, typer.Option(help='The .csv or .parquet file to write')],
    as_json: Json = False,
) -> None:
    """Write a bag's signals as a table: CSV or Parquet, with the units in the names."""
    from asi_analysis.bag import read_bag
    from asi_analysis.exporting import export as write_table
    recorded = read_bag(bag)
    write_table(recorded, out)
    answer({'file': str(out), 'samples': len(recorded), 'signals': list(recorded.signals())},
           as_json, lambda document: print(f'{out}: {document["samples"]} rows, '
                                           + ', '.join(document['signals'])))


@command('demo', 'asi demo --out runs/demo')
def demo(
    out: Annotated[Path, typer.Option(
        help='Directory of the report; an earlier demo there is replaced')] = Path('runs/demo'),
    as_json: Json = False,
) -> None:
    """Run the paper's experiments over ROS and write a report: OUT/report.html."""
    from asi_analysis.demo import run_demo
    with progress() as report:
        document = run_demo(out, report)
    answer(document, as_json, _show_demo)


@command('reproduce', 'asi reproduce --report runs/reproduction')
def reproduce(
    actuator: Annotated[Path | None, typer.Option(help='ROS parameter file (YAML)')] = None,
    candidate: Annotated[Path | None, typer.Option(
        help='best.json of a calibration: parameters and conditions')] = None,
    report: Annotated[Path | None, typer.Option(
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
    from asi_analysis import reproduction
    from asi_analysis.experiment import read_parameters
    values: Mapping[str, Any] = read_parameters(actuator, 'actuator') if actuator else {}
    conditions = None
    if candidate:
        from asi_analysis.calibration import read_best
        values, conditions = read_best(candidate)
    with progress() as told:
        result = reproduction.reproduce(values, conditions, told)
        document = reproduction.as_document(result)
        if report:
            from asi_analysis.reproduction_report import write_report
            told('report', None)
            document['report'] = str(write_report(result, report))
        if over_ros:
            document['over_ros'] = [reproduction.as_dict(each) for each
                                    in reproduction.over_ros(result, over_ros, told)]
    answer(document, as_json, reproduction.show)
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
    from asi_analysis.limit_cycle import answer as limit_cycle_answer
    if check is not None:
        from asi_analysis.limit_cycle import check as limit_cycle_check
        with progress() as told:
            document = limit_cycle_check.check(check, seed, told)
        answer(document, as_json, lambda d: print(limit_cycle_check.as_text(d)))
        return
    from asi_analysis.bag import read_bag
    if not bags:
        raise InputError('limit-cycle takes at least one bag, or --check')
    with progress() as told:
        told('reading', None)
        runs = [read_bag(bag) for bag in bags]
        told('judging', None)
        document = limit_cycle_answer.limit_cycle(runs, signal)
        if report:
            from asi_analysis.limit_cycle.figure import drawn
            _write_report(report, 'Limit cycles', limit_cycle_answer.as_text(document),
                          drawn(runs, document))
    answer(document, as_json, lambda d: print(limit_cycle_answer.as_text(d)))


@command('predict', 'asi predict --steps 20,100,300,600 --report runs/prediction')
def predict(
    compensator: Annotated[str | None, typer.Option(
        help='proportional, lead_lag, lead2, lead4 or custom')] = None,
    gain: Annotated[float, typer.Option(
        help='Where the search for a cycle begins: below the onset')] = 5.0,
    step: Annotated[float, typer.Option(help='Force that the loop is to hold, N')] = 100.0,
    steps: Annotated[str, typer.Option(
        help='Steps (N, with commas) for which the onset is wanted too: Fig. 7')] = '',
    rate: Annotated[float, typer.Option(help='Control rate, Hz')] = 5000.0,
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
    from asi_analysis.prediction import predict as prediction
    with progress() as told:
        document = prediction.predict(values['actuator'], values['controller'], rate, gain,
                                      sizes, told)
        if report:
            from asi_analysis.prediction.figures import drawn
            at = document['onset_gain'] or gain
            loop = prediction.loop_of(values['actuator'],
                                      prediction.with_gain(values['controller'], 1.2 * at), rate)
            _write_report(report, 'Predicted limit cycles', prediction.as_text(document),
                          drawn(loop, document))
    answer(document, as_json, lambda d: print(prediction.as_text(d)))


@command('attribute', 'asi attribute --step 100')
def attribute(
    bag: Annotated[Path | None, typer.Argument(
        help='A bag with an oscillation; without one, the model is asked')] = None,
    compensator: Annotated[str | None, typer.Option(
        help='proportional, lead_lag, lead2, lead4 or custom')] = None,
    gain: Annotated[float | None, typer.Option(
        help='Gain at which cycles are compared; by default a little above the onset')] = None,
    step: Annotated[float, typer.Option(help='Force that the loop is to hold, N')] = 100.0,
    rate: Annotated[float, typer.Option(help='Control rate, Hz')] = 5000.0,
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
        from asi_analysis.attribution import recording
        from asi_analysis.bag import read_bag
        with progress() as told:
            run = read_bag(bag)
            document = recording.attribute_run(run, signal, told)
            if report:
                from asi_analysis.attribution import figure
                # A bag of this actuator is judged by its model.
                drawn = (figure.model(document) if document['causes'][0]['share'] is not None else
                         figure.recorded(run, document, signal))
                _write_report(report, 'What makes it swing', recording.as_text(document),
                              {'attribution': (drawn, document['verdict'])})
        answer(document, as_json, lambda d: print(recording.as_text(d)))
        return
    values = _configured(set_, compensator, gain, step, rate)
    from asi_analysis.attribution import ablation
    with progress() as told:
        document = ablation.attribute(values['actuator'], values['controller'], rate, gain, told)
        if report:
            from asi_analysis.attribution import figure
            _write_report(report, 'Which nonlinearity', ablation.as_text(document),
                          {'attribution': (figure.model(document), document['verdict'])})
    answer(document, as_json, lambda d: print(ablation.as_text(d)))


@command('quench', 'asi quench --compensator lead4 --conditions 300 --designs 200')
def quench(
    compensator: Annotated[str | None, typer.Option(
        help='proportional, lead_lag, lead2, lead4 or custom')] = None,
    gain: Annotated[float | None, typer.Option(help='Its gain; 0: its own default')] = None,
    step: Annotated[float, typer.Option(help='Force at which dither is tried, N')] = 100.0,
    conditions: Annotated[int, typer.Option(help='Conditions that the attack tries')] = 200,
    rates: Annotated[str, typer.Option(
        help='Control rates of the attack, Hz; the first is that of margin and design')] = '5000',
    designs: Annotated[int, typer.Option(
        help='Candidates of the design helper; 0: none')] = 0,
    seed: Annotated[int, typer.Option(help='Seed of attack and design')] = 1,
    replay: Annotated[int, typer.Option(
        help='How many of the worst finds to run over ROS')] = 0,
    out: Annotated[Path, typer.Option(
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
    if not rates_hz or conditions < 1:
        raise InputError('--rates takes at least one rate, --conditions at least 1')
    values = _configured(set_, compensator, gain, step, rates_hz[0])
    from asi_analysis.parallel import workers
    from asi_analysis.quench import answer as quench_answer
    with workers(jobs, dask), progress() as told:
        document = quench_answer.quench(values['actuator'], values['controller'], rates_hz,
                                        conditions, seed, designs,
                                        (replay, out) if replay else None, told)
        if report:
            from asi_analysis.quench.figure import draw
            _write_report(report, 'Limit cycles quenched', quench_answer.as_text(document), {
                'quench': (draw(values['actuator'], values['controller'], document),
                           'Loop and -1/N where the margin is least; the trade-off of designs')})
    answer(document, as_json, lambda d: print(quench_answer.as_text(d)))
    if document['sustained_found']:
        raise typer.Exit(1)


def _write_report(directory: Path, title: str, text: str, drawn: dict[str, Any]) -> None:
    from asi_analysis.cycle_report import write_report
    write_report(directory, title, text, drawn)


def _configured(settings: list[str] | None, compensator: str | None, gain: float | None,
                step: float, rate: float) -> dict[str, dict[str, Any]]:
    """Return the parameters of actuator and controller, checked; the reference is a step."""
    from asi_analysis import experiment as ex
    values = ex.gather({'actuator': None, 'controller': None}, settings or [],
                       {'controller': {'compensator': compensator, 'gain': gain,
                                       'reference.shape': 'step', 'reference.amplitude': step}},
                       1.0)
    ex.checked(ex.Experiment(values['actuator'], values['controller'], 1.0, 'lockstep', rate))
    return values


def _numbers(option: str, text: str) -> list[float]:
    try:
        return [float(part) for part in text.split(',') if part.strip()]
    except ValueError:
        raise InputError(f'{option} {text}: it takes numbers with commas between') from None


gap_app = typer.Typer(cls=_or_first('of'), help='The sim-to-real gap: where, which effect, how '
                      'far it shrinks, what to record next.',
                      context_settings={'help_option_names': ['-h', '--help']})
app.add_typer(gap_app, name='gap', epilog='Example: `asi gap real_1 real_2 --model m.yaml`')


@gap_app.command('of', help='Diagnose bags; the same as `asi gap BAG...`.')
def gap(
    bags: Annotated[list[Path], typer.Argument(help='Recordings of the real machine')],
    model: Annotated[Path | None, typer.Option(
        help='Nominal parameters: a ROS parameter file; default: config/actuator.yaml')] = None,
    plant: Annotated[str, typer.Option(
        help='actuator: the hydraulic one; joint: any rigid joint or drive')] = 'actuator',
    held_out: Annotated[list[Path] | None, typer.Option(
        help='A recording that is only judged on; may be repeated')] = None,
    tolerance: Annotated[float, typer.Option(
        help='How far off the nominal parameters may be, as a share')] = 0.2,
    drive: Annotated[str | None, typer.Option(
        help='Of a joint: force or position; default: told from the signals')] = None,
    report: Annotated[Path | None, typer.Option(
        help='Directory for an HTML report and the improved model file')] = None,
    as_json: Json = False,
) -> None:
    """Tell where recordings differ from the simulator, why, and how far that can be mended."""
    from asi_analysis.gap import command as gap_command
    from asi_analysis.gap.show import show
    with progress() as told:
        document = gap_command.run(bags, model, plant, held_out or [], tolerance, drive, report,
                                   told)
    answer(document, as_json, show)


@gap_app.command('check', epilog='Example: `asi gap check --cases 60 --seed 20000`')
def gap_check(
    directory: Annotated[Path | None, typer.Argument(
        help='Blind cases of any examiner (doc/gap.md); default: new ones are written')] = None,
    cases: Annotated[int, typer.Option(help='How many new cases to write', min=1)] = 300,
    seed: Annotated[int, typer.Option(
        help='First seed of the new cases; those below 10000 were developed on')] = 20000,
    world: Annotated[str, typer.Option(
        help='Nominal model of new cases: textbook (every effect off), full, or foreign (other '
             'machines, courses and noise, small effects everywhere)')] = 'textbook',
    load: Annotated[str, typer.Option(help='Load of new cases: spring or locked')] = 'spring',
    signals: Annotated[str, typer.Option(
        help='Of new cases: all, no_valve, no_velocity, no_position or force_only')] = 'all',
    jobs: Jobs = 2,
    dask: Dask = None,
    out: Annotated[Path, typer.Option(
        help='Directory for new cases; one that the same call left undone is gone on with')
    ] = Path('runs/gap_check'),
    as_json: Json = False,
) -> None:
    """Diagnose blind cases, then open the sealed answers and say how often it was right."""
    from asi_analysis.gap.check import check, show
    from asi_analysis.parallel import workers
    for name, value, allowed in (
            ('--world', world, ('textbook', 'full', 'foreign')),
            ('--load', load, ('spring', 'locked')),
            ('--signals', signals, ('all', 'no_valve', 'no_velocity', 'no_position',
                                    'force_only'))):
        if value not in allowed:
            raise InputError(f'{name} {value!r} is not allowed: one of {", ".join(allowed)}')
    with workers(jobs, dask), progress() as told:
        if directory is None:
            from asi_examiner.bags import write_cases
            for done in write_cases(out, cases, seed, world, load, signals):
                told(f'{done} of {cases} cases written', done / cases)
        document = check(directory or out, told)
    answer(document, as_json, show)


@command('calibrate', 'asi calibrate --evaluations 2000 --jobs 2 --out runs/calibration')
def calibrate(
    evaluations: Annotated[int, typer.Option(
        help='Candidates of the global search, with those of an earlier call', min=0)] = 2000,
    polish: Annotated[int, typer.Option(
        help='Most rounds of successive linear programs from the best', min=0)] = 20,
    structure: Annotated[str, typer.Option(
        help='What is searched: side, cylinder or one-load')] = 'side',
    seed: Annotated[int, typer.Option(help='Seed of the search')] = 1,
    spread: Annotated[float, typer.Option(
        help='First spread of the search, share of the range of each parameter')] = 0.1,
    start: Annotated[Path | None, typer.Option(
        help='best.json of an earlier calibration to start from; default: the defaults')] = None,
    only: Annotated[list[str] | None, typer.Option(
        help='Leave free only this quantity; may be repeated')] = None,
    jobs: Jobs = 1,
    dask: Dask = None,
    out: Annotated[Path, typer.Option(
        help='Directory of state and result; a search that is there is gone on with')
    ] = Path('runs/calibration'),
    front: Annotated[str | None, typer.Option(
        help='NAME=V1,V2,…: hold a quantity at each value, polish the rest, and show the cost')
    ] = None,
    as_json: Json = False,
) -> None:
    """Fit the model's free parameters to the facts that the paper publishes."""
    if front:
        from asi_analysis import front as front_
        with progress() as told:
            document = front_.run(front, start, polish, out, told)
        answer(document, as_json, front_.show)
        return
    from asi_analysis import calibration
    from asi_analysis.parallel import workers
    with workers(jobs, dask), progress() as told:
        document = calibration.run(out, structure, evaluations, polish, seed, spread, start,
                                   only or [], told)
    answer(document, as_json, calibration.show)


@command('ensemble', 'asi ensemble --count 20')
def ensemble(
    count: Annotated[int, typer.Option(help='Members wanted')] = 20,
    most: Annotated[int, typer.Option(help='Candidates to try at most')] = 1500,
    seed: Annotated[int, typer.Option(help='Seed of the draws')] = 1,
    out: Annotated[Path, typer.Option(help='Directory of the members')] = Path('config/ensemble'),
    pictures: Annotated[Path, typer.Option(
        help='Directory of the pictures and the sensitivity table')] = Path('doc/reproduction'),
    jobs: Jobs = 1,
    dask: Dask = None,
    as_json: Json = False,
) -> None:
    """Find parameter sets about the defaults that meet the paper's facts about equally well."""
    from asi_analysis import ensemble as ensemble_
    from asi_analysis.parallel import workers
    with workers(jobs, dask), progress() as told:
        document = ensemble_.run(out, pictures, count, most, seed, told)
    answer(document, as_json, ensemble_.show)


def _figure(value: float | None, unit: str, scale: float = 1.0, digits: int = 4) -> str:
    return '-' if value is None else f'{value * scale:.{digits}g} {unit}'


def _show_run(document: Mapping[str, Any]) -> None:
    print(f'{document["compensator"]}, {document["mode"]}, {document["ticks"]} ticks')
    _show_analysis(document)


def _show_analysis(document: Mapping[str, Any]) -> None:
    """Print what could be measured as a table; the notes say why the rest could not."""
    from rich.console import Console
    from rich.table import Table
    table = Table(show_header=False, box=None, pad_edge=False)
    for name, key, unit, scale in (
            ('rise time 10-90 %', 'rise_time_s', 'ms', 1e3),
            ('overshoot', 'overshoot_percent', '%', 1.0),
            ('settling time 2 %', 'settling_time_2_s', 'ms', 1e3),
            ('settling time 5 %', 'settling_time_5_s', 'ms', 1e3),
            ('steady-state error', 'steady_state_error_n', 'N', 1.0),
            ('bandwidth', 'bandwidth_hz', 'Hz', 1.0),
            ('bandwidth of the actuator', 'actuator_bandwidth_hz', 'Hz', 1.0),
            ('delay, from the phase', 'delay_s', 'ms', 1e3),
            ('delay, by correlation', 'correlation_delay_s', 'ms', 1e3)):
        if document[key] is not None:
            table.add_row(name, f'{document[key] * scale:.3g} {unit}')
    table.add_row('oscillation', _oscillation(document['oscillation']))
    print(f'{document["source"]}: {document["samples"]} samples, {document["duration_s"]:.6g} s '
          f'at {document["rate_hz"]:g} Hz')
    Console().print(table)
    for note in document['notes']:
        print(f'note: {note}')


def _oscillation(swing: Mapping[str, Any]) -> str:
    if swing['frequency_hz'] is None:
        return 'none' if swing['sustained'] is False else 'cannot be told'
    return (f'{swing["frequency_hz"]:.1f} Hz, {swing["amplitude_n"]:.3g} N, '
            + ('sustained' if swing['sustained'] else 'dying out'))


def _show_demo(document: Mapping[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table
    table = Table('Table 1', 'published', 'simulated', title_justify='left', box=None)
    for row in document['table_1']:
        value = row['simulated']
        table.add_row(f'{row["compensator"]}: {row["quantity"]}',
                      f'{row["published"]} {row["unit"]}',
                      '-' if value is None else f'{value:.3g} {row["unit"]}')
    Console().print(table)
    for run_ in document['runs']:
        swing = run_['analysis']['oscillation']
        if swing['sustained']:
            print(f'{run_["name"]}: {_oscillation(swing)}')
    print(f'report: {document["report"]}')


def main() -> int:
    """
    Run the command; return the exit status.

    0: answered; 1: a check or a run failed; 2: the input or the call is wrong (InputError, or a
    file that cannot be read or written), said in one line on stderr; 130: Ctrl-C (typer's).
    """
    warnings.showwarning = lambda message, *_: print(f'asi: {message}', file=sys.stderr)
    # Typer brings its own copy of click; this is its ClickException.
    click_exception: Any = typer.BadParameter.__mro__[2]
    try:
        return app(prog_name='asi', standalone_mode=False) or 0
    except InputError as error:
        return _fail(str(error), 2)
    except OSError as error:
        return _fail(f'{error.filename}: {error.strerror}' if error.filename else str(error), 2)
    except RuntimeError as error:
        return _fail(str(error), 1)
    except click_exception as error:
        where = error.ctx.command_path if getattr(error, 'ctx', None) else 'asi'
        return _fail(f'{error.format_message().rstrip(".")} (see {where} --help)', 2)


def _fail(text: str, status: int) -> int:
    print(f'asi: {" ".join(text.split())}', file=sys.stderr)
    return status


if __name__ == '__main__':
    sys.exit(main())
