"""Calibration of the force sensor: offset measured at rest, offset and scale stored in a file."""

import math
from collections import deque
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
import yaml

from asi_actuator.model.actuator import Measurement
from asi_common.files import read_text, write_text
from asi_common.parameter import ParameterError, is_number

# Time for which the actuator must have been at rest, s, and the largest changes at rest: of the
# valve command and of the mean force, N; of the mean valve position, m (1 % of the full opening).
WINDOW_S: Final = 0.2
CHANGE_N: Final = 1.0
CHANGE_M: Final = 2e-7


class Calibration(NamedTuple):
    """The calibrated force is scale * (reading - offset)."""

    offset_n: float = 0.0
    scale: float = 1.0

    def applied(self, reading: Measurement) -> Measurement:
        """Return a reading, its force calibrated."""
        force, valve, position, velocity = reading
        return self.scale * (force - self.offset_n), valve, position, velocity


def load(path: str) -> Calibration:
    """
    Return the calibration in a file; none (scale 1) if the path is empty or there is no file yet.

    Raises ParameterError if the file is not a calibration.
    """
    if not path or not Path(path).expanduser().exists():
        return Calibration()
    where = f'calibration_file = {path!r}'
    try:
        content = yaml.safe_load(read_text(Path(path).expanduser()))
    except (OSError, UnicodeDecodeError, RecursionError, yaml.YAMLError) as error:
        raise ParameterError(f'{where} cannot be read: {" ".join(str(error).split())}') from error
    if not isinstance(content, dict) or set(content) != set(Calibration._fields):
        raise ParameterError(f'{where} must hold the numbers {" and ".join(Calibration._fields)}, '
                             'nothing else')
    for name, value in content.items():
        if not is_number(value) or not math.isfinite(value) or (
                name == 'scale' and value == 0):
            raise ParameterError(f'{where}: {name} = {value!r} is not allowed: it takes a finite '
                                 'number' + (' other than 0' if name == 'scale' else ''))
    return Calibration(**content)


def save(path: str, calibration: Calibration) -> None:
    """Write a file that `load` reads, atomically."""
    place = Path(path).expanduser()
    place.parent.mkdir(parents=True, exist_ok=True)
    write_text(place, yaml.safe_dump(
        {name: float(value) for name, value in calibration._asdict().items()}))


class Rest:
    """The readings of the last WINDOW_S, and whether they were taken at rest."""

    def __init__(self, rate_hz: float):
        """Begin without readings."""
        self._readings: deque[tuple[Measurement, float]] = deque(
            maxlen=max(4, round(WINDOW_S * rate_hz)))
        # Takes what was read, with the command (N).
        self.add = self._readings.append

    def mean_n(self) -> float:
        """Return the mean of the readings of the force sensor, N."""
        return float(np.mean([reading[0] for reading, _ in self._readings]))

    def mean_valve_m(self) -> float:
        """Return the mean of the readings of the valve position, m."""
        return float(np.mean([reading[1] for reading, _ in self._readings]))

    def problem(self, most_noise_n: float) -> str:
        """Return why the mean is not that of a sensor at rest; '' if it is."""
        if len(self._readings) != self._readings.maxlen:
            return (f'there are {len(self._readings)} readings so far, '
                    f'{self._readings.maxlen} are needed')
        force, command, valve = np.transpose(
            [(reading[0], command, reading[1]) for reading, command in self._readings])
        if np.ptp(command) > CHANGE_N:
            return (f'the valve command moved by {np.ptp(command):.3g} N within the last '
                    f'{WINDOW_S:g} s, at most {CHANGE_N:g} N is allowed at rest')
        for signal, values, unit, most in (('force', force, 'N', CHANGE_N),
                                           ('valve', valve, 'm', CHANGE_M)):
            change, noise = _change(values)
            if change > most + noise:
                return (f'the {signal} moved by {change:.3g} {unit} within the last '
                        f'{WINDOW_S:g} s, at most {most:g} {unit} is allowed at rest')
        if force.std() > most_noise_n:
            return (f'the noise of the force is {force.std():.3g} N (standard deviation), '
                    f'calibration_noise allows {most_noise_n:g} N')
        return ''


def _change(values: npt.NDArray[np.float64]) -> tuple[float, float]:
    """Return the difference of the means of both halves, and its bound for noise alone."""
    middle = values.size // 2
    change = abs(float(values[middle:].mean() - values[:middle].mean()))
    # The difference of two means of n/2 samples spreads by 2 std / sqrt(n); four times that.
    noise = max(float(half.std()) for half in (values[:middle], values[middle:]))
    return change, 4.0 * 2.0 * noise / math.sqrt(values.size)
