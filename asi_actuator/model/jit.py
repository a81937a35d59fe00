"""How every compiled function is compiled: cached on disk, no fast-math, so that it repeats."""

from typing import Final

import numba

OFF: Final = 0
LINEAR: Final = 1
FULL: Final = 2

# Without fast-math LLVM may not reorder sums: the loop over ROS and the loop in process, which
# inline these functions differently, agree to the last bit.
jit = numba.njit(cache=True, error_model='numpy')
