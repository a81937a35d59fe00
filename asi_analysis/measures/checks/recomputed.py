"""
Recomputation of a run: the recorded controller and actuator, driven by the recorded signals.

A bag of this package holds all parameters of both. In lock-step three things are then known to the
last bit: the reference, the command that the controller computes from it and the recorded force,
and the motion and force that the actuator gives for the recorded commands. A difference is due to
samples that were altered, replaced or moved in time afterwards. Each half of the loop is computed
from the recorded signals of the other, not simulated in a closed loop, where a rounding error of
another machine could grow.
"""

from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import numpy as np

from asi_actuator.model.actuator import Trajectory, check_period, simulate
from asi_actuator.node_parameters import SAFETY_PARAMETERS
from asi_actuator.parameters import as_record
from asi_analysis.arrays import Array, Mask
from asi_analysis.bags.information import missing_ticks
from asi_analysis.bags.run import SIGNALS, Run
from asi_analysis.measures.finding import (
    DOUBTFUL,
    NOTE,
    Finding,
    Interval,
    name_of,
    place_of,
    whole_run,
)
from asi_analysis.versions import versions
from asi_common.parameter import ParameterError
from asi_common.record import record_of
from asi_controller.parameters import REFERENCE_PARAMETERS, VELOCITY_NEEDED
from asi_controller.reference import TOPIC, reference_forces

# Largest difference that is no finding, as a share of the largest value of a signal.
SHARE: Final = 1e-5
# The same for equal signals, which show that actuator or controller began in the assumed state.
SAME: Final = 1e-9
# Share of a period by which samples may be early or late.
EVEN: Final = 0.01
# Number of first samples by which a controller that began in another state is recognised.
FIRST: Final = 3
# Samples by which the place of a part of a reference is sought; places that are compared at most.
PROBES: Final = 32
MOST_BEGINS: Final = 1000
MOST_HZ: Final = 1e9   # largest plausible control rate
# Sub-steps of the actuator that are computed, in about a second; later samples are not compared.
MOST_SUBSTEPS: Final = 3e6
# Iterations for a velocity that was not recorded.
PASSES: Final = 30
# Default limit of the rate of the command in the actuator's node, N/s.
COMMAND_RATE: Final = next(float(each.default) for each in SAFETY_PARAMETERS
                           if each.name == 'limit.command_rate')
# Real time: the largest change of the difference from sample to sample that is no finding, as a
# share of the range of the command; time for which a lost state affects the memory of the
# controller, s; samples before a repeated command that may answer another state; least and most
# periods between samples; least delay of a late sample, in periods; largest share of samples that
# may be altered: beyond, another controller is as likely.
CHANGE: Final = 1e-3
REMEMBERED_S: Final = 0.05
BEFORE: Final = 2
LEAST_PERIODS: Final = 0.9
MOST_PERIODS: Final = 3.0
LATE: Final = 0.3
MOST_ALTERED: Final = 0.3
MOVED: Final = ('force', 'valve_position', 'position', 'velocity')


class ByController(NamedTuple):
    """Comparison with the recorded controller: whether the command is its own, and findings."""

    agrees: bool
    findings: list[Finding]


def of_controller(run: Run) -> ByController:
    """Compare a run with what its recorded controller and, in lock-step, actuator compute."""
    if _rate(run) is None:
        return ByController(False, list(_of_real_time(run)))
    found = list(_of_rate(run))
    again = recomputed(run)
    if again is not None and run.command_n is not None:
        command = run.command_n
        wrong = np.abs(command - again) > SHARE * float(np.ptp(command))
        if wrong.any():
            if _in_another_state(run, [(command, again)]):
                return ByController(False, found or list(_of_rows(run)))
            # A saturated command does not show all samples of the force that were altered.
            moved = moved_by(run, command)
            others = [] if moved is None else list(_of_moved(run, moved))
            (start, end), = _interval(run, wrong)
            where = ((start, max([end, *(each.intervals_s[-1][1] for each in others)])),)
            return ByController(False, [*found, Finding(
                'answer', 'time', DOUBTFUL, where,
                'the command is not what the controller of this run computes from the recorded '
                f'reference and force {place_of(where)}: samples were altered, or its parameters '
                'were changed')])
    moved = None if again is None else moved_by(run, again)
    if run.command_n is None and moved is None and run.information.get('controller'):
        found.append(Finding(
            'reading', 'time', NOTE, whole_run(run.time_s),
            'the recording lacks the command of its run: samples that were altered may not show'))
    altered = [] if again is None or moved is None else list(_of_moved(run, moved))
    agrees = (again is not None and not altered and run.command_n is not None
              and bool(np.ptp(run.command_n) > 0.0))
    return ByController(agrees, found + altered)


def unrecorded(run: Run) -> Iterator[Finding]:
    """
    Yield findings on what a run of this package had and its recording lacks.

    The samples of a cut lie outside of the recording: 'cut' has the intervals where they may be.
    """
    if run.reference_n is None and run.information.get('controller'):
        yield Finding(
            'absent', 'reference', DOUBTFUL, whole_run(run.time_s),
            'the recording lacks the reference of its run: figures are those of a loop without')
    start, end = float(run.time_s[0]), float(run.time_s[-1])
    rate_hz = _rate(run) or run.rate_hz
    # Samples that are missing in between are gaps, or between each n-th.
    inside = round(min(abs(end - start) * rate_hz, MOST_HZ)) + 1 - len(run)
    lacking = run.lacking - max(inside, 0)
    if lacking <= 0 or lacking < run.period_s * rate_hz - EVEN:
        return
    before, after = ((start - lacking / rate_hz, start - 1.0 / rate_hz),
                     (end + 1.0 / rate_hz, end + lacking / rate_hz))
    made = None if run.reference_n is None else generated(run, len(run))
    from_start = made is not None and bool(np.allclose(run.signal('reference'), made, SHARE))
    yield Finding(
        'cut', 'time', DOUBTFUL, (after,) if from_start else (before, after),
        f'{lacking} of the {len(run) + run.lacking} samples of this run are not in the recording, '
        f'{"at its end" if from_start else "at its beginning or end"}: it was interrupted or cut')


def _interval(run: Run, wrong: Mask) -> tuple[Interval, ...]:
    """Return the interval from the first to the last wrong sample."""
    samples = np.flatnonzero(wrong)
    return ((float(run.time_s[samples[0]]), float(run.time_s[samples[-1]])),)


def _in_another_state(run: Run, pairs: list[tuple[Array, Array]]) -> bool:
    """Return whether a run without its first samples began in another state than rest."""
    return missing_ticks(run.information, len(run)) > 0 and any(
        np.abs(recorded[:FIRST] - again[:FIRST]).max() > SAME * np.abs(again).max()
        for recorded, again in pairs)


def _of_rows(run: Run) -> Iterator[Finding]:
    """Yield a finding if the reference is no part of the one that the controller made."""
    recorded, count = run.reference_n, len(run)
    made = generated(run, count + missing_ticks(run.information, count))
    if recorded is None or made is None or not np.isfinite(recorded).all():
        return
    near = SHARE * float(np.abs(made).max())
    begins = np.arange(len(made) - count + 1)
    for k in np.linspace(0, count - 1, PROBES).astype(int):
        begins = begins[np.abs(made[begins + k] - recorded[k]) <= near]
    if not any(np.abs(made[begin:begin + count] - recorded).max() <= near
               for begin in begins[:MOST_BEGINS]) and len(begins) <= MOST_BEGINS:
        yield Finding('answer', 'time', DOUBTFUL, whole_run(run.time_s),
                      'the reference is no part of the one that the controller of this run makes: '
                      'samples were lost, repeated or altered')


def _of_moved(run: Run, moved: Trajectory) -> Iterator[Finding]:
    """Compare reference, motion and force with those of the recorded actuator."""
    count = len(moved.time_s)
    pairs = {each.name: (values[:count], getattr(moved, each.field)) for each in SIGNALS
             if each.name in MOVED and run.unit(each.name) == each.unit
             and (values := getattr(run, each.field)) is not None}
    if _in_another_state(run, list(pairs.values())):
        return
    if (reference := generated(run, len(run))) is not None:
        pairs['reference'] = (run.signal('reference'), reference)
    wrong = {name: found for name, (recorded, again) in pairs.items()
             if (found := np.abs(recorded - again) > SHARE * np.abs(again).max()).any()}
    if not wrong:
        return
    first = min(np.flatnonzero(each)[0] for each in wrong.values())
    last = max(np.flatnonzero(each)[-1] for each in wrong.values())
    where = ((float(run.time_s[first]), float(run.time_s[last])),)
    yield Finding('answer', next(iter(wrong)) if len(wrong) == 1 else 'time', DOUBTFUL, where,
                  f'the {" and the ".join(name_of(name) for name in wrong)} '
                  f'{"is" if len(wrong) == 1 else "are"} not what controller and actuator of this '
                  f'run compute {place_of(where)}: samples were altered, lost or repeated, or '
                  'parameters were changed')


def _of_rate(run: Run) -> Iterator[Finding]:
    """Compare the sampling rate of a run in lock-step with its control rate."""
    rate_hz = _rate(run) or np.nan
    periods = run.period_s * rate_hz
    whole = whole_run(run.time_s)
    ticks = run.information.get('experiment', {}).get('ticks', np.inf)
    if round(periods) > 1 and abs(periods - round(periods)) < EVEN and (
            periods * (len(run) - 1) <= ticks):
        yield Finding('rate', 'time', NOTE, whole,
                      f'the recording has one of {round(periods)} samples of this run, whose '
                      f'rate was {rate_hz:g} Hz')
    elif abs(periods - 1.0) > EVEN:
        yield _wrong_rate(run, rate_hz)


def _wrong_rate(run: Run, rate_hz: float) -> Finding:
    return Finding('rate', 'time', DOUBTFUL, whole_run(run.time_s),
                   f'the samples are {run.period_s:.4g} s apart, those of this run were '
                   f'{1.0 / rate_hz:.4g} s: is the time right?')


def _of_real_time(run: Run) -> Iterator[Finding]:
    """
    Compare the rate and the commands of a run in real time with those of its controller.

    The state of the controller before the first sample is unknown, and it may answer a state twice
    or not at all: the recording then has a repeated command, or late states. So only changes of
    the difference are compared, except shortly after such places.
    """
    if (rate_hz := _rate(run, 'realtime')) is None:
        return
    if not LEAST_PERIODS <= run.period_s * rate_hz <= MOST_PERIODS:
        yield _wrong_rate(run, rate_hz)
        return
    if run.command_n is None or not np.isfinite(run.command_n).any():
        return
    known = np.flatnonzero(np.isfinite(run.command_n))
    part = run[int(known[0]):int(known[-1]) + 1]
    again = recomputed(part, 'realtime')
    if again is None:
        return
    command, time = part.signal('command'), part.time_s
    late = np.abs(np.diff(time) * rate_hz - 1.0) > LATE
    unknown = np.append(True, late | (np.diff(command) == 0.0))
    unknown[-1] = True      # the last state may have no answer
    after = round(REMEMBERED_S * rate_hz)
    remembered = np.convolve(unknown, np.ones(BEFORE + after + 1))[BEFORE:][:len(part)] > 0.5
    changes = np.abs(np.diff(again - command, prepend=0.0)) > CHANGE * float(np.ptp(command))
    wrong = changes & ~remembered
    if not wrong.any():
        return
    lasting = wrong.sum() > MOST_ALTERED * np.count_nonzero(~remembered)
    where = _interval(part, wrong)
    yield Finding('answer', 'time', NOTE if lasting else DOUBTFUL, where,
                  'the command is not what the controller of this run computes from the recorded '
                  f'reference and force {place_of(where)}: '
                  + ('its parameters were changed, or samples were altered' if lasting else
                     'samples were altered, lost or repeated'))


def _rate(run: Run, mode: str = 'lockstep') -> float | None:
    """Return the control rate (Hz) of a run; None if it was not made in this mode."""
    experiment = run.information.get('experiment', {})
    rate_hz = experiment.get('rate_hz', 0.0) if experiment.get('mode') == mode else 0.0
    return float(rate_hz) if 0.0 < rate_hz < MOST_HZ else None


def recomputed(run: Run, mode: str = 'lockstep') -> Array | None:
    """
    Return the commands that the recorded controller computes in a run of n samples.

    None for a recording that does not hold the controller, or that is not in this mode, or of
    another version of this package; or in lock-step not all samples from its first.
    """
    controller: dict[str, Any] = dict(run.information.get('controller', {}))
    rate_hz = _rate(run, mode)
    if not controller or rate_hz is None or not _same_version(run):
        return None
    signals = (run.reference_n, run.force_n)
    if any(each is None or not np.isfinite(each).all() for each in signals) or any(
            each.state != 'enabled' for each in run.states):
        return None
    if any(each is not None and not np.isfinite(each).all()
           for each in (run.command_n, run.velocity_m_s)):
        return None
    if mode == 'lockstep' and (
            (period := _even(run)) is None or abs(period * rate_hz - 1.0) > EVEN):
        return None
    for parameter in REFERENCE_PARAMETERS:
        controller.pop(parameter.name, None)
    if run.velocity_m_s is not None:
        return _commands(run, controller, rate_hz, run.velocity_m_s)
    if not any(controller.get(name) for name in VELOCITY_NEEDED):
        return _commands(run, controller, rate_hz, np.zeros(len(run)))
    return _by_velocity(run, controller, rate_hz)


def _by_velocity(run: Run, controller: dict[str, Any], rate_hz: float) -> Array | None:
    """Return the commands (N) for a velocity that was not recorded, by fixed-point iteration."""
    velocity = np.zeros(len(run))
    for _ in range(PASSES):
        command = run.command_n
        if command is None:
            command = _commands(run, controller, rate_hz, velocity)
        moved = None if command is None else moved_by(run, command)
        if moved is None or len(moved.time_s) < len(run):
            return None
        if np.abs(moved.velocity_m_s - velocity).max() <= SAME * np.abs(velocity).max():
            return _commands(run, controller, rate_hz, velocity)
        velocity = moved.velocity_m_s
    return None


def generated(run: Run, count: int) -> Array | None:
    """Return n samples of the reference (N) in lock-step; None if it is of another node."""
    controller = run.information.get('controller', {})
    names = {each.name for each in REFERENCE_PARAMETERS}
    rate_hz = _rate(run)
    try:
        record = record_of({name: value for name, value in controller.items() if name in names},
                           REFERENCE_PARAMETERS)
    except (ParameterError, TypeError, ValueError, OverflowError):
        return None
    if rate_hz is None or record['reference_shape'] == TOPIC:
        return None
    return np.asarray(reference_forces(record, 1.0 / rate_hz, count))


def moved_by(run: Run, command: Array) -> Trajectory | None:
    """
    Return what the recorded actuator does with n commands (N), or with the first of them.

    None where that is not known: no or other parameters, commands that its node slows down.
    """
    actuator, rate_hz = run.information.get('actuator'), _rate(run)
    if not actuator or rate_hz is None or not np.isfinite(command).all():
        return None
    if np.abs(np.diff(command, prepend=0.0)).max() * rate_hz > COMMAND_RATE:
        return None
    try:
        record = as_record(actuator)
        check_period(1.0 / rate_hz)
    except (ParameterError, TypeError, ValueError, OverflowError):
        return None
    substeps = np.ceil(1.0 / rate_hz / float(record['maximum_substep']))
    return simulate(record, command[:int(MOST_SUBSTEPS / substeps)], 1.0 / rate_hz)


def _same_version(run: Run) -> bool:
    recorded = run.information.get('versions', {}).get('asi_actuator')
    return recorded is not None and recorded == versions().get('asi_actuator')


def _even(run: Run) -> float | None:
    """Return the period (s) if the samples are evenly spaced from 0 s on; else None."""
    period = run.period_s
    even = len(run) > 1 and np.abs(
        run.time_s - period * np.arange(len(run))).max() < EVEN * period
    return period if even else None


def _commands(run: Run, values: dict[str, Any], rate_hz: float, velocity: Array
              ) -> Array | None:
    """Return the commands (N) of a compensator; None for parameters that are not allowed."""
    from asi_controller.compensator import commands, compensator
    try:
        record = compensator(values, rate_hz)
    except (ParameterError, TypeError, ValueError, OverflowError):
        return None
    return np.asarray(commands(record, run.signal('reference'), run.signal('force'), velocity))
