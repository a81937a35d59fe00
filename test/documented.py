"""What the `--json` of each command holds, as doc/reference/json.md says."""

import re
from typing import Any

from conftest import ROOT

PAGE = (ROOT / 'doc/reference/json.md').read_text()
KINDS: dict[str, Any] = {
    'number': (int, float), 'integer': int, 'text': str, 'boolean': bool, 'object': dict}


def commands() -> list[str]:
    """Return the commands that have a section."""
    return re.findall(r'^## `(.+)`$', PAGE, re.M)


def keys_of(command: str) -> dict[str, str]:
    """Return the kind of each key of a command, by its path, such as oscillation.amplitude_n."""
    section = PAGE.split(f'## `{command}`\n')[1].split('\n## ')[0]
    keys = {}
    for path, kind, meaning in re.findall(r'^\| `([\w.]+)` \| (\S+) \| (.+) \|$', section, re.M):
        keys[path] = kind
        if other := re.fullmatch(r'as `(.+)`', meaning):
            keys |= {f'{path}.{name}': kind for name, kind in keys_of(other[1]).items()}
    for other in re.findall(r'^and the keys of `(.+)`\.$', section, re.M):
        keys |= keys_of(other)
    return keys


def problems(document: Any, command: str) -> list[str]:
    """Return what in a document is not as documented: missing, of another kind, or unknown."""
    return _problems(document, keys_of(command), '')


def _problems(document: Any, keys: dict[str, str], where: str) -> list[str]:
    here = {path: kind for path, kind in keys.items() if '.' not in path}
    found = [f'{where}{name} is not documented' for name in document if name not in here]
    for name, kind in here.items():
        if name not in document:
            found.append(f'{where}{name} is missing')
            continue
        value = document[name]
        if value is None and kind.endswith('?'):
            continue
        inner = kind.strip('[]?')
        listed = kind.startswith('[')
        values = value if listed and isinstance(value, list) else [value]
        if listed != isinstance(value, list) or not all(
                isinstance(each, KINDS[inner])
                and (inner == 'boolean' or not isinstance(each, bool)) for each in values):
            found.append(f'{where}{name} is not {kind}: {value!r}')
            continue
        below = {path.removeprefix(f'{name}.'): kind for path, kind in keys.items()
                 if path.startswith(f'{name}.')}
        for number, each in enumerate(values if below else []):
            found += _problems(each, below, f'{where}{name}[{number}].')
    return found
