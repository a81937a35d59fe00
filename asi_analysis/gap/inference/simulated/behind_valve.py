"""
What follows a fitted valve: the position of that valve, and the uncertainty of its fit.

The force shows a lag of the valve more exactly than its own, noisy position. So the errors of the
valve's fit are parameters of what follows it, with the normal distribution that the fit gave them
(Ljung, System Identification, 2nd ed., 9.2); else they would be taken for an effect there.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from asi_analysis.arrays import Array
from asi_analysis.gap.inference.fit import Fitted
from asi_analysis.gap.inference.posterior import ODDS_AGAINST
from asi_analysis.gap.inference.uncertainty import likelihood
from asi_analysis.gap.model import simulator
from asi_analysis.gap.model.effects import Free
from asi_analysis.gap.model.group import (
    OF_VALVE_GAIN,
    VALVE_GAIN,
    Group,
    exact,
    is_of_valve,
    prepared_for,
    with_valve_gain,
)
from asi_analysis.gap.model.predict import predict
from asi_analysis.gap.model.simulator import metres_per_newton


def gain_is_off(valve: np.void, behind: Group, gain: Free | None) -> bool:
    """
    Return whether the fitted gain of the valve is improbable, so that it is an answer of its own.

    By the normal priors of all factors of the gain. valve: the record of the valve's fit; behind:
    the group of what follows it; gain: the uncertain gain, as `with_free_gain` returns it.
    """
    if gain is None:
        return False
    factors = (gain, *(free for free in behind.nuisance if free.field in OF_VALVE_GAIN
                       and free.field != VALVE_GAIN))
    variance = sum(free.prior ** 2 for free in factors)
    off = math.log(metres_per_newton(valve) / metres_per_newton(behind.nominal))
    return 0.5 * off ** 2 / variance > ODDS_AGAINST


def with_free_gain(valve: Group) -> tuple[Group, Free | None]:
    """
    Return the valve with a gain of any size, and the uncertain gain.

    The position shows only the product of the gain with full opening over maximum force, so the
    tolerance of the gain is judged with what follows the valve.
    """
    gain = next((free for free in valve.nuisance if free.field == VALVE_GAIN), None)
    return replace(valve, nuisance=tuple(
        free._replace(prior=math.inf) if free is gain else free for free in valve.nuisance)), gain


def behind_valve(group: Group, valve: Fitted, gain: Free | None = None, only_noise: bool = False
                 ) -> Group:
    """
    Return a group with the parameters of a fitted valve, and their errors as parameters.

    The position of the valve is the simulated one, plus that part of its residual which is above
    the noise, unless it is `only_noise`: of coloured noise some would pass. gain: the uncertain
    gain of the valve, if it is to be a parameter of this group, too.
    """
    return with_simulated_valve(group, valve.record, _errors_of(valve), gain, only_noise)


def with_simulated_valve(group: Group, valve: np.void, errors: Sequence[np.void] = (),
                         gain: Free | None = None, only_noise: bool = False) -> Group:
    """
    Return a group behind a valve, as `behind_valve` does.

    valve: the fitted record; errors: that record with each error of a standard deviation.
    Predictions are linear in the errors, about the nominal parameters of what follows the valve.
    """
    group = replace(group, only_noise_of_valve=only_noise)
    made = _with_valve_of(group, valve, gain)
    others = [_with_valve_of(group, each, gain) for each in errors]
    p, free = simulator.with_valve_errors(made.nominal, len(errors))
    changes = [{channel: np.transpose([_predicted(other, number, channel)
                                       - _predicted(made, number, channel) for other in others])
                for channel in group.channels if others}
               for number in range(len(made.recordings))]
    recordings, p['maximum_substep'] = simulator.with_corrections(
        made.recordings, group.channels, with_valve_gain(made, p), group.error_floor,
        group.exact_substep_s)
    given, _ = simulator.with_valve_errors(group.nominal, len(errors))
    return replace(made, nominal=p, given=given, nuisance=(*made.nuisance, *free), recordings=[
        replace(recording, valve_errors=each)
        for recording, each in zip(recordings, changes, strict=True)])


def _errors_of(fitted: Fitted) -> list[np.void]:
    """
    Return the record of a fit with each of its uncorrelated errors, of a standard deviation.

    Along the axes of its normal distribution, where a range without a prior counts as a standard
    deviation; to that side where the bounds leave more room.
    """
    problem, theta = fitted.problem, fitted.theta
    curvature, axes = np.linalg.eigh(likelihood(fitted).square + np.eye(theta.size))
    sides = [[np.clip(theta + sign * axis, 0.0, 1.0) for sign in (1.0, -1.0)]
             for axis in (axes / np.sqrt(curvature)).T]
    return [exact(problem.group, problem.record(max(
        both, key=lambda side: float(np.linalg.norm(side - theta))))) for both in sides]


def _predicted(group: Group, number: int, channel: str) -> Array:
    """Return the prediction of a channel of a recording with the nominal parameters."""
    return predict(group.recordings[number], channel, with_valve_gain(group, group.nominal))


def _with_valve_of(group: Group, valve: np.void, gain: Free | None) -> Group:
    """Return a group with the valve of a record, whose predictions are not corrected."""
    p = group.nominal.copy()
    for name in p.dtype.names or ():
        if is_of_valve(name) and name not in OF_VALVE_GAIN:
            p[name] = valve[name]
    if gain is not None and gain.field not in {free.field for free in group.nuisance}:
        group = replace(group, nuisance=(*group.nuisance, gain))
    group = replace(group, nominal=p, valve_gain=simulator.metres_per_newton(valve))
    return replace(group, recordings=[replace(prepared_for(group, r), corrections={}, cache={})
                                      for r in group.recordings])
