"""Numba decorators: compiled code is cached on disk and, without fast-math, reproducible."""

from collections.abc import Callable
from typing import Any, Final

import numba
from numba.core import event

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
# For functions of a sub-step: LLVM by itself does not inline them, and passing their many
# arguments takes a tenth of the time.
inlined = numba.njit(cache=_FOLDER is not None, error_model='numpy', nogil=True, forceinline=True)


class _Compiling(event.Listener):
    """Counts the compilations in progress; they can be nested."""

    number = 0
    tell: Callable[[], object] | None = None    # called when the first begins

    def on_start(self, event: Any) -> None:
        self.number += 1
        if self.tell is not None:
            tell, self.tell = self.tell, None
            tell()

    def on_end(self, event: Any) -> None:
        self.number -= 1


_compiling: Final = _Compiling()
event.register('numba:compile', _compiling)


def compiling() -> bool:
    """Return whether numba compiles in this process now."""
    return _compiling.number > 0


def when_compiling(tell: Callable[[], object]) -> None:
    """Call a function when this process begins to compile; loading code from the cache is none."""
    _compiling.tell = tell


def compiled_for(function: Any, *arguments: object) -> Callable[..., Any]:
    """
    Compile a function for the types of these arguments and return that specialisation.

    It skips the dispatch on argument types, which takes 2 us for a compensator that takes 0.3 us.
    Types are not checked: a call with others is undefined behaviour.
    """
    entry: Callable[..., Any] = function.compile(tuple(map(numba.typeof, arguments)))
    return entry
