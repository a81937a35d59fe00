"""Export a `Run` as CSV or Parquet, with the units in the column names."""

import csv
import json
from pathlib import Path
from typing import Final

import numpy as np

from asi_analysis.bags.bag_writer import INFORMATION
from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError
from asi_common.files import replacing

BLOCK_ROWS: Final = 20_000


def export(run: Run, path: str | Path) -> None:
    """
    Write a run to a .csv or .parquet file, a missing sample as an empty cell or null.

    Numbers have full precision: importing the file gives the same run, of Parquet with what the
    bag says of it, as its controller. Raises InputError for another suffix, or a file that exists
    or cannot be written.

    >>> import tempfile
    >>> import asi_analysis as asi
    >>> folder = tempfile.mkdtemp()
    >>> asi.export(asi.simulate({}, {'reference.amplitude': 100.0}, 0.2), f'{folder}/run.csv')
    >>> print(open(f'{folder}/run.csv').readline().strip())
    time_s,reference_n,command_n,force_n,valve_position_m,position_m,velocity_m_s
    """
    path = Path(path)
    writers = {'.csv': _write_csv, '.parquet': _write_parquet}
    if path.suffix not in writers:
        raise InputError(f'{path}: expected a .csv or .parquet file')
    if path.exists():
        raise InputError(f'{path} exists already: give another file')
    try:
        with replacing(path) as temporary:
            writers[path.suffix](run, temporary)
    except OSError as error:
        raise InputError(f'{path} cannot be written: {error.strerror or error}') from None


def _write_csv(run: Run, path: Path) -> None:
    table = run.columns()
    with path.open('w', newline='') as stream:
        writer = csv.writer(stream)
        writer.writerow(table)
        for start in range(0, len(run), BLOCK_ROWS):
            cells = [['' if np.isnan(value) else repr(value)
                      for value in values[start:start + BLOCK_ROWS].tolist()]
                     for values in table.values()]
            writer.writerows(zip(*cells, strict=True))


def _write_parquet(run: Run, path: Path) -> None:
    import pyarrow
    from pyarrow.parquet import write_table
    table = pyarrow.table({name: pyarrow.array(values, from_pandas=True)
                           for name, values in run.columns().items()})
    write_table(table.replace_schema_metadata({INFORMATION: json.dumps(run.information)}), path,
                write_page_checksum=True)
