"""
Run, record and understand a force-controlled hydraulic actuator, from Python.

    import asi_analysis as asi

    run = asi.read_bag('runs/demo/lead_lag/bag')
    step = asi.step_response(run)
    print(step)
    step.plot()

Every function returns a `Result` (or a `Run`): it prints as a table, `plot()` draws it,
`to_dict()` is the JSON document of the command, and `to_frame()` a pandas DataFrame. Functions
whose noun is a package have a verb (`detect_limit_cycles`, not `limit_cycle`). Importing this
package imports none of its modules; a name imports its module at first use.
"""

# As in typing, whose import would take longer than all that `asi` does before it handles Ctrl-C.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from asi_analysis.bags.bag import read_bag as read_bag
    from asi_analysis.bags.bag import write_bag as write_bag
    from asi_analysis.bags.exchange.exporting import export as export
    from asi_analysis.bags.exchange.importing import import_recording as import_recording
    from asi_analysis.bags.run import Run as Run
    from asi_analysis.bags.splitting import split_bag as split_bag
    from asi_analysis.errors import InputError as InputError
    from asi_analysis.experiments.running import run as run
    from asi_analysis.gap.answer.command import diagnose as diagnose
    from asi_analysis.limit_cycle.attribution.ablation import attribute_model as attribute_model
    from asi_analysis.limit_cycle.attribution.recording import attribute_cycle as attribute_cycle
    from asi_analysis.limit_cycle.detection.answer import (
        detect_limit_cycles as detect_limit_cycles,
    )
    from asi_analysis.limit_cycle.prediction.predict import predict_cycles as predict_cycles
    from asi_analysis.limit_cycle.quench.answer import quench_cycles as quench_cycles
    from asi_analysis.loop.in_process import simulate as simulate
    from asi_analysis.loop.sweep import sweep as sweep
    from asi_analysis.measures.analysis import analyze as analyze
    from asi_analysis.measures.analysis import oscillation as oscillation
    from asi_analysis.measures.frequency_response import frequency_response as frequency_response
    from asi_analysis.measures.step_response import step_response as step_response
    from asi_analysis.paper.reproduction.answer import reproduce_paper as reproduce_paper
    from asi_analysis.reporting.result import Result as Result
    from asi_analysis.tuning.answer import tune_controller as tune_controller
    from asi_analysis.tuning.compare import compare_controllers as compare_controllers

# Public name -> the module that defines it.
_HOME = {
    'InputError': 'errors',
    'Result': 'reporting.result',
    'Run': 'bags.run',
    'analyze': 'measures.analysis',
    'attribute_cycle': 'limit_cycle.attribution.recording',
    'attribute_model': 'limit_cycle.attribution.ablation',
    'compare_controllers': 'tuning.compare',
    'detect_limit_cycles': 'limit_cycle.detection.answer',
    'diagnose': 'gap.answer.command',
    'export': 'bags.exchange.exporting',
    'frequency_response': 'measures.frequency_response',
    'import_recording': 'bags.exchange.importing',
    'oscillation': 'measures.analysis',
    'predict_cycles': 'limit_cycle.prediction.predict',
    'quench_cycles': 'limit_cycle.quench.answer',
    'read_bag': 'bags.bag',
    'reproduce_paper': 'paper.reproduction.answer',
    'run': 'experiments.running',
    'tune_controller': 'tuning.answer',
    'simulate': 'loop.in_process',
    'split_bag': 'bags.splitting',
    'step_response': 'measures.step_response',
    'sweep': 'loop.sweep',
    'write_bag': 'bags.bag',
}
__all__ = list(_HOME)


def __getattr__(name: str) -> 'Any':
    if name not in _HOME:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    import importlib
    value = getattr(importlib.import_module(f'{__name__}.{_HOME[name]}'), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME})
