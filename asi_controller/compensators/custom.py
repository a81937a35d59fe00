"""Any zeros and poles: a notch, for instance, or what another tool has designed."""

import math

from asi_common.parameter import Parameter, ParameterError, Value
from asi_controller.design import MOST_POLES, Compensator, Design


def _roots(name: str, text: Value) -> tuple[complex, ...]:
    """Return the complex numbers of a text such as '-50, -30+40j, -30-40j'."""
    try:
        roots = tuple(complex(part.replace(' ', '')) for part in str(text).split(',')
                      if part.strip())
    except ValueError:
        raise ParameterError(f'{name} = {text!r} is not allowed: it takes numbers in rad/s with '
                             'commas between, as "-50, -30+40j, -30-40j"') from None
    if not all(math.isfinite(abs(root)) for root in roots):
        raise ParameterError(f'{name} = {text!r} is not allowed: every number must be finite')
    if sorted(roots, key=_order) != sorted((root.conjugate() for root in roots), key=_order):
        raise ParameterError(f'{name} = {text!r} is not allowed: complex numbers must come in '
                             'conjugate pairs')
    return roots


def _order(root: complex) -> tuple[float, float]:
    return root.real, root.imag


def design(gain: float, zeros: str, poles: str) -> Design:
    """Return the zeros and poles of the two texts. Raises ParameterError if one is not allowed."""
    z, p = _roots('custom.zeros', zeros), _roots('custom.poles', poles)
    if len(z) > len(p):
        raise ParameterError(f'custom.zeros has {len(z)} and custom.poles {len(p)} '
                             'numbers: there may not be more zeros than poles')
    if len(p) > MOST_POLES:
        raise ParameterError(f'custom.poles has {len(p)} numbers: at most {MOST_POLES} are '
                             'allowed')
    for pole in p:
        if pole.real >= 0.0:
            raise ParameterError(f'custom.poles: {pole:g} is not allowed: every pole needs a real '
                                 'part below 0')
    for zero in z:
        if zero == 0.0:
            raise ParameterError('custom.zeros: 0 is not allowed: the gain is that at zero '
                                 'frequency')
    return Design(z, p, gain)


COMPENSATOR = Compensator('custom', gain=1.0, order=90, design=design, parameters=(
    Parameter('zeros', '', 'rad/s', 'Zeros of the custom compensator, as "-50, -30+40j, -30-40j"'),
    Parameter('poles', '', 'rad/s', 'Poles of the custom compensator, in the same form'),
))
