"""
Additions to any compensator: one file each, with its parameters, null by default.

`asi_controller/compensator.py` calls their functions where they belong in the signal path.
"""

from importlib import import_module
from pkgutil import iter_modules
from typing import Final

from asi_common.parameter import Parameter

_MODULES: Final = {module.name: import_module(f'{__name__}.{module.name}')
                   for module in iter_modules(__path__)}

# Parameters of each addition, with their full names, and what it is, in Markdown.
ADDITIONS: Final[dict[str, tuple[Parameter, ...]]] = {
    name: tuple(each._replace(name=f'{name}.{each.name}') for each in module.PARAMETERS)
    for name, module in _MODULES.items()}
DOCUMENTATION: Final[dict[str, str]] = {
    name: (module.__doc__ or '').strip() for name, module in _MODULES.items()}
