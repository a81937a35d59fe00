"""A recording of several joints as one bag a joint: `{joint}` in a mapping stands for its name."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from asi_analysis.bags.exchange.column_mapping import column_part, listed, parse_mapping
from asi_analysis.bags.exchange.table_file import Table
from asi_analysis.errors import InputError

JOINT: Final = '{joint}'


def joints_of(mapping: Sequence[str], table: Table, path: Path) -> dict[str, list[str]]:
    """
    Return the mapping of each joint that has a column of every signal, by its name.

    mapping: texts, `{joint}` in some of them. Raises InputError if no joint has all of them.
    """
    held: dict[str, list[str]] = {}
    for text in (text for text in mapping if JOINT in text):
        first, *rest = map(re.escape, column_part(parse_mapping(text)).split(JOINT))
        name = f'{first}(.+?)' + r'\1'.join(rest) + r'(?: \[[^\[\]]*\])?'   # q_hip [deg]
        held[text] = [found[1] for column in table if (found := re.fullmatch(name, column))]
    names = [name for name in next(iter(held.values()), [])
             if all(name in each for each in held.values())]
    if not names:
        raise InputError(f'{path}: no joint has a column of each signal: ' + '; '.join(
            f'{text} has {listed(each) or "none"}' for text, each in held.items()))
    folders = [folder_name(name) for name in names]
    if twice := [name for name, folder in zip(names, folders, strict=True)
                 if folders.count(folder) > 1]:
        raise InputError(f'{path}: the joints {", ".join(twice)} would have one folder: import '
                         'them one by one')
    return {name: [text.replace(JOINT, name) for text in mapping] for name in names}


def folder_name(joint: str) -> str:
    """Return the name of the bag of a joint."""
    return re.sub(r'[^\w.-]', '_', joint)


def bags_in(folder: Path) -> dict[str, Path]:
    """Return the bags in a folder that `asi import` wrote, by joint. Raises InputError."""
    found = {each.name: each for each in sorted(folder.iterdir())
             if (each / 'metadata.yaml').exists()} if folder.is_dir() else {}
    if not found:
        raise InputError(f'{folder}: expected a bag with joint states, or a folder with a bag for '
                         f'each joint, as asi import writes it with {JOINT} in its mapping')
    return found
