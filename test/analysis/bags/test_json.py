"""JSON as columns: records, objects of arrays, lines; what is no table is refused in one line."""

import gzip
import json
import os
import shlex
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from asi_analysis.bags.bag import read_bag
from asi_analysis.bags.exchange import json_file
from asi_analysis.bags.exchange.importing import import_recording
from asi_analysis.bags.exchange.preview import preview
from asi_analysis.cli import app
from asi_analysis.errors import InputError

T = 0.01 * np.arange(200)
RECORDS = [{'t': t, 'joint': {'position': 90.0 * t, 'tau': [t, 2.0 * t]}} for t in T.tolist()]
MAP = ['time=t', 'position=joint.position[deg]', 'command=joint.tau#2[Nm]']


def written(path: Path, document: object) -> Path:
    path.write_text(document if isinstance(document, str) else json.dumps(document))
    return path


def documents() -> dict[str, object]:
    """Return the same recording in each form."""
    columns = {'t': T.tolist(), 'joint': {'position': (90.0 * T).tolist(),
                                          'tau': np.column_stack([T, 2.0 * T]).tolist()}}
    by_row = {'t': {str(k): t for k, t in enumerate(T.tolist())}, 'joint': columns['joint']}
    lines = ''.join(json.dumps(each) + '\n' for each in RECORDS)
    return {'records.json': RECORDS, 'columns.json': columns, 'pandas.json': by_row,
            'lines.jsonl': lines, 'lines.ndjson': lines, 'named_wrongly.json': lines}


@pytest.mark.parametrize('name', documents())
def test_each_form_is_read_alike(name: str, tmp_path: Path) -> None:
    run = import_recording(written(tmp_path / name, documents()[name]), MAP)
    assert run.time_s == pytest.approx(T)
    assert run.position_m == pytest.approx(0.5 * np.pi * T)
    assert run.command_n == pytest.approx(2.0 * T)


def test_records_within_an_object_and_packed_files(tmp_path: Path) -> None:
    path = tmp_path / 'log.json.gz'
    path.write_bytes(gzip.compress(json.dumps({'robot': 'arm', 'rate': 100, 'log': RECORDS}
                                              ).encode()))
    assert import_recording(path, ['time=log.t', 'position=log.joint.position[deg]']
                            ).position_m == pytest.approx(0.5 * np.pi * T)


def test_what_lacks_in_a_record_is_missing(tmp_path: Path) -> None:
    rows = [dict(each) for each in RECORDS]
    del rows[3]['joint']
    rows[4]['joint'] = {'position': None, 'tau': [None, 1.0]}
    run = import_recording(written(tmp_path / 'log.json', rows), MAP)
    assert np.flatnonzero(np.isnan(run.position_m)).tolist() == [3, 4]


def test_a_preview_has_the_command_to_copy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch
                                           ) -> None:
    monkeypatch.chdir(tmp_path)
    written(tmp_path / 'log.json', RECORDS)
    found = preview('log.json')
    assert {'time=t[s]', 'position=joint.position[rad]'} <= set(found.mapping)
    words = shlex.split(found.command)
    assert CliRunner().invoke(app, words[1:]).exit_code == 0
    assert len(read_bag('log_bag')) == len(T)


@pytest.mark.parametrize('text, words', [
    ('', 'is empty'), ('[', 'Expecting value'), ('3', 'holds no table'), ('[]', 'no field'),
    ('{}', 'no field'), ('["a", "b"]', 'is no record'), ('[{"a": 1}, {"a": 2', 'delimiter'),
    ('{"t": 0}\n{"t": }\n', 'line 2: Expecting value'), (100000 * '[', 'recursion'),
    ('[{"a": {"b": 1}, "a.b": 2}, 3]', 'two fields are called a.b'),
    ('{"t": [0, 1], "q": [1, 1e999]}', 'infinite'),
    ('{"t": [0, 1], "q": ["x", 1]}', 'no.* number'),
    ('{"t": [0, 1, 2], "q": [1, 2]}', 'differ in length'),
    ('{"t": [0, 1], "q": [1, ' + 400 * '9' + ']}', 'too large')])
def test_what_is_no_table_is_refused_in_one_line(text: str, words: str, tmp_path: Path) -> None:
    path = written(tmp_path / 'log.json', text)
    with pytest.raises(InputError, match=words) as error:
        import_recording(path, ['time=t', 'position=q[rad]'])
    assert '\n' not in str(error.value)


def test_a_document_is_read_up_to_a_limit_and_lines_beyond(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(json_file, 'MOST_BYTES', 1000)
    with pytest.raises(InputError, match='save it as JSON lines'):
        import_recording(written(tmp_path / 'log.json', RECORDS), MAP)
    lines = written(tmp_path / 'log.jsonl', documents()['lines.jsonl'])
    assert len(import_recording(lines, MAP)) == len(T)


@pytest.mark.parametrize('text', [
    '{"t": [0, 1, 2], "f": [1, 2, 3], "f": [4, 5, 6]}', '{"t": 0, "f": 1, "f": 2}\n{"t": 1}\n',
    '{"t": [0, 1], "a.b": [1, 2], "a": {"b": [3, 4]}}', '[{"t": 0, "a.b": 1, "a": {"b": 3}}]'])
def test_two_fields_of_one_name_are_refused(text: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match='two fields are called (f|a.b)'):
        import_recording(written(tmp_path / 'log.json', text), ['time=t', 'force=t'])


def test_a_file_of_lines_that_is_refused_is_closed(tmp_path: Path) -> None:
    path = written(tmp_path / 'log.jsonl', '{"t": 0}\n"no record"\n')
    with pytest.raises(InputError, match='record 2') as refusal:
        import_recording(path, ['time=t', 'force=t'])
    assert refusal.value.__traceback__ is not None     # which holds all that was read with
    opened = {os.path.realpath(each) for each in Path('/proc/self/fd').iterdir()}
    assert str(path.resolve()) not in opened


@pytest.mark.parametrize('name', ['log.json', 'log.jsonl'])
def test_a_long_list_in_a_record_is_left_out_with_a_note(name: str, tmp_path: Path) -> None:
    rows = [each | {'picture': {'row': list(range(65))}} for each in RECORDS]
    path = written(tmp_path / name, rows if name == 'log.json' else
                   ''.join(json.dumps(each) + '\n' for each in rows))
    with pytest.warns(UserWarning, match='picture.row is left out: a list of 65 in a record'):
        assert import_recording(path, MAP).time_s == pytest.approx(T)
