"""
What the sensor of a joint's force does is seen twice if the command was recorded, too.

From the force to the motion, and from the command to the force, where it looks like a fault of
the drive.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from asi_analysis.gap.inference.hypotheses import Candidate, Weighed
from asi_analysis.gap.inference.probability import Names, marginals, with_moved
from asi_analysis.gap.model.blocks import drift, parts
from asi_analysis.gap.model.effects import UNKNOWN
from asi_common.record import copy_of

# An effect of the drive, that of the sensor which it may be, and the field of the former.
SEEN_TWICE: Final = (('valve_lag', 'sensor_lag', 'valve_lag'),
                     ('valve_bias', 'sensor_drift', 'command_bias'))
ALIKE: Final = 1.5   # ratio of two lags below which they may be one


def with_one_sensor(weighed: Sequence[Weighed]) -> list[Weighed]:
    """Return the groups of a joint; of its drive, what its sensor explains is the sensor's."""
    if [each.group.channels for each in weighed] != [('valve',), ('load',)]:
        return list(weighed)
    drive, load = weighed
    for (of_drive, of_sensor, _), alike in zip(SEEN_TWICE, (_lag_alike, _drift_alike),
                                               strict=True):
        drive = _renamed(drive, of_drive, of_sensor, load, alike)
    return [drive, load]


def _renamed(drive: Weighed, of_drive: str, of_sensor: str, load: Weighed,
             alike: Callable[[Candidate, Candidate], bool]) -> Weighed:
    """Return the drive whose fault is, with the sensor's probability, that of the sensor."""
    share = marginals(load.probability)[of_sensor]
    seen = [each for names, each in load.candidates.items() if of_sensor in names]
    if not seen:
        return drive
    sensor = max(seen, key=lambda each: load.probability.get(each.names, 0.0))
    twice = [each for names, each in drive.candidates.items()
             if of_drive in names and alike(each, sensor)]
    if not twice:
        return drive

    def of_the_sensor(names: Names) -> Names:
        return tuple(sorted({*names, of_sensor} - {of_drive}))

    chance, candidates = drive.probability, dict(drive.candidates)
    for each in twice:
        for names in (each.names, tuple(sorted((*each.names, UNKNOWN)))):
            chance = with_moved(chance, names, of_the_sensor(names), share)
        own = of_the_sensor(each.names)
        candidates[own] = each._replace(names=own)
    effects = drive.group.effects
    group = replace(drive.group, effects={
        **effects, of_sensor: (*effects[of_sensor], *effects[of_drive])})
    return drive._replace(group=group, probability=chance, candidates=candidates)


def of_the_drive(p: np.void, names: Names) -> np.void:
    """Return the record of a drive with these effects, without what is the sensor's."""
    own = copy_of(p)
    for _, of_sensor, field in SEEN_TWICE:
        if of_sensor in names:
            own[field] = 0.0
    return own


def _lag_alike(drive: Candidate, sensor: Candidate) -> bool:
    """Return whether the lag of a drive may be that of the sensor."""
    lags = drive.fitted.values.get('valve_lag', 0.0), sensor.fitted.values['sensor_lag']
    return max(lags) < ALIKE * min(lags)


def _drift_alike(drive: Candidate, sensor: Candidate) -> bool:
    """Return whether the bias of a drive is between none and the largest drift of the sensor."""
    p, seen = drive.fitted.record, sensor.fitted
    drifts = np.concatenate([drift(r.time_s, parts(seen.record)[1])
                             for r in seen.problem.group.recordings])
    bias = float(p['command_bias'] * p['valve_characteristic_gain'])
    return bool(min(drifts.min(), 0.0) <= bias <= max(drifts.max(), 0.0))
