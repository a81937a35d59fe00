"""The documents name what is there: files, pictures, pages, and every source file has its row."""

import re
from pathlib import Path

import documented
import pytest
from conftest import ROOT

PAGES = [ROOT / 'README.md', *sorted((ROOT / 'doc').glob('*.md'))]


@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.name)
def test_links_and_pictures_lead_to_files(page: Path) -> None:
    links = re.findall(r'\]\(([^)#:\s]+)\)', page.read_text())
    assert [link for link in links if not (page.parent / link).exists()] == []


def test_architecture_names_every_module_and_nothing_else() -> None:
    table = (ROOT / 'doc' / 'architecture.md').read_text().split('## Run')[0]
    for row in table.splitlines():
        folder = ROOT
        for text in re.findall(r'`([\w/*.]+)`', row.split('|')[1]) if row.startswith('|') else ():
            found = list((folder / text).parent.glob(Path(text).name))
            assert found, f'doc/architecture.md names {text}, which does not exist'
            folder = found[0].parent
    named = {part for text in re.findall(r'`([\w/*.]+)', table) for part in Path(text).parts}
    sources = [path for package in ('asi_actuator', 'asi_controller', 'asi_analysis', 'bench')
               for path in (ROOT / package).iterdir()
               if path.suffix == '.py' or (path / '__init__.py').exists()]
    assert [str(path.relative_to(ROOT)) for path in sources if path.name != '__init__.py'
            and not any(path.match(name) for name in named)] == []


def test_every_command_has_its_documented_json() -> None:
    from typer.main import get_command

    from asi_analysis.cli import app

    known = get_command(app).commands  # type: ignore[attr-defined]
    assert {name.split()[1] for name in documented.commands()} == set(known)
