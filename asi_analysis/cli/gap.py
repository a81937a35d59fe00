"""Commands about the sim-to-real gap: `asi gap BAG...` and `asi gap check`."""

from pathlib import Path
from typing import Annotated, Any, Literal

import typer
import typer.core

from asi_analysis.cli.options import (
    HELP,
    MOST_SEED,
    Dask,
    Jobs,
    Json,
    app,
    command,
    directory,
    new_file,
    show,
)
from asi_analysis.errors import InputError
from asi_analysis.terminal import bar


class GapCommands(typer.core.TyperGroup):
    """Parses `asi gap BAG...` as `asi gap of BAG...`, `asi gap --plan FILE` as `... plan FILE`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if args and args[0].split('=')[0] == '--plan':
            args = ['plan', *args[0].split('=', 1)[1:], *args[1:]]
        if args and args[0] not in {*self.commands, '-h', '--help'}:
            args = ['of', *args]
        return super().parse_args(ctx, args)


gap_app = typer.Typer(cls=GapCommands, help='Find where and why recordings differ from their '
                      'model (the sim-to-real gap).\n\n'
                      '`asi gap BAG...` diagnoses recordings; options: `asi gap of --help`.\n\n'
                      '`asi gap --plan MODEL` plans what to record; options: `asi gap plan '
                      '--help`.', no_args_is_help=True,
                      context_settings=HELP)
app.add_typer(gap_app, name='gap', epilog='Example: `asi gap real_1 real_2 --model m.yaml`')


@command('of', 'asi gap real_1 real_2 --model m.yaml --report why` or '
         '`asi gap arm --plant joint --export arm.xml', gap_app)
def gap(
    bags: Annotated[list[Path], typer.Argument(help='Recordings of the real machine')],
    plan: Annotated[Path | None, typer.Option(
        metavar='MODEL', help='Plan what to record, without recordings; options: `asi gap '
        'plan --help`')] = None,
    model: Annotated[Path | None, typer.Option(
        help='Nominal parameters: a ROS parameter file; default: those in the bag')] = None,
    set_: Annotated[list[str] | None, typer.Option(
        '--set', metavar='NAME=VALUE', help='A nominal parameter, for example load.mass=0.6; '
        'may be repeated')] = None,
    plant: Annotated[Literal['actuator', 'joint', 'static'], typer.Option(
        help='actuator: the hydraulic one; joint: any rigid joint or drive; static: a measured '
        'characteristic, any input to any output')] = 'actuator',
    input_: Annotated[str | None, typer.Option(
        '--input', metavar='SIGNAL', help='Input of a static characteristic; default: the command')
    ] = None,
    output: Annotated[str | None, typer.Option(
        metavar='SIGNAL', help='Output of a static characteristic; default: pressure, force, ...')
    ] = None,
    held_out: Annotated[list[Path] | None, typer.Option(
        help='A recording for validation, which is not fitted; may be repeated')] = None,
    baseline: Annotated[list[Path] | None, typer.Option(
        help='A recording of the same machine when it was healthy; the answer is what has '
        'changed since; may be repeated')] = None,
    tolerance: Annotated[list[str] | None, typer.Option(
        metavar='SHARE|NAME=SHARE', help='Tolerance of the nominal parameters, as a share '
        '(default: 0.2), or of one, such as load.mass=0.5; may be repeated')] = None,
    drive: Annotated[Literal['force', 'position'] | None, typer.Option(
        help='Kind of drive of a joint; default: detected from the signals')] = None,
    report: Annotated[Path | None, typer.Option(
        callback=directory,
        help='Directory for an HTML report and the improved model file')] = None,
    export: Annotated[list[Path] | None, typer.Option(
        metavar='FILE|DIR', help='Write the identified model: a joint as .xml (MJCF of MuJoCo), '
        '.urdf or .isaac.yaml (Isaac Lab); .yaml for our nodes and for --model. With --joint all '
        'one file holds all joints; {joint} in its name, or a directory, makes one for each. May '
        'be repeated')] = None,
    joint: Annotated[str | None, typer.Option(
        metavar='NAME|all', help='Joint of a bag with joint states, or of a folder with a bag '
        'for each joint (asi import with {joint}); all: each joint, in one table')] = None,
    jobs: Jobs = 2,
    as_json: Json = False,
) -> None:
    """
    Find where and why recordings differ from the simulator, and how far the gap shrinks.

    What has changed since healthy recordings: `asi gap today --baseline healthy_1 --baseline
    healthy_2`.
    All joints of a robot: `asi gap robot --plant joint --joint all --jobs 4`.
    """
    from asi_analysis.bags.bag import read_bag
    from asi_analysis.bags.exchange.importing import read_joint, read_joints
    from asi_analysis.gap.answer.command import diagnose, parse_tolerances
    from asi_analysis.gap.answer.export import for_each_joint, format_of
    for path in export or []:   # before the diagnosis, which takes long
        each = for_each_joint(path) if joint == 'all' else None
        format_of(each or path, plant)
        if each is None or each.parent == path.parent:
            new_file(path)
        else:
            directory(path)
    if plan is not None:
        raise InputError(f'--plan {plan} is of what to record, and goes first and without '
                         f'recordings: asi gap --plan {plan}')
    usual, own = parse_tolerances(tolerance or [])
    if joint is not None:
        if plant != 'joint':
            raise InputError(f'--joint {joint} takes --plant joint')
        if joint == 'all':
            from asi_analysis.gap.answer.joints import diagnose_joints
            from asi_analysis.parallel import workers
            with workers(jobs), bar() as progress:
                progress('reading', None)
                show(diagnose_joints(
                    read_joints(bags), read_joints(baseline or []), read_joints(held_out or []),
                    report, progress, export or [], model=model, tolerance=usual, drive=drive,
                    settings=set_ or [], tolerances=own), as_json)
            return
    with bar() as progress:
        progress('reading', None)
        runs, out, healthy = (read_joint(each or [], joint) if joint else
                              [read_bag(bag) for bag in each or []]
                              for each in (bags, held_out, baseline))
        result = diagnose(runs, model, plant, out, usual, drive, progress, set_ or [], own,
                          healthy, (input_, output))
        if report:
            progress('report', None)
            result.write_report(report)
        refused = None
        for path in export or []:
            progress('export', None)
            try:
                result.write_export(path)
            except InputError as error:   # the answer is not lost for it
                refused = error
    show(result, as_json)
    if refused:
        raise refused


@command('plan', 'asi gap --plan joint.yaml --limit position=-45:45[deg] '
         '--limit velocity=90[deg/s] --limit command=5[Nm] --out reference.csv', gap_app)
def gap_plan(
    model: Annotated[Path, typer.Argument(
        help='Nominal parameters of the joint, as --model of asi gap takes them; limit.position '
        'and others of asi_gap may be in it')],
    limit: Annotated[list[str] | None, typer.Option(
        metavar='SIGNAL=VALUE[UNIT]', help='Limits of the joint: position=LOW:HIGH[deg], '
        'velocity=90[deg/s], command=5[Nm]; may be repeated')] = None,
    sensors: Annotated[str, typer.Option(
        help='Signals that can be recorded, separated by commas: command (of a torque or force), '
        'force, position, velocity; or reference,position of a servo')] = 'command,position',
    noise: Annotated[list[str] | None, typer.Option(
        metavar='SIGNAL=VALUE[UNIT]', help='Noise of a signal (standard deviation), for example '
        'position=0.01[deg]; may be repeated')] = None,
    rate: Annotated[float, typer.Option(
        help='Sampling rate of the recording and of the reference, Hz, 50 to 1000')] = 250.0,
    tolerance: Annotated[float, typer.Option(
        help='Tolerance of the nominal parameters, as a share')] = 0.2,
    plant: Annotated[Literal['actuator', 'joint'], typer.Option(
        help='A plan is for a joint only')] = 'joint',
    out: Annotated[Path | None, typer.Option(
        callback=new_file, metavar='FILE.csv', help='The reference to play: time, position')
    ] = None,
    report: Annotated[Path | None, typer.Option(
        callback=directory, help='Directory for an HTML report with a picture of the reference')
    ] = None,
    as_json: Json = False,
) -> None:
    """
    Plan a reference motion whose recording can tell the usual effects of a joint apart.

    The effects are friction, backlash, compliance, delay, lag, gravity, a spring and a wrong
    inertia. The plan says how often each is found, with the given sensors and limits. The same as
    `asi gap --plan MODEL`.
    """
    from asi_analysis.gap.answer.command import parse_tolerances
    from asi_analysis.gap.answer.planned import plan_recording
    if plant != 'joint':
        raise InputError('--plant actuator: a plan is of a joint; of the actuator `asi gap BAG` '
                         'says what to record next, with the `asi run` that records it')
    if out is not None and out.suffix != '.csv':
        raise InputError(f'--out {out}: expected a .csv file')
    usual, _ = parse_tolerances([f'{tolerance!r}'])
    with bar() as progress:
        plan = plan_recording(model, [name.strip() for name in sensors.split(',')], limit or [],
                              noise or [], rate, usual, out, progress)
    show(plan, as_json, report)


@command('check', 'asi gap check --cases 60 --seed 20000', gap_app)
def gap_check(
    directory: Annotated[Path | None, typer.Argument(
        help='Blind cases of any examiner (doc/how_to/blind_cases.md); default: '
             'new ones are written')] = None,
    cases: Annotated[int, typer.Option(help='How many new cases to write', min=1)] = 300,
    seed: Annotated[int, typer.Option(
        min=0, max=MOST_SEED,
        help='First seed of the new cases; below 10000: used in development')] = 20000,
    world: Annotated[Literal[
        'textbook', 'full', 'foreign', 'own', 'joint', 'mixed', 'static'], typer.Option(
        help='Kind of new cases. textbook: linear nominal model; full: the nominal model of '
             'the paper; foreign: other machines, excitations and noise; own: the simulator with '
             'one parameter or effect changed; joint: arms, axes and servos; mixed: joints with '
             'an effect and something outside the vocabulary; static: characteristics')
    ] = 'textbook',
    load: Annotated[Literal['spring', 'locked'], typer.Option(
        help='Load of new cases')] = 'spring',
    signals: Annotated[
        Literal['all', 'no_valve', 'no_velocity', 'no_position', 'force_only'], typer.Option(
            help='What new cases record')] = 'all',
    recordings: Annotated[int, typer.Option(
        min=1, max=20, help='Recordings of each machine, diagnosed together')] = 1,
    beyond: Annotated[float | None, typer.Option(
        min=1.2, max=5.0, help='Every fifth nominal parameter of new cases is off by more than '
        'its tolerance, up to this factor; default: none is')] = None,
    jobs: Jobs = 2,
    dask: Dask = None,
    out: Annotated[Path, typer.Option(
        callback=directory,
        help='Directory for new cases; an unfinished check by the same call is continued')
    ] = Path('runs/gap_check'),
    as_json: Json = False,
) -> None:
    """Diagnose blind cases, then compare with the sealed answers: accuracy and calibration."""
    from asi_analysis.gap.check.check import check
    from asi_analysis.parallel import workers
    with workers(jobs, dask), bar() as progress:
        if directory is None:
            from asi_examiner.bags import write_cases
            progress(f'0 of {cases} cases written', 0.0)
            for done in write_cases(out, cases, seed, world, load, signals, recordings,
                                    beyond):
                progress(f'{done} of {cases} cases written', done / cases)
        result = check(directory or out, progress)
    show(result, as_json)
