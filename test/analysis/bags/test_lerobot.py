"""LeRobot datasets, v2.1 and v3.0: an episode is imported; damaged ones are refused."""

import base64
import json
import os
import shlex
import shutil
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from lerobot_dataset import write_dataset
from pyarrow.parquet import read_table, write_table
from typer.testing import CliRunner

from asi_analysis import cli
from asi_analysis.bags.bag import read_bag
from asi_analysis.bags.exchange.importing import import_joints, import_recording
from asi_analysis.bags.exchange.preview import preview
from asi_analysis.cli import app
from asi_analysis.errors import InputError

MAP = ['time=timestamp', 'reference=action.elbow_flex.pos[deg]',
       'position=observation.state.elbow_flex.pos[deg]']
FILES = {'v2.1': 'data/chunk-000/episode_000001.parquet',
         'v3.0': 'data/chunk-000/file-000.parquet'}


@pytest.fixture(scope='module', params=['v2.1', 'v3.0'])
def version(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope='module')
def dataset(version: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_dataset(tmp_path_factory.mktemp('data') / 'arm', version)


@pytest.mark.parametrize('episode, rows', [(0, 120), (1, 90), (2, 150)])
def test_an_episode_is_imported(dataset: Path, episode: int, rows: int) -> None:
    run = import_recording(dataset, MAP, episode=episode)
    time = np.arange(rows) / 30.0
    assert run.time_s == pytest.approx(time, abs=1e-5)
    assert run.position_m == pytest.approx(np.radians(episode + 1.0 + np.sin(time)), abs=1e-6)
    assert np.degrees(run.reference_n - run.position_m) == pytest.approx(0.1, abs=1e-4)


def test_every_joint_becomes_a_bag(dataset: Path, tmp_path: Path) -> None:
    runs = import_joints(dataset, [text.replace('elbow_flex', '{joint}') for text in MAP],
                         episode=1, out=tmp_path / 'bags')
    assert list(runs) == ['shoulder_pan', 'elbow_flex']
    assert len(read_bag(tmp_path / 'bags/elbow_flex')) == 90


def test_a_preview_says_what_is_there_and_has_the_command(
        dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    found = preview(dataset)
    assert set(found.mapping) == {'reference=action.shoulder_pan.pos[rad]', 'time=timestamp[s]',
                                  'position=observation.state.shoulder_pan.pos[rad]'}
    assert 'this is episode 0 of 3, 0 to 2' in found.notes
    assert any('observation.images.front (video)' in note for note in found.notes)
    words = shlex.split(preview(dataset, episode=2).command)
    assert '--episode' in words and CliRunner().invoke(app, words[1:]).exit_code == 0
    assert len(read_bag('arm_bag')) == 150


@pytest.mark.parametrize('names, columns', [
    ({'motors': ['a', 'b']}, ['observation.state.a', 'observation.state.b']),
    (None, ['observation.state#1', 'observation.state#2']),
    (['state'], ['observation.state#1', 'observation.state#2']),
    (['grip', 'grip'], ['observation.state#1', 'observation.state#2'])])
def test_names_are_those_of_the_features(names: object, columns: list[str], tmp_path: Path
                                         ) -> None:
    dataset = write_dataset(tmp_path / 'arm', rows=(30,), names=names)
    found = preview(dataset)
    assert [each['name'] for each in found.columns if 'state' in each['name']] == columns
    assert f'position={columns[0]}[rad]' in found.mapping
    assert len(import_recording(dataset, ['time=timestamp', f'position={columns[1]}[deg]'])) == 30


@pytest.mark.parametrize('options, words', [
    (['--episode', '3'], 'there is no episode 3: it has 3, 0 to 2'),
    ([], 'which episode? it has 3, 0 to 2: give --episode N'),
    (['--episode', '0', '--map', 'force=observation.state.wrist[Nm]'], 'names no column'),
    (['--episode', '0', '--map', 'force=observation.images.front#1[N]'], 'is a video: only num')])
def test_what_is_not_there_is_said(options: list[str], words: str, dataset: Path, tmp_path: Path,
                                   monkeypatch: pytest.MonkeyPatch,
                                   capsys: pytest.CaptureFixture[str]) -> None:
    maps = [part for text in MAP for part in ('--map', text)]
    monkeypatch.setattr('sys.argv', ['asi', 'import', str(dataset), *maps, *options, '--out',
                                     str(tmp_path / 'bag')])
    assert cli.main() == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert words in said[-1] and not (tmp_path / 'bag').exists()


def _damaged(folder: Path, version: str, kind: str) -> None:
    """Spoil a dataset."""
    info, file = folder / 'meta/info.json', folder / FILES[version]
    told, data = json.loads(info.read_text()), file.read_bytes()
    if kind == 'no meta':
        shutil.rmtree(folder / 'meta')
    elif kind == 'no file':
        shutil.rmtree(folder / 'data/chunk-000')
    elif kind == 'truncated':
        file.write_bytes(data[:len(data) // 2])
    elif kind == 'empty':
        file.write_bytes(b'')
    elif kind == 'info cut':
        info.write_text(info.read_text()[:200])
    elif kind in ('version', 'outside', 'path', 'wide'):
        told |= {'version': {'codebase_version': 'v1.6'},
                 'outside': {'data_path': '../../{episode_index}.parquet'},
                 'path': {'data_path': 'data/{episode_index.nothing}.parquet'},
                 'wide': {'data_path': 'data/{episode_index:1000000000}.parquet'}}[kind]
        info.write_text(json.dumps(told))
    elif kind in ('width', 'huge'):
        told['features']['action'] |= {'shape': [3 if kind == 'width' else 10 ** 12],
                                       'names': ['a', 'b', 'c']}
        info.write_text(json.dumps(told))
    else:
        table = read_table(file)
        column = {'text': pa.array(['x'] * len(table)), 'no column': None,
                  'nulls': pa.nulls(len(table), table['action'].type),
                  'no index': None}[kind]
        name = 'episode_index' if kind == 'no index' else 'action'
        where = table.schema.get_field_index(name)
        table = table.remove_column(where)
        write_table(table if column is None else table.add_column(where, name, column), file)


@pytest.mark.parametrize('kind, words', [
    ('no meta', 'info.json cannot be read'), ('no file', 'no '), ('truncated', 'cannot be read'),
    ('empty', 'cannot be read'), ('info cut', 'is not JSON'), ('version', 'v2 and v3 can be read'),
    ('outside', 'no file of the dataset'), ('path', 'not understood'),
    ('width', 'but 3 in meta/info.json'),
    ('wide', 'not understood'), ('huge', 'action'),
    ('text', 'is string, but'), ('no column', 'no column action'),
    ('no index', 'no column episode_index')])
def test_a_damaged_dataset_is_refused_in_one_line(kind: str, words: str, version: str,
                                                  dataset: Path, tmp_path: Path) -> None:
    if kind in ('outside', 'path', 'wide') and version == 'v3.0':
        return    # its files are found without a path
    folder = tmp_path / 'arm'
    shutil.copytree(dataset, folder)
    _damaged(folder, version, kind)
    with pytest.raises(InputError, match=words) as error:
        import_recording(folder, ['time=timestamp', 'reference=action#1[rad]',
                                  'position=observation.state.elbow_flex.pos[rad]'], episode=1)
    assert '\n' not in str(error.value)


def test_rows_without_numbers_are_missing_samples(version: str, dataset: Path, tmp_path: Path
                                                  ) -> None:
    folder = tmp_path / 'arm'
    shutil.copytree(dataset, folder)
    _damaged(folder, version, 'nulls')
    if int(pa.__version__.partition('.')[0]) < 26:  # it does not read lists that are missing
        with pytest.raises(InputError, match='cannot be read'):
            import_recording(folder, MAP, episode=1)
        return
    run = import_recording(folder, MAP, episode=1)
    assert np.isnan(run.reference_n).all() and np.isfinite(run.position_m).all()


def test_a_long_episode_among_others_is_read(tmp_path: Path) -> None:
    folder = write_dataset(tmp_path / 'long', rows=(10, 200_000, 10), fps=1000)
    run = import_recording(folder, ['position=observation.state.elbow_flex.pos[rad]'], 1000.0,
                           episode=1)
    assert len(run) == 200_000


def test_an_episode_of_anything_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / 'log.csv').write_text('t,q\n0,1\n1,2\n')
    with pytest.raises(InputError, match='--episode 0: .* is no LeRobot dataset'):
        import_recording(tmp_path / 'log.csv', ['time=t', 'position=q[rad]'], episode=0)
    with pytest.raises(InputError, match='--episode 0: .* is no LeRobot dataset'):
        preview(tmp_path / 'log.csv', episode=0)


# Two rows of `action` and `episode_index` with a bit of the statistics of their sizes flipped:
# pyarrow 26 ends the process where they are looked at. Compressed by zlib, in base 85.
BAD_SIZES = (
    b'c-'
    b'm!=!D_=W42EUbc)1KhKqiJza+z5nE$e8;4ux%(oq8xc4@O7~3$&@1WLuAWm_5=Ss7lgaR)HmK>;ELn>!+7F3iQ!m'
    b'QGfu*ejdm@BH$RuNq;F(Ms&t$iNTN9h@W))s2hxQ0S4zf#sr|yuPKDG$=~fZLjemO$}DfoT}2eRT2f*vLa`~E7CE'
    b'4I#ls7`v0GcUB&OY^b!D?F>|0qCb`MJENGAp&^mGc+*Y`(Uk2pz@@|07~EQ~klI)e@l)F6lD#0b#O{mTG4k{C$;O'
    b'7)CF73P<j{W(Nx(*x8WQ^I%@;5v3${qbqrY3|%KtLxo&{AKHgx{Gh`W;e6BPG~yafI<eark^+f7X?1t')


def test_statistics_at_which_pyarrow_ends_the_process_are_not_looked_at(tmp_path: Path) -> None:
    folder = write_dataset(tmp_path / 'arm', rows=(2,), width=1, names=['a'])
    info = json.loads((folder / 'meta/info.json').read_text())
    info['features'] = {'action': info['features']['action']}
    (folder / 'meta/info.json').write_text(json.dumps(info))
    (folder / 'data/chunk-000/file-000.parquet').write_bytes(zlib.decompress(
        base64.b85decode(BAD_SIZES)))
    call = [sys.executable, '-m', 'asi_analysis.cli', 'import', str(folder), '--rate', '30']
    done = subprocess.run([*call, '--map', 'force=action[N]', '--out', str(tmp_path / 'bag')],
                          capture_output=True, text=True, check=False)
    assert done.returncode in (0, 2) and 'terminate' not in done.stderr, done.stderr


@pytest.mark.parametrize('kind', ['pipe', 'directory'])
def test_a_pipe_among_the_data_is_refused(kind: str, tmp_path: Path) -> None:
    folder = write_dataset(tmp_path / 'arm')
    file = folder / 'data/chunk-000/file-000.parquet'
    file.unlink()
    os.mkfifo(file) if kind == 'pipe' else file.mkdir()
    with pytest.raises(InputError, match='file-000.parquet is not a file'):
        preview(folder)


def test_a_pipe_as_information_is_refused(tmp_path: Path) -> None:
    folder = write_dataset(tmp_path / 'arm')
    (folder / 'meta/info.json').unlink()
    os.mkfifo(folder / 'meta/info.json')
    with pytest.raises(InputError, match='info.json cannot be read: is not a file'):
        preview(folder)


@pytest.mark.parametrize('order', [slice(None, None, -1), slice(None, None, 2)])
def test_rows_that_are_missing_or_out_of_order_are_told_without_a_time(
        order: slice, tmp_path: Path) -> None:
    folder = write_dataset(tmp_path / 'arm', 'v2.1')
    file = folder / 'data/chunk-000/episode_000000.parquet'
    write_table(read_table(file).take(np.arange(120)[order]), file)
    with pytest.warns(UserWarning, match='frame_index of episode 0 does not count from 0'):
        import_recording(folder, ['position=action.elbow_flex.pos[deg]'], 30.0, episode=0)


def test_two_features_of_one_name_are_refused(tmp_path: Path) -> None:
    folder = write_dataset(tmp_path / 'arm', 'v2.1', names=['a', 'b'])
    info = json.loads((folder / 'meta/info.json').read_text())
    info['features']['action.a'] = info['features'].pop('next.done')
    (folder / 'meta/info.json').write_text(json.dumps(info))
    file = folder / 'data/chunk-000/episode_000000.parquet'
    table = read_table(file)
    write_table(table.rename_columns([name.replace('next.done', 'action.a')
                                      for name in table.column_names]), file)
    with pytest.raises(InputError, match='two columns are called action.a'):
        import_recording(folder, ['time=timestamp', 'position=action.b[deg]'], episode=0)
