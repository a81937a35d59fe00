"""A parameter's descriptor as a slider, a choice, a switch or a text field."""

import math
from typing import Any, Final, NamedTuple

from rcl_interfaces.msg import ParameterDescriptor

CHOICES: Final = 'one of '
# A range that ends far above the value is logarithmic, over at most so many powers of ten.
FAR: Final = 20.0
DECADES: Final = 6.0


class Scale(NamedTuple):
    """A range of numbers on a slider from 0 to 1."""

    low: float
    high: float
    logarithmic: bool
    whole: bool

    def value(self, place: float) -> float | int:
        """Return the number at a place, with 3 digits."""
        if not self.logarithmic:
            found = self.low + place * (self.high - self.low)
        elif place <= 0.0:
            found = self.low
        else:
            found = self.high * 10.0 ** (self._decades() * (place - 1.0))
        found = min(max(float(f'{found:.3g}'), self.low), self.high)
        return round(found) if self.whole else found

    def place(self, value: float) -> float:
        """Return the place of a number."""
        if not self.logarithmic:
            share = (value - self.low) / (self.high - self.low)
        elif value <= 0.0:
            share = 0.0
        else:
            share = 1.0 + math.log10(value / self.high) / self._decades()
        return min(max(share, 0.0), 1.0)

    def _decades(self) -> float:
        return min(DECADES, math.log10(self.high / self.low)) if self.low > 0.0 else DECADES


def scale_of(descriptor: ParameterDescriptor, value: float) -> Scale | None:
    """Return the scale of the range of a parameter that has a value; None without a range."""
    for ranges, whole in ((descriptor.floating_point_range, False),
                          (descriptor.integer_range, True)):
        for each in ranges:
            low, high = float(each.from_value), float(each.to_value)
            if math.isfinite(low) and math.isfinite(high) and low < high:
                return Scale(low, high, low >= 0.0 and high > FAR * value, whole)
    return None


def unit_of(descriptor: ParameterDescriptor) -> str:
    """Return the unit of a number with a range, '' if it has none."""
    return descriptor.additional_constraints.partition(' to ')[2].partition(' ')[2]


def choices_of(descriptor: ParameterDescriptor) -> list[str]:
    """Return the values that a text parameter takes; [] for any."""
    text = descriptor.additional_constraints
    return text.removeprefix(CHOICES).split(', ') if text.startswith(CHOICES) else []


def typed(text: str, value: Any) -> Any:
    """Return the value typed for a parameter: a number if its value is one, else the text."""
    if isinstance(value, str):
        return text
    try:
        return int(text) if isinstance(value, int) else float(text)
    except ValueError:
        return text
