"""The shrink of the gap on the validation samples, which no fit uses, with an interval."""

import math
from typing import NamedTuple

import numpy as np

from asi_analysis.arrays import Array
from asi_analysis.gap.inference.uncertainty import LIMIT_95
from asi_analysis.gap.model.effects import MOTIONS
from asi_analysis.gap.model.group import Group
from asi_analysis.gap.model.predict import compared, measured, unexplained

STRETCHES = 24   # of the validation samples: longer than the correlation time of the errors
DRAWS = 1000
# Factor on the standard deviation of a bootstrap over stretches: those of one recording do not
# show how recordings differ.
FRESH = 2.4
# An actuator's recording of another amplitude and excitation shows other errors of the model: what
# is left is larger by a factor whose logarithm has this mean and standard deviation. Set by hand
# on cases of an examiner that is not in the repository: no command here repeats them.
WORSE, SPREAD = 0.6, 0.85


class Shrink(NamedTuple):
    """
    The gap of one channel before and after, as a share of the signal's rms.

    nominal: with the nominal parameters; refitted: with the uncertain ones fitted; after: with the
    effects of the verdict. shrink = 1 - after / nominal, with its 95 % interval low to high.
    edge_hz: of a motion, the upper end of the band in which it is compared; else None.
    """

    channel: str
    nominal: float
    refitted: float
    after: float
    noise_floor: float
    shrink: float
    low: float
    high: float
    edge_hz: float | None

    @property
    def noise_alone(self) -> float:
        """
        Return the error of noise alone, at most what a model leaves.

        That of a motion is estimated above its band, where there may be more of it than within.
        """
        return min(self.noise_floor, self.nominal, self.refitted, self.after)


def stretches_error(group: Group, channel: str, p: np.void) -> Array:
    """Return the mean square residual in each stretch of the validation samples."""
    residual = np.concatenate([unexplained(recording, channel, p)[recording.report]
                               for recording in group.recordings])
    stretches = np.array_split(residual, min(STRETCHES, residual.size))
    return np.array([np.mean(part ** 2) for part in stretches])


def shrink_of(group: Group, channel: str, refitted: np.void, after: np.void,
              elsewhere: bool) -> Shrink:
    """
    Return the shrink of the gap of a channel: of a motion, in the band in which it is compared.

    elsewhere: its interval is for a fresh recording of another amplitude and excitation, not only
    for one of the same kind.
    """
    square = np.concatenate([compared(r, channel, measured(r, channel))[r.report] ** 2
                             for r in group.recordings])
    size = math.sqrt(float(square.mean())) or 1.0
    errors = {name: stretches_error(group, channel, p)
              for name, p in (('nominal', group.as_given), ('refitted', refitted),
                              ('after', after))}
    rms = {name: math.sqrt(float(error.mean())) for name, error in errors.items()}
    edge = max((r.motion.edge_hz for r in group.recordings if r.motion), default=None) if (
        channel in MOTIONS) else None
    floor = group.noise[channel] * math.sqrt(group.band(channel))
    if rms['nominal'] ** 2 <= group.judged_floor(channel) - floor ** 2:
        # Below the model error that any model has: there is no gap that could shrink.
        return Shrink(channel, rms['nominal'] / size, rms['refitted'] / size, rms['after'] / size,
                      floor / size, 0.0, 0.0, 0.0, edge)
    shrink = 1.0 - rms['after'] / rms['nominal'] if rms['nominal'] else 0.0
    low, high = _interval(shrink, errors['nominal'], errors['after'], elsewhere)
    return Shrink(channel, rms['nominal'] / size, rms['refitted'] / size, rms['after'] / size,
                  floor / size, shrink, low, high, edge)


def _interval(shrink: float, nominal: Array, after: Array, elsewhere: bool
              ) -> tuple[float, float]:
    """
    Return the 95 % interval of the shrink on a fresh recording.

    nominal, after: mean square residual in each stretch; elsewhere: as in `shrink_of`.
    """
    times = np.random.default_rng(1).multinomial(nominal.size, np.full(nominal.size,
                                                                       1.0 / nominal.size), DRAWS)
    left = 0.5 * np.log(np.maximum(times @ after, 1e-300) / np.maximum(times @ nominal, 1e-300))
    # Where the model changes little, both errors are larger by the same factor.
    changed = elsewhere * max(shrink, 0.0)
    spread = LIMIT_95 * math.hypot(FRESH * float(left.std()), SPREAD * changed)
    least, most = (1.0 - (1.0 - shrink) * math.exp(WORSE * changed + end)
                   for end in (spread, -spread))
    return least, most
