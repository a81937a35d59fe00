"""Order of cause and effect: no signal responds before its reference, or before its command."""

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np

from asi_analysis.arrays import Array
from asi_analysis.bags.run import Run
from asi_analysis.measures.breaks import is_noisy
from asi_analysis.measures.correlation import correlation_delay
from asi_analysis.measures.finding import (
    DOUBTFUL,
    Finding,
    Interval,
    name_of,
    place_of,
    whole_run,
)

# Least lead (samples) of an output over its reference that counts; the correlation without the
# shift must be below the share CLEARLY of that with it.
EARLY_SAMPLES: Final = 3
CLEARLY: Final = 0.8
# Largest lead of an output, and longest delay of one of the wrong sign, as a share of the run.
SOON: Final = 0.1
# Largest share of its change that an output may complete before the reference changes.
BEFORE: Final = 0.3
# Least change that is a step, as a share of the range; most steps; samples beside one, at least;
# fewest samples with a command.
STEP: Final = 0.2
MOST_STEPS: Final = 20
SETTLED_SAMPLES: Final = 20
FEWEST_SAMPLES: Final = 100


def of_order(run: Run, name: str, time: Array, reference: Array, values: Array
              ) -> Iterator[Finding]:
    """Yield a finding if a signal comes before its reference."""
    if early := _answered_before(time, reference, values):
        yield Finding('order', name, DOUBTFUL, early,
                      f'the {name_of(name)} changes before its reference does {place_of(early)}: '
                      'they are not synchronised')
    elif lead := _lead(reference, values):
        yield Finding('order', name, DOUBTFUL, whole_run(time),
                      f'the {name_of(name)} fits its reference best if it is '
                      f'{1e3 * lead * run.period_s:.4g} ms later: they are not synchronised')


def _lead(reference: Array, values: Array) -> int:
    """Return the lead (samples) of a signal over its reference, 0 if there is no clear one."""
    lag = correlation_delay(reference, values, 1.0)
    lead = 0 if lag is None else round(-lag)
    if not EARLY_SAMPLES <= lead < SOON * len(values):
        return 0
    now = np.corrcoef(reference, values)[0, 1]
    shifted = np.corrcoef(reference[lead:], values[:-lead])[0, 1]
    return lead if now < CLEARLY * shifted else 0


class Step(NamedTuple):
    """A step of the reference: its samples, and the levels of the signal before and after it."""

    begin: int      # of the level before
    jump: int       # first sample after the step
    end: int        # of the level after, excluded
    low: float
    high: float
    spread: float   # of the samples about either level


def steps_of(reference: Array, values: Array) -> list[Step]:
    """Return the steps of the reference, MOST_STEPS at most, and the response of the signal."""
    changes = np.abs(np.diff(reference))
    jumps = np.flatnonzero(changes > STEP * max(float(np.ptp(reference)), 1e-300))
    if not 0 < len(jumps) <= MOST_STEPS:
        return []
    edges = [0, *(int(jump) + 1 for jump in jumps), len(values)]
    found = []
    for begin, jump, end in zip(edges[:-2], edges[1:-1], edges[2:], strict=True):
        if min(jump - begin, end - jump) < SETTLED_SAMPLES:
            continue
        before = values[begin:begin + max(1, (jump - begin) // 2)]
        after = values[jump + (end - jump) // 2:end]
        spread = max(float(np.ptp(np.quantile(each, [0.05, 0.95]))) for each in (before, after))
        found.append(Step(begin, jump, end, float(np.median(before)), float(np.median(after)),
                          spread))
    return found


def moves_against_steps(reference: Array, values: Array, least: float) -> bool:
    """Return whether a signal goes against each step, by more than the share `least` of it."""
    shares = [(step.high - step.low) / (reference[step.jump] - reference[step.jump - 1])
              for step in steps_of(reference, values)
              if abs(step.high - step.low) > 3.0 * step.spread]
    return bool(shares) and max(shares) < -least


def _answered_before(time: Array, reference: Array, values: Array) -> tuple[Interval, ...]:
    """Return intervals from a response to the later jump of the reference that causes it."""
    found = []
    for begin, jump, end, low, high, spread in steps_of(reference, values):
        change = high - low
        share = (values[jump - 1] - low) / change if change else 0.0
        if _there_before(reference, values, begin, jump, end):
            found.append((float(time[begin]), float(time[jump])))
        elif abs(change) > 3.0 * spread and share > BEFORE:
            first = int(np.argmax((values[begin:jump] - low) / change > 0.1)) + begin
            found.append((float(time[first]), float(time[jump])))
    return tuple(found)


def _there_before(reference: Array, values: Array, begin: int, jump: int, end: int) -> bool:
    """Return whether a signal has settled at the new reference before the jump to it."""
    old, new = float(reference[jump - 1]), float(reference[jump])
    share = (values[begin:end] - old) / (new - old)
    until = jump - begin
    low, high = np.quantile(share[until // 2:until], [0.05, 0.95])
    return bool(np.median(share[:5]) < BEFORE and low > 1.0 - BEFORE and high < 1.0 + BEFORE
                and abs(np.median(share[until:]) - 1.0) < BEFORE)


def of_exchange(run: Run, name: str) -> Iterator[Finding]:
    """Yield a finding if the command, in time, cannot be the cause of a signal."""
    if run.command_n is None or run.reference_n is None:
        return
    reference, command, values = run.reference_n, run.command_n, run.signal(name)
    known = np.isfinite(command) & np.isfinite(reference) & np.isfinite(values)
    reference, command, values = (each[known] for each in (reference, command, values))
    if len(values) < FEWEST_SAMPLES or not np.ptp(command) > 0.0:
        return
    if is_noisy(reference) and np.count_nonzero(np.diff(command)) <= MOST_STEPS:
        yield Finding('order', 'time', DOUBTFUL, whole_run(run.time_s),
                      'the reference has noise, and the command only steps: are they exchanged?')
    elif _responds_at_once(reference, command, values):
        yield Finding('order', 'time', DOUBTFUL, whole_run(run.time_s),
                      f'the {name_of(name)} responds to steps of the reference at once, and the '
                      'command later: are they exchanged?')


def _responds_at_once(reference: Array, command: Array, values: Array) -> bool:
    """Return whether a signal changes in the samples in which its reference steps."""
    changes = np.abs(np.diff(reference))
    steps = np.flatnonzero(changes > STEP * float(np.ptp(reference)))
    if not 0 < len(steps) <= MOST_STEPS:
        return False
    of_values, of_command = (np.median(np.abs(np.diff(each))[steps]) / float(np.ptp(each) or 1.0)
                             for each in (values, command))
    return bool(of_values > STEP > 10.0 * of_command)
