"""Read a table of another system (CSV, JSON, MAT, NPZ, Parquet, LeRobot) as columns by name."""

import csv
import lzma
import os
import subprocess
import sys
import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from asi_analysis.bags.exchange.json_file import LINES, read_json
from asi_analysis.bags.exchange.lerobot import is_dataset, read_dataset, refuse_episode
from asi_analysis.bags.exchange.text_file import read_text, unpacked_limit
from asi_analysis.bags.limits import IF_INTENDED
from asi_analysis.errors import InputError, InputWarning

MOST_COLUMNS: Final = 64   # of a matrix in a MAT file
# What the libraries raise for damaged files.
BROKEN: Final = (OSError, ValueError, EOFError, NotImplementedError, TypeError, KeyError,
                 IndexError, MemoryError, OverflowError, RecursionError, csv.Error, zlib.error,
                 lzma.LZMAError, zipfile.BadZipFile,
                 SyntaxError, tokenize.TokenError)    # headers of numpy

TEXTS: Final = ('.csv', '.tsv', '.txt', '.dat', '.log')

# column name → its values; a scalar of a MAT file is a column of one value
Table = dict[str, npt.NDArray]


def read_table(path: Path, skip_lines: int = 0, delimiter: str | None = None,
               columns: Sequence[str] | None = None, episode: int | None = None,
               guess: bool = False) -> Table:
    """
    Return the columns of a file by name. Raises InputError.

    episode: of a LeRobot dataset; guess: its first, if none is told.
    """
    kind = Path(path.stem).suffix if path.suffix == '.gz' else path.suffix
    dataset = is_dataset(path)
    if not dataset:
        refuse_episode(path, episode)
    if not dataset and path.exists() and not path.is_file():
        raise InputError(f'{path} is not a file')
    try:
        if dataset:
            return read_dataset(path, episode, guess)
        if (kind in TEXTS or kind in READERS) and not path.stat().st_size:
            raise InputError(f'{path} is empty')    # one of /proc may wait for its content
        if kind in TEXTS:
            return read_text(path, skip_lines, delimiter, columns)
        if kind in READERS:
            return READERS[kind](path)
    except BROKEN as error:
        if isinstance(error, InputError):
            raise
        why = error.strerror if isinstance(error, OSError) else None
        raise InputError(f'{path} cannot be read: '
                         + (why or ' '.join(str(error).split()) or type(error).__name__)
                         ) from None
    raise InputError(f'{path}: expected a {", ".join((*TEXTS, *READERS))} file (a text also as '
                     '.gz), or the folder of a LeRobot dataset')


def _refuse_large(path: Path, size: int) -> None:
    if size > (limit := unpacked_limit(path)):
        raise InputError(f'{path} unpacks to {size / 1e6:.0f} MB, more than {limit / 1e6:.0f} MB: '
                         + IF_INTENDED)


def _read_mat(path: Path) -> Table:
    """
    Return the arrays of numbers of a MAT file.

    scipy reads it in a separate process, as damaged files have crashed its compiled code.
    """
    script = ('import sys; from asi_analysis.bags.exchange import table_file; '
              'table_file.convert_mat(sys.argv[1], int(sys.argv[2]))')
    done = subprocess.run([sys.executable, '-c', script, str(path), str(unpacked_limit(path))],
                          capture_output=True, check=False,
                          env=os.environ | {'PYTHONPATH': os.pathsep.join(sys.path)})
    if done.returncode:
        lines = done.stderr.decode(errors='replace').strip().splitlines()
        raise ValueError(lines[-1].removeprefix('ValueError: ') if lines and done.returncode == 1
                         else 'it is damaged')
    with np.load(BytesIO(done.stdout)) as arrays:
        return _with_warnings({str(name): arrays[f'arr_{number}'] for number, name
                      in enumerate(arrays['names'])}, map(str, arrays['left_out']), path)


def convert_mat(path: str, most_bytes: int) -> None:
    """Write the columns of a MAT file to stdout as .npz; exit with a text for a damaged one."""
    import resource

    from scipy.io import loadmat
    used = int(Path('/proc/self/statm').read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + 4 * most_bytes,) * 2)
    try:
        columns, left_out = _columns({name: values for name, values in loadmat(path).items()
                                      if not name.startswith('__')})
        written = BytesIO()
        np.savez(written, *columns.values(), names=np.array(list(columns), str),
                 left_out=np.array(left_out, str))
    except Exception as error:  # noqa: B902 - scipy raises anything for damaged bytes
        sys.exit(' '.join(str(error).split()) or type(error).__name__)
    sys.stdout.buffer.write(written.getbuffer())


def _read_npz(path: Path) -> Table:
    with zipfile.ZipFile(path) as archive:
        _refuse_large(path, sum(member.file_size for member in archive.infolist()))
    with np.load(path) as arrays:
        # A member of the archive that is no array comes as bytes.
        return _with_warnings(*_columns({name: values for name, values in arrays.items()
                                if isinstance(values, np.ndarray)}), path)


def _with_warnings(table: Table, left_out: Iterable[str], path: Path) -> Table:
    """Return a table, with a warning of each variable that is left out."""
    for each in left_out:
        warnings.warn(f'{path}: {each}', InputWarning, stacklevel=3)
    return table


def _columns(variables: Mapping[str, npt.NDArray]) -> tuple[Table, list[str]]:
    """Return the columns of variables, and a sentence on each part that is left out."""
    table: Table = {}
    left_out = []
    for variable, values in variables.items():
        for name, column in _columns_of(variable, values):
            if column is None:
                left_out.append(f'{name} is left out: a variable has numbers or dates, in at most '
                                f'{MOST_COLUMNS} columns and two dimensions')
            elif name in table:
                raise ValueError(f'two columns are called {name}')
            else:
                table[name] = column
    return table, left_out


def _columns_of(name: str, values: npt.NDArray) -> Iterator[tuple[str, npt.NDArray | None]]:
    """
    Yield the columns of a variable: a vector, columns name#1 ..., or fields name.x.

    Elements of a cell array or an array of structures are name#1, name#1.x ... None stands for
    numbers that are no column.
    """
    if values.dtype.names or values.dtype == object:
        if values.size > MOST_COLUMNS:
            yield f'{name}#{MOST_COLUMNS + 1} to #{values.size}', None
        for number, element in enumerate(np.ravel(values)[:MOST_COLUMNS], 1):
            one = name if values.size == 1 else f'{name}#{number}'
            if values.dtype.names:
                for field in values.dtype.names:
                    yield from _columns_of(f'{one}.{field}', np.asarray(element[field]))
            else:
                yield from _columns_of(one, np.asarray(element))
    elif values.dtype.kind == 'b':
        yield from _columns_of(name, values.astype(float))
    elif values.dtype.kind not in 'iufcmM':
        if values.size > 1:     # a single text is a remark
            yield name, None
    elif values.size == max(values.shape, default=0):
        yield name, np.ravel(values)
    elif values.ndim == 2 and min(values.shape) <= MOST_COLUMNS:
        by_column = values if values.shape[0] > values.shape[1] else values.T
        for number, column in enumerate(by_column.T, 1):
            yield f'{name}#{number}', column
    else:
        yield name, None


def _read_parquet(path: Path) -> Table:
    from pyarrow.parquet import ParquetFile
    file = ParquetFile(path, page_checksum_verification=True)
    sizes = [file.metadata.row_group(k).total_byte_size for k in range(file.num_row_groups)]
    _refuse_large(path, max(sum(sizes), 8 * file.metadata.num_rows * file.metadata.num_columns))
    table = file.read()
    found: Table = {}
    left_out = []
    for name in table.column_names:
        column = table[name].to_numpy()
        if not (len(column) and isinstance(column[0], np.ndarray)):
            found[name] = column
            continue
        try:    # a list in each row
            listed, more = _columns({name: np.stack(column)})
        except (ValueError, TypeError):
            listed, more = {}, [f'{name} is left out: its lists are not of one length']
        if twice := found.keys() & listed.keys():
            raise ValueError(f'two columns are called {min(twice)}')
        found |= listed
        left_out += more
    return _with_warnings(found, left_out, path)


# By the suffix of a file; a format is added here.
READERS: Final[Mapping[str, Callable[[Path], Table]]] = {
    **dict.fromkeys(('.json', *LINES), read_json), '.mat': _read_mat, '.npz': _read_npz,
    '.parquet': _read_parquet}
