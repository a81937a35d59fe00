"""Bad input ends in one line and status 2, whatever it is; nothing half written stays behind."""

import contextlib
import gzip
import os
import pickle
import shutil
import signal
import sqlite3
import subprocess
import sys
import tracemalloc
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pyarrow
import pytest
import yaml
import zstandard
from conftest import PATIENCE_S, wait_until
from mcap.records import Chunk
from mcap.writer import Writer
from pyarrow import parquet
from rosbags.rosbag2 import CompressionMode
from scipy.io import savemat

from asi_analysis import cli
from asi_analysis.bags import bag_file
from asi_analysis.bags.bag import read_bag, write_bag
from asi_analysis.bags.bag_file import read_contents
from asi_analysis.bags.exchange import text_file
from asi_analysis.bags.exchange.exporting import export
from asi_analysis.bags.exchange.importing import import_recording
from asi_analysis.bags.exchange.preview import preview
from asi_analysis.bags.qos import as_profile
from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError, InputWarning
from asi_common.files import write_text
from asi_common.node.topics import STREAM_QOS
from torture.inputs import as_sqlite

ASI = (sys.executable, '-m', 'asi_analysis.cli')
# Runs commands, with `and` between them, one after another, up to the first that fails.
COMMANDS = """
import itertools, sys
from asi_analysis import cli
for joined, words in itertools.groupby(sys.argv[1:], 'and'.__eq__):
    sys.argv = ['asi', *words]
    if not joined and (status := cli.main()):
        sys.exit(status)
"""


def asi(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *words: object
        ) -> tuple[int, str]:
    """Return exit status and stderr of a command."""
    monkeypatch.setattr(sys, 'argv', ['asi', *map(str, words)])
    status = cli.main()
    return status, capsys.readouterr().err


def a_run(count: int = 300) -> Run:
    time_s = np.arange(count) / 1000.0
    return Run(time_s, np.where(time_s < 0.1, 0.0, 100.0), None, np.sin(time_s * 60.0))


@pytest.mark.parametrize('words', [
    ['predict', '--steps', 'nan'], ['quench', '--seed', '-1'],
    ['gap', '{bag}', '--tolerance', '1e-320'], ['reproduce', '--actuator', '{wrong}'],
    ['ensemble', '--out', '/dev/null'], ['predict', '--report', '/dev/null'],
    ['import', '{csv}', '--map', 'force=force--1', '--rate', '100', '--out', '{new}'],
    ['import', '{csv}', '--map', 'force=force*nan', '--rate', '100', '--out', '{new}'],
    ['import', '{csv}', '--map', 'force=force', '--rate', '1e12', '--out', '{new}'],
    ['import', '{csv}', '--map', 'force=force', '--rate', '1e-308', '--out', '{new}'],
    ['run', '--rate', '1e12'], ['run', '--duration', '1e-308'], ['attribute', '{bag}']])
def test_a_call_that_is_wrong_is_refused_in_one_line(
        words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str]) -> None:
    write_bag(a_run(), tmp_path / 'bag')
    (tmp_path / 'a.csv').write_text('force\n1\n2\n3\n')
    (tmp_path / 'wrong.yaml').write_text('asi_actuator:\n  ros__parameters:\n    load:\n'
                                         '      mass: -1.0\n')
    places = {'bag': tmp_path / 'bag', 'csv': tmp_path / 'a.csv', 'wrong': tmp_path / 'wrong.yaml',
              'new': tmp_path / 'new'}
    status, said = asi(monkeypatch, capsys, *[word.format(**places) for word in words])
    assert status == 2
    assert said.startswith('asi: ')
    assert said.count('\n') == 1
    assert not (tmp_path / 'new').exists()


@pytest.mark.parametrize('words', [
    ['BAG', '--gain', '3'], ['BAG', '--set', 'controller.gain=nan'], ['BAG', '--rate', '1000'],
    ['--signal', 'force']])
def test_an_option_without_effect_is_refused(
        words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
        ) -> None:
    status, said = asi(monkeypatch, capsys, 'attribute', *words)
    assert status == 2
    assert f'{words[-2]} has no effect' in said


@pytest.mark.parametrize('kind', ['npz', 'mat'])
def test_every_cut_of_an_archive_is_read_or_refused(kind: str, tmp_path: Path) -> None:
    whole, cut = tmp_path / f'whole.{kind}', tmp_path / f'cut.{kind}'
    if kind == 'npz':
        np.savez_compressed(whole, force=np.arange(1000.0))
    else:
        savemat(whole, {'force': np.arange(1000.0)}, do_compression=True)
    data = whole.read_bytes()
    for share in (0.1, 0.5, 0.9, 0.99) if kind == 'npz' else (0.5, 0.95):
        cut.write_bytes(data[:int(share * len(data))])
        with pytest.raises(InputError, match='cannot be read') as refusal:
            import_recording(cut, ['force=force'], 10.0)
        assert '\n' not in str(refusal.value)


@pytest.mark.parametrize(('text', 'message'), [
    ('force\n"' + 'x' * 200_000 + '"\n', 'field larger than'),
    ('1,' * 2**20, 'a line of more than'),
    ('t,f\n' + ','.join(map(str, range(5000))), 'columns: at most'),
    ('t,f,x\n' + '0,5,1,2\n1,5,2,3\n', 'if these are decimal commas'),
    ('t;f\nhigh;low\nhigh;low\n', "has no rows of numbers: they end with 'high;low'")])
def test_texts_that_are_no_tables_are_refused(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / 'a.csv').write_text(text)
    with pytest.raises(InputError, match=message):
        import_recording(tmp_path / 'a.csv', ['force=f'], 10.0)


def test_a_compressed_text_is_not_unpacked_beyond_the_limit(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(text_file, 'MOST_UNPACKED', 1_000_000)
    (tmp_path / 'a.csv.gz').write_bytes(gzip.compress(b'force\n' + b'1.00000\n' * 200_000))
    monkeypatch.setattr(text_file, 'lines_of', None)    # nor are its cells read, in minutes
    with pytest.raises(InputError, match='unpacks to more than 1 MB'):
        import_recording(tmp_path / 'a.csv.gz', ['force=force'], 10.0)


@pytest.mark.parametrize('kind', ['npz', 'mat', 'parquet'])
def test_a_table_is_not_unpacked_beyond_the_limit(
        kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(text_file, 'MOST_UNPACKED', 1_000_000)
    bomb, zeros = tmp_path / f'a.{kind}', np.zeros(5_000_000)
    if kind == 'npz':
        np.savez_compressed(bomb, force=zeros)
    elif kind == 'mat':
        savemat(bomb, {'force': zeros}, do_compression=True)
    else:
        parquet.write_table(pyarrow.table({'force': zeros}), bomb)
    message = 'cannot be read' if kind == 'mat' else 'unpacks to 40 MB, more than 1 MB'
    with pytest.raises(InputError, match=message):
        import_recording(bomb, ['force=force'], 10.0)


@pytest.mark.parametrize('declared', [1000, 5_000_000_000])
def test_a_chunk_that_unpacks_to_gigabytes_is_left_out(declared: int, tmp_path: Path) -> None:
    bomb = zstandard.ZstdCompressor().compress(bytes(300_000_000))
    with (tmp_path / 'a.mcap').open('wb') as file:
        writer = Writer(file)
        writer.start('ros2')
        chunk = Chunk('zstd', bomb, 0, 0, 0, declared)
        chunk.write(writer._Writer__record_builder)  # type: ignore[attr-defined]
        file.write(writer._Writer__record_builder.end())  # type: ignore[attr-defined]
        writer.finish()
    contents = read_contents(tmp_path / 'a.mcap', lambda _: True)
    assert 'unpack' in contents.problems[0]
    for read in (read_bag, preview, lambda path: import_recording(
            path, ['force=/f/data'], out=tmp_path / 'bag')):
        tracemalloc.start()
        with pytest.raises(InputError, match='unpack'):
            read(tmp_path / 'a.mcap')
        assert tracemalloc.get_traced_memory()[1] < 1e8
        tracemalloc.stop()


@pytest.mark.parametrize('mode', [CompressionMode.FILE, CompressionMode.MESSAGE])
def test_a_compressed_bag_of_sqlite_is_not_unpacked_beyond_the_limit(
        mode: CompressionMode, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_bag(a_run(), tmp_path / 'bag')
    as_sqlite(tmp_path / 'bag', tmp_path / 'sqlite', mode)
    assert len(read_bag(tmp_path / 'sqlite')) == 300
    monkeypatch.setattr(bag_file, 'MOST_UNPACKED', 1000)
    monkeypatch.setattr(bag_file, 'MOST_RATIO', 0)
    assert 'unpacks to more than is allowed' in read_contents(
        tmp_path / 'sqlite', lambda _: True).problems[-1]


def test_all_files_of_a_bag_together_are_not_unpacked_beyond_the_limit(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_bag(a_run(), tmp_path / 'bag')
    as_sqlite(tmp_path / 'bag', tmp_path / 'sqlite', CompressionMode.FILE)
    file, = (tmp_path / 'sqlite').glob('*.zstd')
    size = len(zstandard.ZstdDecompressor().stream_reader(file.read_bytes()).read())
    monkeypatch.setattr(bag_file, 'MOST_UNPACKED', size + size // 2)
    monkeypatch.setattr(bag_file, 'MOST_RATIO', 0)
    assert len(read_bag(tmp_path / 'sqlite')) == 300
    shutil.copy(file, file.with_name('another.db3.zstd'))
    assert 'unpacks to more than is allowed' in read_contents(
        tmp_path / 'sqlite', lambda _: True).problems[-1]


def test_a_preview_of_a_damaged_compressed_bag_is_refused(tmp_path: Path) -> None:
    write_bag(a_run(), tmp_path / 'bag')
    as_sqlite(tmp_path / 'bag', tmp_path / 'sqlite', CompressionMode.FILE)
    file, = (tmp_path / 'sqlite').glob('*.zstd')
    good = file.read_bytes()
    for place in (20, len(good) // 3, len(good) // 2, len(good) - 60):
        file.write_bytes(good[:place] + bytes(50) + good[place + 50:])
        with pytest.raises(InputError, match='cannot be read|is damaged'):
            preview(tmp_path / 'sqlite')


@pytest.mark.parametrize('sql', [
    'CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, '
    'data BLOB AS (zeroblob(100000000))); INSERT INTO messages (topic_id, timestamp) SELECT '
    'topic_id, timestamp FROM old',
    'ALTER TABLE old RENAME TO messages; DROP TABLE message_definitions; '
    'CREATE VIEW message_definitions AS WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id + 1 '
    'FROM n) SELECT id, "" AS topic_type, "ros2msg" AS encoding, "" AS '
    'encoded_message_definition, "" AS type_description_hash FROM n'])
def test_a_database_that_computes_its_data_is_refused(sql: str, tmp_path: Path) -> None:
    """A file of 100 kB had 30 GB of messages, or definitions without end."""
    write_bag(a_run(), tmp_path / 'bag')
    as_sqlite(tmp_path / 'bag', tmp_path / 'sqlite')
    with contextlib.closing(sqlite3.connect(tmp_path / 'sqlite/sqlite.db3')) as database:
        database.executescript(f'ALTER TABLE messages RENAME TO old; {sql}')
    with pytest.raises(InputError, match='is computed by SQL, not stored'):
        read_bag(tmp_path / 'sqlite')


@pytest.mark.parametrize('name', ['100% #1?', 'a%20b'])
def test_a_folder_may_have_any_name(name: str, tmp_path: Path) -> None:
    write_bag(a_run(), tmp_path / 'bag')
    as_sqlite(tmp_path / 'bag', tmp_path / 'sqlite')
    for kind in ('bag', 'sqlite'):
        assert len(read_bag((tmp_path / kind).rename(tmp_path / name))) == len(a_run())
        shutil.rmtree(tmp_path / name)


def test_a_name_with_line_ends_is_told_in_one_line(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In warnings too, and without codes of the terminal."""
    odd = tmp_path / 'a\nb\x1b[1m.mcap'
    odd.write_bytes(b'no bag')
    status, said = asi(monkeypatch, capsys, 'import', odd, '--map', 'force=/a/b', '--out',
                       tmp_path / 'new')
    assert status == 2 and 'b\\x1b[1m.mcap is damaged' in said
    assert all(line.startswith('asi: ') for line in said.splitlines())


def test_metadata_that_is_a_pipe_does_not_hang(tmp_path: Path) -> None:
    write_bag(a_run(), tmp_path / 'bag')
    (tmp_path / 'bag/metadata.yaml').unlink()
    os.mkfifo(tmp_path / 'bag/metadata.yaml')
    with pytest.warns(InputWarning, match='metadata.yaml cannot be read'):
        assert len(read_bag(tmp_path / 'bag')) == 300
    with pytest.warns(InputWarning, match='metadata.yaml cannot be read'):
        assert preview(tmp_path / 'bag').samples == 300


@pytest.mark.parametrize('mode', [None, CompressionMode.NONE, CompressionMode.FILE])
def test_a_pipe_for_the_messages_does_not_hang(mode: CompressionMode | None, tmp_path: Path
                                               ) -> None:
    write_bag(a_run(), tmp_path / 'written')
    bag = tmp_path / 'written'
    if mode is not None:
        bag = tmp_path / 'sqlite'
        as_sqlite(tmp_path / 'written', bag, mode)
    file = next(path for path in bag.iterdir() if path.suffix != '.yaml')
    file.unlink()
    os.mkfifo(file)
    for read in (read_bag, preview):
        with pytest.raises(InputError), warnings.catch_warnings():
            warnings.simplefilter('ignore', InputWarning)
            read(bag)


NO_SMALL_FILES = ('/dev/zero', '{pipe}', '{large}', '{deep}', '{list}')
TAKE_A_FILE = (
    ['compare'], ['gap', 'of', '{bag}', '--model'], ['calibrate', '--out', '{new}', '--start'],
    ['reproduce', '--candidate'], ['gap', 'check'])


# Each file and each command once; the others are slow.
@pytest.mark.parametrize(('words', 'file'), [
    *zip(TAKE_A_FILE, NO_SMALL_FILES, strict=True), *(
        pytest.param(words, file, marks=pytest.mark.slow) for place, words in enumerate(
            TAKE_A_FILE) for file in (*NO_SMALL_FILES[:place], *NO_SMALL_FILES[place + 1:]))])
def test_settings_that_are_no_small_file_are_refused(
        words: list[str], file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str]) -> None:
    """They waited for ever, took all of the memory, or ended in a traceback."""
    write_bag(a_run(), tmp_path / 'bag')
    places = {name: tmp_path / f'{name}.yaml' for name in ('pipe', 'large', 'deep', 'list')}
    places |= {'bag': tmp_path / 'bag', 'new': tmp_path / 'new'}
    os.mkfifo(places['pipe'])
    places['large'].write_text('# ' + 10_000_000 * 'x')
    places['deep'].write_text(20_000 * '[')
    places['list'].write_text('[1]')
    named = file.format(**places)
    if words == ['gap', 'check']:
        (tmp_path / 'cases').mkdir()
        (tmp_path / 'cases/cases.json').symlink_to(named)
        named = str(tmp_path / 'cases')
    status, err = asi(monkeypatch, capsys, *(word.format(**places) for word in words), named)
    assert status == 2
    assert named in err and err.count('\n') == 1


def test_a_member_of_an_npz_that_is_no_array_is_left_out(tmp_path: Path) -> None:
    np.savez(tmp_path / 'a.npz', force=np.arange(10.0))
    with zipfile.ZipFile(tmp_path / 'a.npz', 'a') as archive:
        archive.writestr('notes.txt', 'day 2')
    assert len(import_recording(tmp_path / 'a.npz', ['force=force'], 10.0)) == 10


@pytest.mark.parametrize('kind', ['csv', 'json', 'npz'])
def test_a_file_of_no_bytes_is_refused(kind: str, tmp_path: Path) -> None:
    (file := tmp_path / f'a.{kind}').symlink_to('/proc/kmsg')   # which would wait for ever
    with pytest.raises(InputError, match='is empty'):
        import_recording(file, ['force=force'], 100.0)


def test_complex_numbers_are_refused(tmp_path: Path) -> None:
    file = tmp_path / 'a.mat'
    savemat(file, {'force': 1j * np.arange(20.0)})
    with pytest.raises(InputError, match='column force has complex numbers'):
        import_recording(file, ['force=force'], 100.0)


def test_a_damaged_member_of_an_npz_in_lzma_is_refused(tmp_path: Path) -> None:
    np.save(tmp_path / 'force.npy', np.arange(1000.0))
    with zipfile.ZipFile(tmp_path / 'a.npz', 'w', zipfile.ZIP_LZMA) as archive:
        archive.write(tmp_path / 'force.npy', 'force.npy')
    data = bytearray((tmp_path / 'a.npz').read_bytes())
    for place in range(80, len(data) - 120, 7):
        data[place] ^= 0xff
    (tmp_path / 'a.npz').write_bytes(data)
    with pytest.raises(InputError, match='cannot be read'):
        import_recording(tmp_path / 'a.npz', ['force=force'], 10.0)


@pytest.mark.parametrize('damage', [(b'(10,), }', b'(10,,   '), (b'(10,), }', b'(10, "\n  '),
                                    (b"'shape'", b"'sha\n '")])
def test_a_damaged_header_of_an_npz_is_refused(
        damage: tuple[bytes, bytes], tmp_path: Path) -> None:
    np.savez(tmp_path / 'a.npz', force=np.arange(10.0))
    with zipfile.ZipFile(tmp_path / 'a.npz') as archive:
        member = archive.read('force.npy')
    assert damage[0] in member
    with zipfile.ZipFile(tmp_path / 'a.npz', 'w') as archive:
        archive.writestr('force.npy', member.replace(*damage))
    with pytest.raises(InputError, match='a.npz cannot be read') as refusal:
        import_recording(tmp_path / 'a.npz', ['force=force'], 10.0)
    assert '\n' not in str(refusal.value)


def test_a_flipped_bit_of_an_exported_table_is_found(tmp_path: Path) -> None:
    export(a_run(), tmp_path / 'a.parquet')
    data = bytearray((tmp_path / 'a.parquet').read_bytes())
    data[len(data) // 4] ^= 1      # within the numbers
    (tmp_path / 'b.parquet').write_bytes(data)
    with pytest.raises(InputError, match='cannot be read'):
        import_recording(tmp_path / 'b.parquet', [])


@pytest.mark.parametrize('damaged', [
    {'signals': {'reference': 'kN'}}, {'signals': 'N'}, {'signals': {'force': None}},
    {'actuator': 5}, {'actuator': {'load.frequency': 'fast'}},
    {'experiment': {'rate_hz': 'fast'}}])
def test_metadata_of_another_form_are_left_out_with_a_warning(
        damaged: dict[str, object], tmp_path: Path) -> None:
    write_bag(a_run(), tmp_path / 'bag', damaged)
    with pytest.warns(InputWarning, match='cannot be used, and is left out'):
        assert read_bag(tmp_path / 'bag').information == {}


def test_a_damaged_quality_of_service_is_said_and_replaced() -> None:
    for damaged in ({}, {'depth': 'x'}, {'depth': 1, 'reliability': 'perhaps'}):
        with pytest.warns(InputWarning, match='cannot be read'):
            assert as_profile(damaged) is STREAM_QOS


def test_a_disk_that_is_full_leaves_nothing_behind(tmp_path: Path,
                                                   monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / 'old').write_text('old')

    def full(_: int) -> None:
        raise OSError(28, 'No space left on device')

    monkeypatch.setattr(os, 'fsync', full)
    for name in ('old', 'new'):
        with pytest.raises(OSError, match=name):
            write_text(tmp_path / name, 'x')
    assert [path.name for path in tmp_path.iterdir()] == ['old']
    assert (tmp_path / 'old').read_text() == 'old'


def test_a_bag_that_cannot_be_finished_does_not_stand_in_the_way(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        def full(_: int) -> None:
            raise OSError(28, 'No space left on device')

        patch.setattr(os, 'fsync', full)
        with pytest.raises(OSError, match='No space left'):
            write_bag(a_run(), tmp_path / 'bag')
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        write_bag(a_run(), tmp_path / 'bag')
        assert len(read_bag(tmp_path / 'bag')) == 300


@pytest.mark.parametrize('variables', [
    pytest.param({'LC_ALL': 'C'}, marks=pytest.mark.slow),
    {'HOME': '/proc/none', 'LC_ALL': 'POSIX', 'PYTHONUTF8': '0'}])
def test_spaces_umlauts_no_home_no_locale_and_no_terminal(
        tmp_path: Path, variables: dict[str, str]) -> None:
    folder = tmp_path / 'Prüf stand'
    neither = os.fsdecode(b'n\xff')     # bytes that are no text
    folder.mkdir()
    write_bag(a_run(), folder / 'lauf ß')
    environment = {'PATH': os.environ['PATH'], 'PYTHONPATH': os.pathsep.join(sys.path)} | variables
    words = ['export', folder / 'lauf ß', '--out', folder / 'ä ö.csv', 'and',
             'import', folder / 'ä ö.csv', '--out', folder / neither, 'and',
             'analyze', folder / neither]
    done = subprocess.run(['sh', '-c', 'exec "$@" <&-', 'sh', sys.executable, '-c', COMMANDS,
                           *map(str, words)], env=environment, capture_output=True, text=True,
                          encoding='utf-8', errors='replace', check=False)
    assert done.returncode == 0, done.stderr
    assert (folder / neither).is_dir()
    assert all(line.startswith('asi: ') for line in done.stderr.splitlines()), done.stderr


def test_a_temporary_folder_that_is_full(tmp_path: Path) -> None:
    write_bag(a_run(), tmp_path / 'bag')
    savemat(tmp_path / 'a.mat', {'force': np.arange(100.0)})
    (tmp_path / 'full').mkdir()
    script = ('mount -t tmpfs -o size=64k tmpfs full || exit 99; '
              'dd if=/dev/zero of=full/all bs=1k 2> /dev/null; export TMPDIR=$PWD/full; '
              '"$@" export bag --out a.parquet and import a.parquet --out again and '
              'import a.mat --map force=force --rate 10 --out new and '
              'limit-cycle again --report report')
    done = subprocess.run(['unshare', '-m', 'sh', '-c', script, 'sh', sys.executable, '-c',
                           COMMANDS], cwd=tmp_path, capture_output=True, text=True, check=False,
                          env=os.environ | {'PYTHONPATH': os.pathsep.join(sys.path)})
    if done.returncode == 99 or 'unshare failed' in done.stderr:
        pytest.skip(f'no folder of its own can be mounted: {done.stderr.strip()}')
    assert (done.returncode, done.stderr) == (0, '')
    assert list((tmp_path / 'report').iterdir())


def a_table(path: Path, rows: int) -> Path:
    path.write_text('time_s,force_n\n' + ''.join(
        f'{k / 1000.0},{k % 7}.25\n' for k in range(rows)))
    return path


def test_memory_of_an_import_is_that_of_its_numbers(tmp_path: Path) -> None:
    """A row of two numbers took 600 bytes; bench/large_files.py imports ten million rows."""
    script = ('import resource, sys; from asi_analysis import cli; status = cli.main(); '
              'print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss); sys.exit(status)')
    peaks = []
    for rows in (1000, 80_000):
        done = subprocess.run(
            [sys.executable, '-c', script, 'import', str(a_table(tmp_path / 'a.csv', rows)),
             '--out', str(tmp_path / f'bag{rows}')], capture_output=True, text=True, check=True,
            env=os.environ | {'PYTHONPATH': os.pathsep.join(sys.path)})
        peaks.append(1024 * int(done.stdout.split()[-1]))
    assert peaks[1] - peaks[0] < 80_000 * 250


def _has_open(pid: int, file: Path) -> bool:
    def target(link: Path) -> str:
        with contextlib.suppress(FileNotFoundError):   # it was closed since the folder was read
            return os.readlink(link)
        return ''

    return str(file) in map(target, Path(f'/proc/{pid}/fd').iterdir())


def test_ctrl_c_ends_the_reading_of_a_large_file(tmp_path: Path) -> None:
    file = a_table(tmp_path / 'a.csv', 300_000)
    process = subprocess.Popen([*ASI, 'import', str(file), '--out', str(tmp_path / 'bag')],
                               stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
                               env=os.environ | {'PYTHONPATH': os.pathsep.join(sys.path)})
    wait_until(lambda: _has_open(process.pid, file), 'the file to be opened')
    process.send_signal(signal.SIGINT)
    assert process.communicate(timeout=PATIENCE_S)[1] == 'asi: interrupted\n'
    assert process.returncode == 130
    assert not (tmp_path / 'bag').exists()


def test_what_a_library_says_in_several_lines_is_told_in_one():
    error = pickle.loads(pickle.dumps(InputError('bag.db3: near\n    "TEXT": syntax error')))
    assert str(error) == 'bag.db3: near "TEXT": syntax error'


def test_a_bag_whose_recorder_was_ended_while_it_wrote_is_not_empty(tmp_path: Path) -> None:
    """Its metadata.yaml still counts no message."""
    bag = tmp_path / 'bag'
    write_bag(a_run(20000), bag)
    described = yaml.safe_load((bag / 'metadata.yaml').read_text())
    described['rosbag2_bagfile_information']['message_count'] = 0
    (bag / 'metadata.yaml').write_text(yaml.safe_dump(described))
    file = next(bag.glob('*.mcap'))
    whole = file.read_bytes()
    file.write_bytes(whole[:len(whole) // 2])
    assert not bag_file.is_empty(bag)
    file.write_bytes(whole[:60])
    assert bag_file.is_empty(bag)
