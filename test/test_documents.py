"""What the documents name exists, and their generated parts are current."""

import re
from pathlib import Path

import documented
import pytest
import yaml
from conftest import ROOT

from asi_actuator.node_parameters import ACTUATOR_NODE_PARAMETERS
from asi_actuator.parameters import ACTUATOR_PARAMETERS
from asi_analysis.paper.facts import published
from asi_controller.parameters import (
    COMPENSATOR_PARAMETERS,
    CONTROLLER_NODE_PARAMETERS,
    REFERENCE_PARAMETERS,
)
from doc import generate

# Not those that `make docs` writes, perhaps at this moment.
PAGES = [ROOT / 'README.md', ROOT / 'CONTRIBUTING.md', *sorted(
    page for page in (ROOT / 'doc').rglob('*.md') if page.parent.name != 'generated')]


@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.name)
def test_links_and_pictures_lead_to_files(page: Path) -> None:
    links = re.findall(r'\]\(([^)#:\s]+)\)', page.read_text())
    assert [link for link in links if not (page.parent / link).exists()] == []


@pytest.mark.parametrize('page', generate.PARTS, ids=lambda page: page.name)
def test_rooms_and_imports_are_as_documented(page: Path) -> None:
    assert generate.with_parts(page) == page.read_text(), 'run python doc/generate.py'


@pytest.mark.parametrize('room', generate.rooms())
def test_every_room_says_in_its_first_line_what_it_is_for(room: str) -> None:
    assert len(generate.first_line(room)) > 20


def test_no_package_is_large_and_no_module_long_without_a_reason() -> None:
    modules = [path for package in generate.PACKAGES for path in (ROOT / package).rglob('*.py')]
    for path in modules:
        name = str(path.relative_to(ROOT))
        if len(path.read_text().splitlines()) > 500:
            assert 'long, as' in generate.first_line(name.removesuffix('.py').replace('/', '.'))
    for folder in {path.parent for path in modules} - {Path(published.__file__).parent}:
        assert len(list(folder.glob('*.py'))) <= 16, folder      # with __init__.py


def test_every_command_has_its_documented_json() -> None:
    from typer.main import get_command

    from asi_analysis.cli import app

    known = get_command(app).commands  # type: ignore[attr-defined]
    assert {name.split()[1] for name in documented.commands()} == set(known)


NODES = {'asi_actuator': ACTUATOR_NODE_PARAMETERS + ACTUATOR_PARAMETERS,
         'asi_controller': (CONTROLLER_NODE_PARAMETERS + COMPENSATOR_PARAMETERS
                            + REFERENCE_PARAMETERS)}
ELSEWHERE = {'output'}   # of the recorder


@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.name)
def test_parameters_that_are_shown_are_allowed(page: Path) -> None:
    text = page.read_text()
    shown = [('', name, value) for name, value in re.findall(r'-p ([\w.]+):=([^\s`]+)', text)
             if name not in ELSEWHERE]
    shown += re.findall(r'ros2 param set /(\w+) ([\w.]+) ([^\s`]+)', text)
    for node, name, value in shown:
        table = {p.name: p for key, each in NODES.items() if node in ('', key) for p in each}
        assert name in table, name
        assert table[name].problem(yaml.safe_load(value)) is None, (name, value)


@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.name)
def test_options_that_are_shown_exist(page: Path) -> None:
    from typer.main import get_command

    from asi_analysis.cli import app

    commands = dict(get_command(app).commands)  # type: ignore[attr-defined]
    commands |= {f'gap {name}': each for name, each in commands['gap'].commands.items()}
    # A call, up to the end of its line or of the code that it stands in; lines may be continued.
    for call in re.findall(r'\basi ((?:[^\n`|#]|\\\n)+)', page.read_text()):
        words = call.replace('\\\n', ' ').split()
        name = next((n for n in (' '.join(words[:2]), words[0]) if n in commands), None)
        if name:
            known = {option for each in (commands[name], *(
                commands['gap'].commands.values() if name == 'gap' else ()))
                     for parameter in each.params for option in parameter.opts} | {'--help'}
            unknown = {word for word in words if re.fullmatch(r'--[a-z][\w-]*', word)} - known
            assert not unknown, f'asi {name} has no {", ".join(unknown)}'
