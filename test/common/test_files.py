"""Files are written completely or not at all: no code writes one at its final name."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import ROOT

from asi_common.files import replacing, write_text

PACKAGES = ('asi_common', 'asi_actuator', 'asi_controller', 'asi_analysis', 'asi_examiner')
WRITERS = ('write_text', 'write_bytes', 'savefig')
WRITING = {'w', 'wb', 'x', 'xb', 'a', 'ab'}
# What is written otherwise, and why.
OTHERWISE = {
    'asi_analysis/bags/bag_writer.py': 'a bag is to be readable while it grows',
    'asi_analysis/bags/exchange/exporting.py': 'it is given the temporary file',
    'asi_analysis/experiments/running.py': 'the log of a node, written by the node',
    'asi_analysis/gap/check/check.py': 'lines are appended, so that a check can be continued',
    'asi_analysis/reporting/figures.py': 'a picture in a page, in memory',
}


def written_in_place(path: Path) -> Iterator[str]:
    """Yield the calls of a module that write a file that is not a temporary one."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Call) and 'temporary' not in (call := ast.unparse(node)):
            name = ast.unparse(node.func).rpartition('.')[2]
            modes = [each.value for each in node.args if isinstance(each, ast.Constant)]
            if (name in WRITERS and isinstance(node.func, ast.Attribute)) or (
                    name == 'open' and WRITING & set(modes)):
                yield f'{node.lineno}: {call[:80]}'


def test_every_file_is_written_under_a_temporary_name() -> None:
    found = {str(path.relative_to(ROOT)): calls for package in PACKAGES
             for path in (ROOT / package).rglob('*.py') if (calls := list(written_in_place(path)))}
    assert found.keys() == OTHERWISE.keys(), found


def test_a_file_is_complete_or_as_before(tmp_path: Path) -> None:
    file = tmp_path / 'file.txt'
    write_text(file, 'before')
    with pytest.raises(ValueError, match='while it is written'), replacing(file) as temporary:
        temporary.write_text('half')
        raise ValueError('while it is written')
    assert file.read_text() == 'before' and list(tmp_path.iterdir()) == [file]
    with replacing(file) as temporary:
        temporary.write_text('after')
        assert file.read_text() == 'before'
    assert file.read_text() == 'after' and list(tmp_path.iterdir()) == [file]
