"""How every compiled function is compiled: cached on disk, no fast-math, so that it repeats."""

import hashlib
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numba

OFF: Final = 0
LINEAR: Final = 1
FULL: Final = 2


def _cache_folder() -> Path:
    """
    Return a folder for compiled code that belongs to exactly this source.

    Numba notices that a file has changed, but not that a function which it calls in another file
    has; so the folder's name is made from all files that compile. Older ones of this installation
    are removed.
    """
    root = Path(__file__).parents[1]
    sources = [path.read_bytes() for package in ('asi_common', 'asi_actuator', 'asi_controller',
                                               'asi_analysis')
               for path in sorted((root / package).rglob('*.py'))]
    text = b''.join(source for source in sources if b'asi_common.jit import' in source)
    base = Path(os.environ.get('NUMBA_CACHE_DIR')
                or Path(os.environ.get('XDG_CACHE_HOME') or '~/.cache').expanduser() / 'numba')
    here = base / f'asi_actuator-{hashlib.sha256(bytes(root)).hexdigest()[:12]}'
    folder = here / hashlib.sha256(text).hexdigest()[:12]
    if not folder.exists():
        shutil.rmtree(here, ignore_errors=True)
        folder.mkdir(parents=True, exist_ok=True)
    return folder


setattr(numba.config, 'CACHE_DIR', str(_cache_folder()))  # noqa: B010 (numba adds it late)

# Without fast-math LLVM may not reorder sums: the loop over ROS and the loop in process, which
# inline these functions differently, agree to the last bit.
jit = numba.njit(cache=True, error_model='numpy', nogil=True)
# For what a sub-step calls: LLVM's own guess leaves these out of line, and passing their many
# arguments took a tenth of the time.
inlined = numba.njit(cache=True, error_model='numpy', nogil=True, forceinline=True)


def compiled_for(function: Any, *arguments: object) -> Callable[..., Any]:
    """
    Return what a compiled function is for arguments of exactly these types; compiles it now.

    A call of the function itself finds out the type of each argument first, which takes 2 us for
    a compensator that takes 0.3 us. Nothing checks here: other types are undefined behaviour.
    """
    entry: Callable[..., Any] = function.compile(tuple(map(numba.typeof, arguments)))
    return entry
