"""The results of `asi import` and `asi export`."""

from collections.abc import Iterator
from pathlib import Path

from asi_analysis.bags.run import Run
from asi_analysis.reporting.result import Result, Table


class Imported(Result):
    """A recording that was imported, by the keys of `asi import --json`."""

    run: Run

    @classmethod
    def of(cls, run: Run, bag: Path) -> 'Imported':
        return cls({'bag': str(bag), 'samples': len(run), 'duration_s': run.duration_s,
                    'rate_hz': run.rate_hz, 'signals': list(run.signals())}, run=run)

    def parts(self) -> Iterator[str | Table]:
        yield from self.run.parts()
        yield f'bag: {self.bag}'


class Exported(Result):
    """A table that was written, by the keys of `asi export --json`."""

    @classmethod
    def of(cls, run: Run, file: Path) -> 'Exported':
        return cls({'file': str(file), 'samples': len(run), 'signals': list(run.signals())})

    def parts(self) -> Iterator[str | Table]:
        yield f'{self.file}: {self.samples} rows, {", ".join(self.signals)}'
