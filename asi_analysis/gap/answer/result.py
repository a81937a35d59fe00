"""The diagnosis as a result: sentences and tables, pictures, the report."""

from collections.abc import Iterator, Mapping
from pathlib import Path

from asi_analysis.bags.run import Run
from asi_analysis.gap.answer.tables import tables
from asi_analysis.gap.diagnose import Diagnosis
from asi_analysis.gap.words import sentences
from asi_analysis.reporting.result import Pictures, Result, Table
from asi_common.parameter import Value


class Gap(Result):
    """
    Where, why and how far a model differs from recordings: `diagnose`.

    The keys are those of `asi gap --json`; `runs` are the recordings, `diagnosis` what was fitted,
    `model` the nominal parameters of actuator or joint, None of a characteristic.
    """

    title = 'The sim-to-real gap'
    rows = 'which'
    runs: list[Run]
    diagnosis: Diagnosis
    model: Mapping[str, Value] | None

    def parts(self) -> Iterator[str | Table]:
        if not self.reliable:
            yield 'The recordings are doubtful, and so is this answer: see the notes.'
        yield from sentences(self)
        yield from tables(self)
        if self.characteristic:
            from asi_analysis.gap.answer.characteristic import figures
            yield figures(self.characteristic)
        yield from (f'note: {note}' for note in self.notes)
        if self.report:
            yield f'report: {self.report}'
        if self.exports:
            from asi_analysis.gap.answer.export import in_words
            yield from in_words(self.exports)

    def pictures(self) -> Pictures:
        from asi_analysis.gap.answer.report import drawn
        return drawn(self.diagnosis, self)

    def write_report(self, out: Path) -> Path:
        """Write report.html, its pictures and, of actuator or joint, improved.yaml into `out`."""
        from asi_analysis.gap.answer.report import write_gap_report
        page = write_gap_report(self.diagnosis, self, out, self.model)
        self['report'] = str(page)
        return page

    def write_export(self, path: Path) -> Path:
        """
        Write what was found for a simulator: MJCF (.xml), URDF (.urdf) or parameters (.yaml).

        With the package mujoco the recordings are replayed with an MJCF. Raises InputError for
        another ending, or for what the format has no words for.
        """
        from asi_analysis.gap.answer.export import write_export
        self['exports'].append(write_export(self.diagnosis, self.model, path))
        return path
