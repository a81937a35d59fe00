"""
Whether the command of a run is what its controller computes from the recorded signals.

A bag of this package holds the controller of its run with all parameters. In lock-step the
command is then known to the last bit, also of a controller that is not linear: a difference is
due to samples that were altered, replaced or moved in time afterwards.
"""

from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import numpy as np

from asi_analysis.arrays import Array
from asi_analysis.bags.information import missing_ticks
from asi_analysis.bags.run import Run
from asi_analysis.measures.finding import DOUBTFUL, NOTE, Finding, place_of
from asi_analysis.versions import versions
from asi_common.parameter import ParameterError
from asi_controller.parameters import REFERENCE_PARAMETERS

# Largest difference that is no finding, as a share of the range of the command.
SHARE: Final = 1e-5
# Share of a period by which samples may be early or late.
EVEN: Final = 0.01
# Sample by which a controller that was in another state at the beginning shows.
FIRST: Final = 3
MOST_HZ: Final = 1e9   # of a control rate: more is no rate


class ByController(NamedTuple):
    """Comparison with the recorded controller: whether the command is its own, and findings."""

    agrees: bool
    findings: list[Finding]


def of_controller(run: Run) -> ByController:
    """Compare rate and commands of a run in lock-step with those of its recorded controller."""
    if _rate(run) is None:
        return ByController(False, [])
    found = list(_of_rate(run))
    if run.command_n is None and run.information.get('controller'):
        found.append(Finding(
            'reading', 'time', NOTE, ((float(run.time_s[0]), float(run.time_s[-1])),),
            'the recording lacks the command of its run: samples that were altered may not show'))
    again = recomputed(run)
    if again is None:
        return ByController(False, found)
    command = run.signal('command')
    wrong = np.flatnonzero(np.abs(command - again) > SHARE * float(np.ptp(command)))
    if not len(wrong):
        return ByController(bool(np.ptp(command) > 0.0), found)
    where = ((float(run.time_s[wrong[0]]), float(run.time_s[wrong[-1]])),)
    if wrong[0] < FIRST and missing_ticks(run.information, len(run)):
        return ByController(False, found)   # in which state it was is not known
    return ByController(False, [*found, Finding(
        'answer', 'time', DOUBTFUL, where,
        'the command is not what the controller of this run computes from the recorded reference '
        f'and force {place_of(where)}: samples were altered, or its parameters were changed')])


def _of_rate(run: Run) -> Iterator[Finding]:
    rate_hz = _rate(run) or np.nan
    periods = run.period_s * rate_hz
    whole = ((float(run.time_s[0]), float(run.time_s[-1])),)
    ticks = run.information.get('experiment', {}).get('ticks', np.inf)
    if round(periods) > 1 and abs(periods - round(periods)) < EVEN and (
            periods * (len(run) - 1) <= ticks):
        yield Finding('rate', 'time', NOTE, whole,
                      f'the recording has only every {round(periods)}. sample of this run, whose '
                      f'rate was {rate_hz:g} Hz')
    elif abs(periods - 1.0) > EVEN:
        yield Finding('rate', 'time', DOUBTFUL, whole,
                      f'the samples are {run.period_s:.4g} s apart, those of this run were '
                      f'{1.0 / rate_hz:.4g} s: is the time right?')


def _rate(run: Run) -> float | None:
    """Return the control rate of a run in lock-step, Hz; None for another run."""
    experiment = run.information.get('experiment', {})
    rate_hz = experiment.get('rate_hz', 0.0) if experiment.get('mode') == 'lockstep' else 0.0
    return float(rate_hz) if 0.0 < rate_hz < MOST_HZ else None


def recomputed(run: Run) -> Array | None:
    """
    Return the commands that the recorded controller computes in a run of n samples.

    None for a recording that does not hold the controller, or not all samples from its first, or
    that is not in lock-step, or of another version of this package.
    """
    controller: dict[str, Any] = dict(run.information.get('controller', {}))
    rate_hz = _rate(run)
    if not controller or rate_hz is None or not _same_version(run):
        return None
    signals = [getattr(run, name) for name in ('reference_n', 'force_n', 'command_n')]
    if any(each is None or not np.isfinite(each).all() for each in signals) or any(
            each.state != 'enabled' for each in run.states):
        return None
    if (period := _even(run)) is None or abs(period * rate_hz - 1.0) > EVEN:
        return None
    return _commands(run, controller, rate_hz)


def _same_version(run: Run) -> bool:
    recorded = run.information.get('versions', {}).get('asi_actuator')
    return recorded is not None and recorded == versions().get('asi_actuator')


def _even(run: Run) -> float | None:
    """Return the period if the samples are evenly spaced from 0 s on."""
    period = run.period_s
    even = len(run) > 1 and np.abs(
        run.time_s - period * np.arange(len(run))).max() < EVEN * period
    return period if even else None


def _commands(run: Run, values: dict[str, Any], rate_hz: float) -> Array | None:
    from asi_controller.compensator import commands, compensator
    for parameter in REFERENCE_PARAMETERS:
        values.pop(parameter.name, None)
    try:
        record = compensator(values, rate_hz)
    except (ParameterError, TypeError, ValueError, OverflowError):
        return None
    velocity = run.velocity_m_s
    if velocity is None:
        velocity = np.zeros(len(run))
    elif not np.isfinite(velocity).all():
        return None
    return np.asarray(commands(record, run.signal('reference'), run.signal('force'), velocity))
