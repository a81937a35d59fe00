"""The results of `asi import`, `asi split` and `asi export`."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from asi_analysis.bags.exchange.joints import folder_name
from asi_analysis.bags.exchange.preview import command
from asi_analysis.bags.run import Run
from asi_analysis.reporting.result import Result, Table, table_of


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


class ImportedJoints(Result):
    """A recording of several joints that was imported, by the keys of `asi import --json`."""

    rows = 'joints'

    @classmethod
    def of(cls, runs: Mapping[str, Run], out: Path) -> 'ImportedJoints':
        return cls({'joints': [{'joint': joint, **Imported.of(run, out / folder_name(joint))}
                               for joint, run in runs.items()]})

    def parts(self) -> Iterator[str | Table]:
        yield table_of(self.joints, {
            'joint': '{joint}', 'samples': '{samples:d}', 'rate, Hz': '{rate_hz:.5g}',
            'duration, s': '{duration_s:.5g}', 'bag': '{bag}'})
        yield 'signals of each: ' + ', '.join(self.joints[0]['signals'])


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


class Split(Result):
    """The parts of a bag that was divided, by the keys of `asi split --json`."""

    rows = 'bags'

    @classmethod
    def of(cls, written: Mapping[Path, int]) -> 'Split':
        return cls({'bags': [{'bag': str(bag), 'messages': count}
                              for bag, count in written.items()]})

    def parts(self) -> Iterator[str | Table]:
        yield table_of(self.bags, {'bag': '{bag}', 'messages': '{messages:d}'})


class Exported(Result):
    """A table that was written, by the keys of `asi export --json`."""

    @classmethod
    def of(cls, run: Run, file: Path) -> 'Exported':
        return cls({'file': str(file), 'samples': len(run), 'signals': list(run.signals())})

    def parts(self) -> Iterator[str | Table]:
        yield f'{self.file}: {self.samples} rows, {", ".join(self.signals)}'
