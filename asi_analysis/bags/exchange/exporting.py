"""`Run` → CSV or Parquet, with the units in the names of the columns."""

import csv
import json
from pathlib import Path

import numpy as np

from asi_analysis.bags.run import Array, Run
from asi_analysis.errors import InputError


def export(run: Run, path: str | Path) -> None:
    """
    Write a run to a .csv or .parquet file, a missing sample as an empty cell or null.

    Every number is written in full: importing the file gives the same run. Raises InputError for
    another kind of file, or one that exists or cannot be written.
    """
    path = Path(path)
    if path.exists():
        raise InputError(f'{path} exists already: give another file')
    try:
        if path.suffix == '.csv':
            _write_csv(run, path)
        elif path.suffix == '.parquet':
            _write_parquet(run, path)
        else:
            raise InputError(f'{path}: expected a .csv or .parquet file')
    except OSError as error:
        raise InputError(f'{path} cannot be written: {error.strerror or error}') from None


def columns(run: Run) -> dict[str, Array]:
    """Return time and signals by the name of their column, such as force_n."""
    return {'time_s': run.time_s} | {
        f'{name}_{run.unit(name).replace("/", "_").lower()}': values
        for name, values in run.signals().items()}


def _write_csv(run: Run, path: Path) -> None:
    table = columns(run)
    with path.open('w', newline='') as stream:
        writer = csv.writer(stream)
        writer.writerow(table)
        cells = [['' if np.isnan(value) else repr(value) for value in values.tolist()]
                 for values in table.values()]
        writer.writerows(zip(*cells, strict=True))


def _write_parquet(run: Run, path: Path) -> None:
    import pyarrow
    from pyarrow.parquet import write_table
    table = pyarrow.table({name: pyarrow.array(values, from_pandas=True)
                           for name, values in columns(run).items()})
    write_table(table.replace_schema_metadata({'asi.run': json.dumps(run.information)}), path)
