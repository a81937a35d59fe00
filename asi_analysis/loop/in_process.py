"""An experiment computed in one process, instead of over ROS."""

from asi_analysis.bags.run import Run
from asi_analysis.experiments.experiment import information, planned
from asi_analysis.loop.closed_loop import Values, simulate_loop


def simulate(actuator: Values, controller: Values, duration_s: float = 1.0,
             rate_hz: float = 5000.0) -> Run:
    """
    Return the recording of an experiment, computed in this process.

    actuator, controller: parameters by name (doc/reference/parameters.md), the rest at their
    defaults; without `reference.shape` the reference is a step. rate_hz: control rate, Hz.
    Samples are those of `asi.run` in lock-step to the last bit. Raises InputError for a parameter
    that is not allowed.

    >>> import asi_analysis as asi
    >>> run = asi.simulate({'load.type': 'spring'}, {'reference.amplitude': 100.0}, 0.4)
    >>> print(f'{run.duration_s:g} s at {run.rate_hz:g} Hz, force {run.force_n[-1]:.0f} N')
    0.4 s at 5000 Hz, force 100 N
    """
    experiment = planned(actuator, controller, duration_s, 'lockstep', rate_hz)
    signals = simulate_loop(experiment.actuator, experiment.controller, duration_s, rate_hz)
    return Run(*signals, source='simulation', information=information(experiment))
