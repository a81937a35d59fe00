"""
The compensators: one file each, which declares itself as `COMPENSATOR` and is found here.

A file that is added here becomes a choice of the parameter `compensator`. Its parameters, their
YAML file, documentation (the docstring of the file) and tests follow; nothing else names it.
"""

from importlib import import_module
from pkgutil import iter_modules
from types import ModuleType
from typing import Final

from asi_controller.design import Compensator


def _declared() -> list[ModuleType]:
    """Return the files here that declare a compensator, in the order of lists."""
    return sorted((import_module(f'{__name__}.{file.name}') for file in iter_modules(__path__)),
                  key=lambda module: module.COMPENSATOR.order)


_MODULES: Final = _declared()
COMPENSATORS: Final[dict[str, Compensator]] = {
    module.COMPENSATOR.name: module.COMPENSATOR for module in _MODULES}

# What each is, in Markdown, by name.
DOCUMENTATION: Final[dict[str, str]] = {
    module.COMPENSATOR.name: (module.__doc__ or '').strip() for module in _MODULES}
