"""
Write what follows from the code: parameter files, and pages of rooms, commands, topics.

`python doc/generate.py` in the root of the repository writes the files of parameters, and the
tables of rooms and topics and the diagram of imports into documents; tests check that they are
current.
The build of the documents (`conf.py`) calls the rest.
"""

import ast
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Final

import grimp

ROOT: Final = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))   # the packages that stand here, not installed ones
# Packages whose sub-packages are rooms of their own; the others are one room each.
OPENED: Final = ('asi_common', 'asi_actuator', 'asi_controller', 'asi_analysis')
PACKAGES: Final = (*OPENED, 'asi_examiner')
PARTS: Final = {ROOT / 'doc/explanation/architecture.md': ('rooms', 'imports'),
                ROOT / 'doc/explanation/gap.md': ('effects', 'sizes'),
                ROOT / 'doc/reference/topics.md': ('topics',),
         ROOT / 'CONTRIBUTING.md': ('imports',)}


def first_line(module: str) -> str:
    """Return the first line of the docstring of a module or package."""
    path = ROOT / module.replace('.', '/')
    source = path / '__init__.py' if path.is_dir() else path.with_suffix('.py')
    return (ast.get_docstring(ast.parse(source.read_text())) or '').split('\n')[0]


def rooms() -> list[str]:
    """Return the packages and sub-packages that hold the code, each after what it is part of."""
    found = []
    for package in PACKAGES:
        found.append(package)
        if package in OPENED:
            found += [f'{package}.{path.parent.name}'
                      for path in sorted((ROOT / package).glob('*/__init__.py'))]
    return found


def rooms_table() -> str:
    """Return the rooms with the first line of each, as a Markdown table."""
    rows = [f'| `{room.replace(".", "/")}` | {first_line(room)} |' for room in rooms()]
    return '\n'.join(['| folder | what it holds |', '|---|---|', *rows])


def topics_table() -> str:
    """Return the topics of the loop as a Markdown table."""
    from asi_common.topics import TOPICS
    rows = [f'| `{topic.name}` | {topic.type} | {topic.publisher} | {topic.content} |'
            for topic in TOPICS.values() if topic.publisher]
    return '\n'.join(['| topic | type | from | content |', '|---|---|---|---|', *rows])


def direct_imports() -> dict[str, set[str]]:
    """
    Return what each box of the diagram imports; a box is a room, or loose modules of a package.

    Loose modules that import a room of their own package make a box above it, others one below.
    """
    graph = grimp.build_graph(*PACKAGES)
    known = rooms()

    def box_of(module: str) -> str:
        room = max((room for room in known if f'{module}.'.startswith(f'{room}.')), key=len)
        if room not in OPENED or not any(each.startswith(f'{room}.') for each in known):
            return room
        below = {path.parent.name for path in (ROOT / room).glob('*/__init__.py')}
        uses = graph.find_upstream_modules(module)
        above = any(f'{each}.'.startswith(tuple(f'{room}.{name}.' for name in below))
                    for each in uses)
        return f'{room} above' if above else room

    boxes: dict[str, set[str]] = {}
    for module in graph.modules:
        used = graph.find_modules_directly_imported_by(module)
        boxes.setdefault(box_of(module), set()).update(box_of(other) for other in used)
    return {box: others - {box} for box, others in boxes.items()}


def reached(box: str, direct: dict[str, set[str]], past: frozenset[str]) -> set[str]:
    """Return all that a box imports, itself or through others; not by way of `past`."""
    return {end for other in direct[box] - past
            for end in {other} | reached(other, direct, past | {other})}


def import_diagram() -> str:
    """Return the imports as a Mermaid diagram, without those that others make needless to draw."""
    direct = direct_imports()
    boxes = sorted(direct)
    lines = [f'    {key_of(box)}["{title_of(box, boxes)}"]' for box in boxes]
    for box in boxes:
        indirect = {end for other in direct[box] for end in reached(other, direct,
                                                                    frozenset({box, other}))}
        lines += [f'    {key_of(box)} --> {key_of(other)}'
                  for other in sorted(direct[box] - indirect)]
    return '\n'.join(['```mermaid', 'flowchart TD', *lines, '```'])


def key_of(box: str) -> str:
    """Return the name of a box within the diagram."""
    return re.sub(r'\W', '_', box)


def title_of(box: str, boxes: list[str]) -> str:
    """Return what stands in a box."""
    name = box.removesuffix(' above').replace('.', '/')
    if box.endswith(' above'):
        return f'{name}: nodes, commands'
    return f'{name}: basics' if f'{box} above' in boxes else name


def with_parts(page: Path) -> str:
    """Return a page with its generated parts as the code has them now."""
    text = page.read_text()
    for name in PARTS[page]:
        mark = f'<!-- {name}: written by python doc/generate.py -->\n'
        before, rest = text.split(mark)
        part = writers()[name]()
        text = f'{before}{mark}\n{part}\n\n<!-- end -->{rest.split("<!-- end -->", 1)[1]}'
    return text


def writers() -> dict[str, Callable[[], str]]:
    """Return what writes each generated part of a page."""
    from doc.effect_tables import effects_table, sizes_table
    return {'rooms': rooms_table, 'effects': effects_table, 'sizes': sizes_table,
            'topics': topics_table, 'imports': import_diagram}


def commands_page() -> str:
    """Return the help of every command, as Markdown."""
    written = subprocess.run(
        [sys.executable, '-m', 'typer', 'asi_analysis.cli', 'utils', 'docs', '--name', 'asi',
         '--title', 'Commands'], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return written.replace('```console', '```sh')


def blocks_page() -> str:
    """Return the files of the model, each with its docstring and functions, for autodoc."""
    modules = []
    for folder, whole in (('model', 'actuator'), ('joint', 'joint')):
        blocks = sorted(path.stem for path in (ROOT / 'asi_actuator' / folder).glob('*.py')
                        if path.stem not in ('__init__', whole))
        modules += [(folder, block) for block in [whole, *blocks]]
    return '\n'.join(
        f'## {block.replace("_", " ").capitalize()}\n\n```{{eval-rst}}\n'
        f'.. automodule:: asi_actuator.{folder}.{block}\n   :members:\n```\n'
        for folder, block in modules)


def api_page() -> str:
    """Return the public names of asi_analysis, for autodoc: recordings and results, functions."""
    import asi_analysis
    classes = [name for name in asi_analysis.__all__ if name[0].isupper()]
    functions = [name for name in asi_analysis.__all__ if name not in classes]
    return '\n'.join(['```{eval-rst}',
                      *(f'.. autofunction:: asi_analysis.{name}' for name in functions),
                      *(f'.. autoclass:: asi_analysis.{name}\n   :members:' for name in classes),
                      '```\n'])


def write_reference() -> None:
    """Write the pages that are made anew for each build of the documents."""
    folder = ROOT / 'doc/reference/generated'
    folder.mkdir(exist_ok=True)
    (folder / 'api_functions.md').write_text(api_page())
    (folder / 'commands.md').write_text(commands_page())
    (folder / 'model_blocks.md').write_text(blocks_page())


def write_files() -> None:
    """Write the files and parts of documents that are kept in the repository."""
    from doc.parameter_tables import files
    for path, text in files().items():
        (ROOT / path).write_text(text, encoding='utf-8')
    for page in PARTS:
        page.write_text(with_parts(page))


if __name__ == '__main__':
    write_files()
