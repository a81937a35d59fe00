"""Commands about limit cycles: limit-cycle, predict, attribute, quench."""

from pathlib import Path
from typing import Annotated, Any

import typer

from asi_analysis.cli.options import (
    MOST_SEED,
    Compensator,
    Dask,
    Gain,
    Held,
    Jobs,
    Json,
    ParameterFile,
    Rate,
    Report,
    Settings,
    checked_step,
    command,
    directory,
    numbers,
    show,
)
from asi_analysis.errors import InputError
from asi_analysis.terminal import bar

# Of asi attribute without a bag.
MODEL_STEP_N = 100.0
MODEL_RATE_HZ = 5000.0


@command('limit-cycle', 'asi limit-cycle runs/from_inside/bag runs/from_outside/bag')
def limit_cycle(
    bags: Annotated[list[Path], typer.Argument(
        help='Bags of the same loop, analysed together')],
    signal: Annotated[str | None, typer.Option(
        help='Signal to analyse, for example position; default: the controlled one, or else '
             'the force')] = None,
    undriven: Annotated[bool, typer.Option(
        '--undriven', help='State that nothing drove the loop from outside: no periodic load, no '
                           'reference that is not in the recording')
    ] = False,
    report: Report = None,
    as_json: Json = False,
) -> None:
    """Detect limit cycles in each segment of a recording, with a confidence."""
    from asi_analysis.bags.bag import read_bag
    from asi_analysis.limit_cycle.detection.answer import detect_limit_cycles
    with bar() as progress:
        progress('reading', None)
        runs = [read_bag(bag) for bag in bags]
        progress('analysing', None)
        result = detect_limit_cycles(runs, signal, undriven)
    show(result, as_json, report)


@command('predict', 'asi predict --steps 20,100,300,600 --report runs/prediction')
def predict(
    compensator: Compensator = None,
    gain: Annotated[float, typer.Option(
        help='Start of the search for a cycle: a gain below the onset')] = 5.0,
    step: Held = 100.0,
    steps: Annotated[str, typer.Option(
        help='Steps (N, separated by commas) for the onset over the step size, Fig. 7')] = '',
    rate: Rate = 5000.0,
    set_: Settings = None,
    report: Report = None,
    as_json: Json = False,
) -> None:
    """
    Predict the limit cycles of a loop from its model, and compare with simulation.

    Two methods: the describing function of the hysteresis alone, as in the paper, and harmonic
    balance of all nonlinearities with the sampled controller.
    """
    sizes = numbers('--steps', steps)
    from asi_analysis.limit_cycle.prediction.predict import predict_cycles
    with bar() as progress:
        result = predict_cycles(*_configured(set_, compensator, gain, step), rate, gain, sizes,
                                progress)
    show(result, as_json, report)


@command('attribute', 'asi attribute --step 100')
def attribute(
    bag: Annotated[Path | None, typer.Argument(
        help='A bag with an oscillation; without one, the model is analysed')] = None,
    compensator: Compensator = None,
    gain: Annotated[float | None, typer.Option(
        help='Gain at which cycles are compared; default: a little above the onset')] = None,
    step: Held = MODEL_STEP_N,
    rate: Rate = MODEL_RATE_HZ,
    set_: Settings = None,
    signal: Annotated[str | None, typer.Option(help='Output signal of the bag')] = None,
    report: Report = None,
    as_json: Json = False,
) -> None:
    """
    Find the nonlinearity that causes a limit cycle.

    Without a bag: in the model, with each nonlinearity alone and with all but it. With a bag of
    any loop: by the shapes of command and output. A bag of this actuator is also compared with
    its model.
    """
    # Of what is analysed the parameters are known: an option would have no effect.
    without_effect = {'--signal': signal is not None} if bag is None else {
        '--compensator': compensator is not None, '--gain': gain is not None,
        '--step': step != MODEL_STEP_N, '--rate': rate != MODEL_RATE_HZ, '--set': bool(set_)}
    for option in (name for name, given in without_effect.items() if given):
        raise InputError(f'{option} has no effect ' + (
            'without a bag' if bag is None else f'on {bag}: it is an option of the model'))
    with bar() as progress:
        if bag is not None:
            from asi_analysis.bags.bag import read_bag
            from asi_analysis.limit_cycle.attribution.recording import attribute_cycle
            result = attribute_cycle(read_bag(bag), signal, progress)
        else:
            from asi_analysis.limit_cycle.attribution.ablation import attribute_model
            result = attribute_model(*_configured(set_, compensator, gain, step), rate, gain,
                                     progress)
    show(result, as_json, report)


@command('quench', 'asi quench --controller config/quiet.yaml --conditions 300')
def quench(
    compensator: Compensator = None,
    gain: Gain = None,
    controller: ParameterFile = None,
    step: Annotated[float, typer.Option(
        callback=checked_step, help='Force step of the loop on which dither is tried, N')] = 100.0,
    conditions: Annotated[int, typer.Option(
        help='Number of conditions that the search for an oscillation tries', min=1)] = 200,
    rates: Annotated[str, typer.Option(
        help='Control rates of the search, Hz; the margin uses the first')] = '5000',
    seed: Annotated[int, typer.Option(help='Seed of the search', min=0, max=MOST_SEED)] = 1,
    replay: Annotated[int, typer.Option(
        help='Number of the worst cases to run over ROS', min=0)] = 0,
    out: Annotated[Path, typer.Option(
        callback=directory, help='Directory for the bags of --replay')] = Path('runs/quench'),
    set_: Settings = None,
    report: Report = None,
    jobs: Jobs = 1,
    dask: Dask = None,
    as_json: Json = False,
) -> None:
    """
    Compute the margin to a limit cycle, and search for conditions in which the loop oscillates.

    Exit status 1 if a sustained oscillation was found.
    """
    rates_hz = numbers('--rates', rates)
    from asi_analysis.limit_cycle.quench.answer import quench_cycles
    from asi_analysis.parallel import workers
    with workers(jobs, dask), bar() as progress:
        result = quench_cycles(*_configured(set_, compensator, gain, step, controller), rates_hz,
                               conditions, seed, (replay, out) if replay else None, progress)
    show(result, as_json, report)
    if result.sustained_found:
        raise typer.Exit(1)


def _configured(settings: list[str] | None, compensator: str | None, gain: float | None,
                step: float, file: Path | None = None) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the parameters of actuator and controller, with a step as reference."""
    from asi_analysis.experiments.experiment import gather
    values = gather({'controller': file}, settings or [], {'controller': {
        'compensator': compensator, 'gain': gain, 'reference.shape': 'step',
        'reference.amplitude': step}}, 1.0)
    return values['actuator'], values['controller']
