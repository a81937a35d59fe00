"""
The compensators: one file each, which declares itself as `COMPENSATOR` and is found here.

A file that is added here becomes a choice of the parameter `compensator`. Its parameters, their
YAML file, documentation (the docstring of the file) and tests follow; nothing else names it.
"""

from importlib import import_module
from pkgutil import iter_modules
from typing import Final

from asi_controller.design import Compensator

_MODULES: Final = [import_module(f'{__name__}.{module.name}') for module in iter_modules(__path__)]

COMPENSATORS: Final[dict[str, Compensator]] = {
    module.COMPENSATOR.name: module.COMPENSATOR
    for module in sorted(_MODULES, key=lambda module: module.COMPENSATOR.order)}

# What each is, in Markdown, by name.
DOCUMENTATION: Final[dict[str, str]] = {
    module.COMPENSATOR.name: (module.__doc__ or '').strip() for module in _MODULES}
