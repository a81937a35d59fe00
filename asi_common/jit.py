"""How every compiled function is compiled: cached on disk, no fast-math, so that it repeats."""

from collections.abc import Callable
from typing import Any, Final

import numba

from asi_common.jit_cache import cache_folder

OFF: Final = 0
LINEAR: Final = 1
FULL: Final = 2


_FOLDER: Final = cache_folder()
if _FOLDER is not None:
    setattr(numba.config, 'CACHE_DIR', str(_FOLDER))  # noqa: B010 (numba adds it late)

# Without fast-math LLVM may not reorder sums: the loop over ROS and the loop in process, which
# inline these functions differently, agree to the last bit.
jit = numba.njit(cache=_FOLDER is not None, error_model='numpy', nogil=True)
# For what a sub-step calls: LLVM's own guess leaves these out of line, and passing their many
# arguments took a tenth of the time.
inlined = numba.njit(cache=_FOLDER is not None, error_model='numpy', nogil=True, forceinline=True)


def compiled_for(function: Any, *arguments: object) -> Callable[..., Any]:
    """
    Return what a compiled function is for arguments of exactly these types; compiles it now.

    A call of the function itself finds out the type of each argument first, which takes 2 us for
    a compensator that takes 0.3 us. Nothing checks here: other types are undefined behaviour.
    """
    entry: Callable[..., Any] = function.compile(tuple(map(numba.typeof, arguments)))
    return entry
