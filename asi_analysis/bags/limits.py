"""How much a compressed file may unpack to: its reader's limit, or the one a user has set."""

import math
import os
from typing import Final

from asi_analysis.errors import InputError

VARIABLE: Final = 'ASI_MOST_UNPACKED_MB'
IF_INTENDED: Final = f'if that is intended, unpack it first, or set {VARIABLE}'


def unpack_limit(size: int, usual: int, ratio: int) -> int:
    """
    Return the limit for a file of this size (bytes): the usual one, or `ratio` times its size.

    The environment variable ASI_MOST_UNPACKED_MB replaces both. Raises InputError if that is not
    a number above 0.
    """
    given = os.environ.get(VARIABLE)
    if not given:
        return max(usual, ratio * size)
    try:
        megabytes = float(given)
    except ValueError:
        megabytes = math.nan
    if not 0.0 < megabytes < math.inf:
        raise InputError(f'{VARIABLE} = {given[:60]!r} is not allowed: it takes a number of MB '
                         'above 0')
    return int(1e6 * megabytes)
