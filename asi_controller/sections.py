"""
Second-order sections of the zeros and poles of a discrete filter.

As those of `scipy.signal.zpk2sos`, to the last bit; but to import that takes longer than all else
that a node does before its first tick.
"""

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import numpy.typing as npt

Roots = npt.NDArray[np.complex128]
Distance = Callable[[Roots], npt.NDArray[np.float64]]


def second_order_sections(zeros: Sequence[complex], poles: Sequence[complex]
                          ) -> npt.NDArray[np.float64]:
    """
    Return the sections (n x 6: b0 b1 b2 a0 a1 a2) of as many zeros as poles.

    The poles nearest to the unit circle are in the last section, each pole with its nearest zero.
    Raises ValueError if there is a complex root without its conjugate.
    """
    odd = [0.0] * (len(poles) % 2)
    z, p = _without_conjugates([*zeros, *odd]), _without_conjugates([*poles, *odd])
    sections = []
    while len(p):
        of_denominator, p = _take_two(p, lambda roots: np.abs(1.0 - np.abs(roots)))
        of_numerator, z = _take_two(z, partial(_distance, of_denominator[0]))
        sections.append(np.append(np.poly(of_numerator), np.poly(of_denominator)))
    return np.array(sections[::-1])


def _distance(root: complex, roots: Roots) -> npt.NDArray[np.float64]:
    """Return the distances of roots from one."""
    return np.abs(roots - root)


def _without_conjugates(roots: Sequence[complex]) -> Roots:
    """Return one of each complex pair and the real roots, in order."""
    given = np.array(roots, np.complex128)
    above, below = given[given.imag > 0.0], given[given.imag < 0.0]
    if not np.array_equal(np.sort_complex(above), np.sort_complex(below.conj())):
        raise ValueError(f'not all of {roots} have a conjugate')
    return np.append(np.sort_complex(above), np.sort_complex(given[given.imag == 0.0]))


def _take_two(roots: Roots, distance: Distance) -> tuple[Roots, Roots]:
    """Return the nearest root, with its conjugate or else the nearest real one, and the rest."""
    nearest = int(np.argmin(distance(roots)))
    first, rest = roots[nearest], np.delete(roots, nearest)
    if first.imag:
        return np.array([first, first.conj()]), rest
    real = np.flatnonzero(rest.imag == 0.0)
    second = real[np.argmin(distance(rest[real]))]
    return np.array([first, rest[second]]), np.delete(rest, second)
