"""
Read an episode of a LeRobot dataset as columns by name: `observation.state.NAME`, `timestamp`.

A folder with meta/info.json, which describes the features, and data/**/*.parquet: one file an
episode (v2), or many episodes in one (v3). Only numbers are read, no images and videos.
"""

import json
import re
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from asi_analysis.bags.exchange.text_file import MOST_COLUMNS, MOST_RATIO
from asi_analysis.bags.limits import IF_INTENDED, unpack_limit
from asi_analysis.errors import InputError, InputWarning
from asi_common.files import read_bytes

WIDE: Final = re.compile(r':\D*\d{4}')   # a format that pads a number to 1000 characters or more
INFO: Final = Path('meta/info.json')
MOST_INFO: Final = 10_000_000   # bytes
MOST_OF_AN_EPISODE: Final = 400_000_000     # bytes of its numbers, unpacked
VISUAL: Final = ('image', 'video')
# Columns that say where a row is, not what was measured.
EPISODE: Final = 'episode_index'
FRAME: Final = 'frame_index'
PLACES: Final = frozenset(('index', FRAME, EPISODE, 'task_index'))


class Feature(NamedTuple):
    """A feature: its type, how many numbers a row has (0: no vector), and their names."""

    dtype: str
    width: int
    names: tuple[str, ...]


class Dataset(NamedTuple):
    """What meta/info.json says of a dataset."""

    path: Path
    episodes: int
    data_path: str
    chunk: int
    features: dict[str, Feature]

    def visual(self) -> list[str]:
        """Return the features that are images or videos."""
        return [name for name, each in self.features.items() if each.dtype in VISUAL]


def is_dataset(path: Path) -> bool:
    """Return whether a path is a folder laid out as a LeRobot dataset, perhaps a damaged one."""
    return path.is_dir() and not (path / 'metadata.yaml').exists() and (
        (path / INFO).exists() or ((path / 'data').is_dir() and any(
            path.glob('data/*/*.parquet'))))


def read_information(path: Path) -> Dataset:
    """Return what meta/info.json says. Raises InputError."""
    file = path / INFO
    try:
        info = json.loads(read_bytes(file, MOST_INFO))
    except OSError as error:
        raise InputError(f'{file} cannot be read: {error.strerror}; a LeRobot dataset has it'
                         ) from None
    except (ValueError, RecursionError) as error:
        raise InputError(f'{file} is not JSON: {error}') from None
    version = _entry(info, 'codebase_version', str, file)
    if not version.startswith(('v2', 'v3')):
        raise InputError(f'{file}: version {version}: v2 and v3 can be read; LeRobot converts '
                         'older ones')
    episodes, chunk = (_entry(info, name, int, file) for name in ('total_episodes', 'chunks_size'))
    features = _entry(info, 'features', dict, file)
    if len(features) > MOST_COLUMNS:
        raise InputError(f'{file} has {len(features)} features')
    return Dataset(path, episodes, _entry(info, 'data_path', str, file), max(chunk, 1),
                   {name: _feature(name, each, file) for name, each in features.items()})


def _entry(info: Any, name: str, kind: type, file: Path) -> Any:
    value = info.get(name) if isinstance(info, dict) else None
    if not isinstance(value, kind) or isinstance(value, bool):
        raise InputError(f'{file}: {name} is missing, or no '
                         + {str: 'text', int: 'whole number', dict: 'object'}[kind])
    return value


def _feature(name: str, entry: Any, file: Path) -> Feature:
    shape = entry.get('shape') if isinstance(entry, dict) else None
    dtype = entry.get('dtype') if isinstance(entry, dict) else None
    if not isinstance(dtype, str) or not isinstance(shape, list) or not all(
            isinstance(each, int) and each >= 0 for each in shape):
        raise InputError(f'{file}: feature {name} has no dtype and shape')
    width = shape[0] if len(shape) == 1 else 0
    names = entry.get('names')
    if isinstance(names, dict):   # such as {"motors": [...]}
        names = [each for part in names.values() if isinstance(part, list) for each in part]
    known = ([str(each) for each in names] if isinstance(names, list) else [])
    if width > MOST_COLUMNS:
        known = []
    elif len(known) != width or len(set(known)) != width:
        known = [f'#{number}' for number in range(1, width + 1)]
    return Feature(dtype, width, tuple(known if len(shape) == 1 else ()))


def chosen_episode(dataset: Dataset, episode: int | None, guess: bool = False) -> int:
    """
    Return the episode to read; raises InputError if there is no such one.

    guess: the first, if none is told; else the only one.
    """
    if episode is None and (guess or dataset.episodes == 1):
        episode = 0
    which = (f'it has {dataset.episodes}, 0 to {dataset.episodes - 1}' if dataset.episodes > 1
             else f'it has {dataset.episodes}')
    if episode is None:
        raise InputError(f'{dataset.path}: which episode? {which}: give --episode N')
    if not 0 <= episode < dataset.episodes:
        raise InputError(f'{dataset.path}: there is no episode {episode}: {which}')
    return episode


def read_dataset(path: Path, episode: int | None, guess: bool = False
                 ) -> dict[str, npt.NDArray]:
    """
    Return the numbers of an episode by name. Raises InputError, and what pyarrow raises.

    guess: the first, if none is told.
    """
    dataset = read_information(path)
    number = chosen_episode(dataset, episode, guess)
    wanted = [name for name, each in dataset.features.items()
              if each.dtype not in (*VISUAL, 'string') and each.names
              and name not in PLACES - {FRAME}]
    parts: dict[str, list[npt.NDArray]] = {}
    for file in _files(dataset, number):
        for name, rows in _rows(file, number, wanted, dataset):
            parts.setdefault(name, []).append(rows)
    if not parts:
        raise InputError(f'{path}: no row of episode {number} is in data/')
    columns: dict[str, npt.NDArray] = {}
    for name, values in parts.items():
        whole = np.concatenate(values)
        names = dataset.features[name].names
        found = {name: whole[:, 0]} if len(names) == 1 else {
            f'{name}{each}' if each.startswith('#') else f'{name}.{each}': whole[:, k]
            for k, each in enumerate(names)}
        if twice := columns.keys() & found.keys():
            raise InputError(f'{path}: two columns are called {min(twice)}')
        columns |= found
    frames = columns.pop(FRAME, np.arange(0))
    if len(frames) and not np.array_equal(frames, np.arange(len(frames))):
        warnings.warn(f'{path}: {FRAME} of episode {number} does not count from 0 row by row: '
                      'rows are missing, repeated or out of order', InputWarning, stacklevel=2)
    return columns


def _files(dataset: Dataset, episode: int) -> list[Path]:
    """Return the files that may hold an episode: of v2 its own, of v3 all in their order."""
    if '{episode_index' not in dataset.data_path:
        files = sorted(dataset.path.glob('data/*/*.parquet'))
        if strange := [file for file in files if not file.is_file()]:
            raise InputError(f'{strange[0]} is not a file')
        if not files:
            raise InputError(f'{dataset.path}: no data/*/*.parquet')
        return files
    try:
        if WIDE.search(dataset.data_path):
            raise ValueError
        name = dataset.data_path.format(episode_chunk=episode // dataset.chunk,
                                        episode_index=episode)
    except (KeyError, IndexError, ValueError, AttributeError):
        raise InputError(f'{dataset.path / INFO}: data_path {dataset.data_path!r} is not '
                         'understood') from None
    file = dataset.path / name
    if '..' in Path(name).parts or Path(name).is_absolute() or not file.is_file():
        raise InputError(f'{dataset.path}: episode {episode} should be in {name}, which is '
                         'no file of the dataset')
    return [file]


def _rows(file: Path, episode: int, wanted: Sequence[str], dataset: Dataset
          ) -> Iterator[tuple[str, npt.NDArray]]:
    """Yield the rows of an episode (n x width) of each feature, row group by row group."""
    import pyarrow.compute as pc
    from pyarrow.parquet import ParquetFile
    with ParquetFile(file, page_checksum_verification=True) as parquet:
        present = parquet.schema_arrow.names
        if EPISODE not in present:
            raise InputError(f'{file}: no column {EPISODE}')
        if missing := [name for name in wanted if name not in present]:
            raise InputError(f'{file}: no column {", ".join(missing)}, which meta/info.json has')
        numeric = [name for name in wanted if _is_numeric(parquet.schema_arrow.field(name).type)]
        if strange := [name for name in wanted if name not in numeric]:
            raise InputError(f'{file}: column {strange[0]} is '
                             f'{parquet.schema_arrow.field(strange[0]).type}, but meta/info.json '
                             f'says {dataset.features[strange[0]].dtype}')
        for group in range(parquet.num_row_groups):
            _refuse_large(file, parquet.metadata.row_group(group), numeric, dataset)
            # Not by the statistics of the row groups: if damaged, pyarrow ends the process.
            places = parquet.read_row_group(group, columns=[EPISODE])[EPISODE]
            if not pc.any(pc.equal(places, episode)).as_py():
                continue
            table = parquet.read_row_group(group, columns=[EPISODE, *numeric])
            table = table.filter(pc.equal(table[EPISODE], episode))
            for name in numeric if table.num_rows else ():
                yield name, _numbers(table[name].combine_chunks(), name,
                                     dataset.features[name].width, file)


def _refuse_large(file: Path, group: Any, names: Sequence[str], dataset: Dataset) -> None:
    width = sum(dataset.features[name].width for name in names)
    size = 8 * group.num_rows * (width + 1)
    if size > (limit := unpack_limit(file.stat().st_size, MOST_OF_AN_EPISODE, MOST_RATIO)):
        raise InputError(f'{file}: {group.num_rows} rows unpack to {size / 1e6:.0f} MB, more than '
                         f'{limit / 1e6:.0f} MB: {IF_INTENDED}')


def _is_numeric(kind: Any) -> bool:
    import pyarrow as pa
    if pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind):
        kind = kind.value_type
    return bool(pa.types.is_integer(kind) or pa.types.is_floating(kind)
                or pa.types.is_boolean(kind))


def _numbers(column: Any, name: str, width: int, file: Path) -> npt.NDArray:
    """Return a column as numbers (n x width), NaN where there is none."""
    import pyarrow as pa
    import pyarrow.compute as pc
    found = np.full((len(column), width), np.nan)
    present = column.is_valid().to_numpy(zero_copy_only=False)
    if pa.types.is_nested(column.type):
        lengths = pc.list_value_length(column).to_numpy(zero_copy_only=False)[present]
        if (wrong := lengths != width).any():
            raise InputError(f'{file}: {name} has {int(lengths[wrong][0])} numbers in a row, but '
                             f'{width} in meta/info.json')
        column = pc.list_flatten(column)
        values = column.cast(pa.float64(), safe=False).to_numpy(zero_copy_only=False)
        found[present] = values.reshape(-1, width)
    elif width != 1:
        raise InputError(f'{file}: {name} has one number in a row, but {width} in meta/info.json')
    else:
        found[:, 0] = column.cast(pa.float64(), safe=False).to_numpy(zero_copy_only=False)
    return found


def refuse_episode(path: Path, episode: int | None) -> None:
    """Raise InputError if an episode is given for a path that is no dataset."""
    if episode is not None:
        raise InputError(f'--episode {episode}: {path} is no LeRobot dataset')


def refuse_visual(path: Path, columns: Sequence[str]) -> None:
    """Raise InputError if a column is an image or a video."""
    dataset = read_information(path)
    for column in columns:
        for name in dataset.visual():
            if column == name or column.startswith((f'{name}.', f'{name}#')):
                kind = 'an image' if dataset.features[name].dtype == 'image' else 'a video'
                raise InputError(f'{path}: {name} is {kind}: only numbers can be imported')


def notes_of(path: Path, episode: int | None) -> list[str]:
    """Return what a preview says of a dataset: the episode, what is left out, and units."""
    dataset = read_information(path)
    number = chosen_episode(dataset, episode, guess=True)
    notes = [f'this is episode {number} of {dataset.episodes}, 0 to {dataset.episodes - 1}'
             ] if dataset.episodes > 1 else []
    omitted = [f'{name} ({each.dtype})' for name, each in dataset.features.items()
            if each.dtype in (*VISUAL, 'string') or (not each.names and name not in PLACES)]
    if omitted:
        notes.append('left out, as no row of numbers: ' + ', '.join(omitted))
    return [*notes, 'a LeRobot dataset has no units; a motor bus may record degrees, or shares of '
            'its range (-100 to 100)']
