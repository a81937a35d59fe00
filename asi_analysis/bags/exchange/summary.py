"""The results of `asi import` and `asi export`."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from asi_analysis.bags.exchange.preview import command
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


class Previews(Result):
    """What the files hold that `asi import` was called with alone, by the keys of its --json."""

    rows = 'files'

    @classmethod
    def of(cls, previews: Sequence[Result]) -> 'Previews':
        paths = [Path(each.file) for each in previews]
        joined: dict[str, str] = {}      # by signal, that of the time by file; the first counts
        for path, each in zip(paths, previews, strict=True):
            for text in each.mapping:
                signal, _, term = text.partition('=')
                key = f'{path} {signal}' if signal == 'time' else signal
                joined.setdefault(key, f'{signal}={path.stem}/{term}')
        return cls({'files': [each.to_dict() for each in previews],
                    'command': previews[0].command if len(previews) == 1 else
                    command(paths, list(joined.values()), previews[0].options)}, previews=previews)

    def parts(self) -> Iterator[str | Table]:
        for each in self.previews:
            yield from each.parts()
        yield f'to import: {self.command}'


class Exported(Result):
    """A table that was written, by the keys of `asi export --json`."""

    @classmethod
    def of(cls, run: Run, file: Path) -> 'Exported':
        return cls({'file': str(file), 'samples': len(run), 'signals': list(run.signals())})

    def parts(self) -> Iterator[str | Table]:
        yield f'{self.file}: {self.samples} rows, {", ".join(self.signals)}'
