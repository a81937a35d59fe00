"""Commands that make and read a recording: run, analyze, import, split, export."""

import sys
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from asi_analysis.cli.options import (
    MOST_SEED,
    Bag,
    Compensator,
    Gain,
    Json,
    ParameterFile,
    Settings,
    checked_step,
    command,
    show,
)
from asi_analysis.errors import InputError
from asi_analysis.terminal import bar


@command('run', 'asi run --compensator lead_lag --gain 20 --step 500 --duration 1')
def run(
    compensator: Compensator = None,
    gain: Gain = None,
    step: Annotated[float | None, typer.Option(
        callback=checked_step,
        help='Size of a step in the reference, N; the same as --reference step --amplitude')
    ] = None,
    reference: Annotated[str | None, typer.Option(
        help='step, ramp, sine, triangle, chirp, multisine, prbs or topic')] = None,
    amplitude: Annotated[float | None, typer.Option(help='Size of the reference, N')] = None,
    offset: Annotated[float | None, typer.Option(
        help='Mean of the reference, N')] = None,
    frequency: Annotated[float | None, typer.Option(
        help='Frequency of the reference; the first or lowest of chirp or multisine, Hz')] = None,
    end_frequency: Annotated[float | None, typer.Option(
        help='Last or highest frequency of chirp or multisine, Hz')] = None,
    load: Annotated[str | None, typer.Option(help='locked, spring, free or prescribed')] = None,
    duration: Annotated[float, typer.Option(help='Length of the run, s')] = 1.0,
    mode: Annotated[str, typer.Option(
        help='lockstep: reproducible on any machine; realtime: on the wall clock')
    ] = 'lockstep',
    rate: Annotated[float, typer.Option(
        help='Control rate, Hz; 0: 5000 in lock-step, 1000 in real time')] = 0.0,
    seed: Annotated[int | None, typer.Option(
        help='Seed of sensor noise and PRBS', min=0, max=MOST_SEED)] = None,
    actuator: ParameterFile = None,
    controller: ParameterFile = None,
    set_: Settings = None,
    plant: Annotated[Literal['actuator', 'joint'], typer.Option(
        help='joint: a joint or drive with its own parameters, in place of the actuator; its '
        'command is the reference (N, Nm; for a servo m or rad)')] = 'actuator',
    out: Annotated[Path | None, typer.Option(
        help='Directory DIR; the bag is DIR/bag; default: runs/TIME-COMPENSATOR')] = None,
    in_process: Annotated[bool, typer.Option(
        '--in-process', help='Simulate in one process, without ROS: the same bag, faster')
    ] = False,
    experiment: Annotated[Literal['isolation'] | None, typer.Option(
        help='isolation: two runs, from inside and outside, that show whether a limit cycle is '
        'isolated')] = None,
    as_json: Json = False,
) -> None:
    """
    Run one experiment over ROS: start the nodes, record a bag, analyse it.

    With --in-process the nodes are not started, and the bag is the same byte for byte.

    Later ones override earlier ones: parameter files, --set, the other options.
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
                        'controller': named}, duration, plant)
    planned = ex.checked(ex.Experiment(values['actuator'], values['controller'], duration, mode,
                                       rate, plant))
    out = running.directory_of(planned, out)
    run_one = running.run_experiment
    if in_process:
        from asi_analysis.loop.in_process import run_in_process
        run_one = run_in_process
    try:
        with bar() as progress:
            if experiment:
                from asi_analysis.limit_cycle.detection.experiment import isolation
                result: Any = isolation(planned, out, progress, run_one)
            else:
                result = running.summary(planned, run_one(planned, out, progress))
    except KeyboardInterrupt:
        from asi_analysis.bags.bag_file import is_empty
        if (out / 'bag').exists() and not is_empty(out / 'bag'):
            print(f'asi: what was recorded is in {out / "bag"}', file=sys.stderr)
        raise
    show(result, as_json)


@command('analyze', 'asi analyze runs/demo/lead_lag/bag')
def analyze(
    bag: Bag,
    signal: Annotated[str | None, typer.Option(
        help='Signal to measure, for example position; default: the controlled one')
    ] = None,
    as_json: Json = False,
) -> None:
    """Measure step response, bandwidth, delay and oscillation of a recorded run."""
    from asi_analysis.bags.bag import read_bag
    from asi_analysis.measures.analysis import analyze as analyze_run
    with bar() as progress:
        progress('reading', None)
        analysis = analyze_run(read_bag(bag), signal)
    show(analysis, as_json)


@command('import', 'asi import log.csv --map time=t[ms] --map force=load_cell*250[N] --out mine')
def import_(
    files: Annotated[list[Path], typer.Argument(
        help='A table (.csv, .txt, .json, .mat, .npz, .parquet and others), the folder of a '
             'LeRobot dataset, a rosbag2 or ROS 1 .bag. Of several tables, each with its time, '
             'the first gives the samples; values of the others are held')],
    out: Annotated[Path | None, typer.Option(
        help='The bag to write; without it and without --map: a preview')] = None,
    map_: Annotated[list[str] | None, typer.Option(
        '--map', metavar='SIGNAL=COLUMN[*SCALE][+OFFSET][UNIT]',
        help='Which column holds a signal; repeat for each signal; not needed for a file of '
        '`asi export`')] = None,
    rate: Annotated[float | None, typer.Option(
        help='Sampling rate, Hz, if no column is the time')] = None,
    skip_lines: Annotated[int, typer.Option(help='Lines before the header', min=0, max=10**9)] = 0,
    delimiter: Annotated[str | None, typer.Option(
        help='Delimiter of the cells; default: detected')] = None,
    columns: Annotated[str | None, typer.Option(
        help='Column names, separated by commas, of a file without a header')] = None,
    zero: Annotated[float, typer.Option(
        help='Subtract from each signal its mean over this time from the start, s')] = 0.0,
    episode: Annotated[int | None, typer.Option(
        help='Episode of a LeRobot dataset; needed if it has several', min=0, max=10**9)] = None,
    as_json: Json = False,
) -> None:
    """
    Convert a recording of another system to a bag.

    `asi import FILE` alone shows a preview: columns, units, rate, gaps, and a command to copy.
    Signals: time, reference, command, force, valve_position, position, velocity. A column of a
    rosbag2 is TOPIC/FIELD, or TOPIC/JOINT/FIELD. With {joint} in a column each joint that has it
    becomes a bag in the folder of --out. More in doc/how_to/importing.md.
    """
    from asi_analysis.bags.exchange.importing import import_joints, import_recording
    from asi_analysis.bags.exchange.joints import JOINT
    from asi_analysis.bags.exchange.preview import preview
    from asi_analysis.bags.exchange.summary import Imported, ImportedJoints, Previews
    reading: dict[str, Any] = {'skip_lines': skip_lines, 'delimiter': delimiter,
                               'columns': columns.split(',') if columns else None,
                               'episode': episode}
    if out is None and map_:
        raise InputError('--map goes with --out BAG, the bag to write')
    with bar() as progress:
        progress(f'reading {", ".join(map(str, files))}', None)
        if out is None:
            shown: Any = Previews.of([preview(file, rate, **reading) for file in files])
        elif any(JOINT in text for text in map_ or []):
            if len(files) > 1:
                raise InputError(f'{JOINT} in a mapping takes one file')
            joints = import_joints(files[0], map_ or [], rate, **reading, zero_s=zero, out=out)
            shown = ImportedJoints.of(joints, out)
        else:
            run = import_recording(files, map_ or [], rate, **reading, zero_s=zero, out=out)
            shown = Imported.of(run, out)
    show(shown, as_json)


@command('split', 'asi split runs/demo/lead_lag/bag --out parts')
def split(
    bag: Bag,
    out: Annotated[Path, typer.Option(help='Directory of the bags to write: 1, 2 and so on')],
    as_json: Json = False,
) -> None:
    """
    Divide a recording with restarts or pauses of the actuator into a bag for each part.

    A part ends where the time stamps go back, or pause for a second.
    """
    from asi_analysis.bags.exchange.summary import Split
    from asi_analysis.bags.splitting import split_bag
    with bar() as progress:
        progress('writing', None)
        written = split_bag(bag, out)
    show(Split.of(written), as_json)


@command('export', 'asi export runs/demo/lead_lag/bag --out lead_lag.csv')
def export(
    bag: Bag,
    out: Annotated[Path, typer.Option(help='The .csv or .parquet file to write')],
    as_json: Json = False,
) -> None:
    """Write the signals of a bag as a CSV or Parquet table, with units in the column names."""
    from asi_analysis.bags.bag import read_bag
    from asi_analysis.bags.exchange.exporting import export as write_table
    from asi_analysis.bags.exchange.summary import Exported
    with bar() as progress:
        progress('reading', None)
        run = read_bag(bag)
        progress('writing', None)
        write_table(run, out)
    show(Exported.of(run, out), as_json)
