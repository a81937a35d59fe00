"""How much a compressed file may unpack to can be set, for each reader."""

import gzip
from pathlib import Path

import numpy as np
import pyarrow
import pytest
from pyarrow import parquet
from rosbags.rosbag2 import CompressionMode
from scipy.io import savemat

from asi_analysis.bags.bag import read_bag, write_bag
from asi_analysis.bags.exchange.importing import import_recording
from asi_analysis.bags.limits import VARIABLE, unpack_limit
from asi_analysis.errors import InputError
from torture.inputs import as_sqlite, recording


@pytest.mark.parametrize('kind', ['csv.gz', 'npz', 'mat', 'parquet'])
def test_a_table_unpacks_to_what_is_set(kind: str, tmp_path: Path,
                                        monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a MAT file, the memory of the process that reads it is limited: by pages."""
    rows, most_mb = (5_000_000, 1.0) if kind == 'mat' else (3000, 0.001)
    file, force = tmp_path / f'a.{kind}', np.arange(rows)
    if kind == 'csv.gz':
        file.write_bytes(gzip.compress(b'force\n' + b'\n'.join(b'%d' % x for x in force)))
    elif kind == 'npz':
        np.savez_compressed(file, force=force)
    elif kind == 'mat':
        savemat(file, {'force': np.zeros(rows)}, do_compression=True)
    else:
        parquet.write_table(pyarrow.table({'force': force}), file)
    monkeypatch.setenv(VARIABLE, str(most_mb))
    with pytest.raises(InputError, match='unpack|memory'):
        import_recording(file, ['force=force'], 100.0)
    monkeypatch.setenv(VARIABLE, str(1000.0 * most_mb))
    assert len(import_recording(file, ['force=force'], 100.0)) == rows


@pytest.mark.parametrize('storage', ['mcap', 'sqlite'])
def test_a_bag_unpacks_to_what_is_set(storage: str, tmp_path: Path,
                                      monkeypatch: pytest.MonkeyPatch) -> None:
    write_bag(recording(), tmp_path / 'mcap')
    as_sqlite(tmp_path / 'mcap', tmp_path / 'sqlite', CompressionMode.FILE)
    monkeypatch.setenv(VARIABLE, '0.001')
    with pytest.raises(InputError, match=f'unpacks to more .*{VARIABLE}'):
        read_bag(tmp_path / storage)
    monkeypatch.setenv(VARIABLE, '10')
    assert len(read_bag(tmp_path / storage)) == len(recording())


@pytest.mark.parametrize('text', ['0', '-1', 'nan', 'inf', '10 MB'])
def test_what_is_no_size_is_refused(text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, text)
    with pytest.raises(InputError, match=f'{VARIABLE} = .* is not allowed'):
        unpack_limit(1, 100, 20)


def test_without_it_the_limit_is_that_of_the_reader(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    assert (unpack_limit(1, 100, 20), unpack_limit(50, 100, 20)) == (100, 1000)
