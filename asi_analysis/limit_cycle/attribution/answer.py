"""`asi attribute`: which nonlinearity causes a limit cycle, of a model or of a recording."""

from collections.abc import Iterator

from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError
from asi_analysis.reporting.result import Pictures, Result, Table, table_of


class Attribution(Result):
    """
    The causes of a limit cycle: `attribute_model` and `attribute_cycle`.

    The keys are those of `asi attribute --json`; `run` is the recording, None for a model,
    `signal` the name of the output signal.
    """

    title = 'Cause of the limit cycle'
    rows = 'causes'
    run: Run | None = None
    signal: str | None = None

    def parts(self) -> Iterator[str | Table]:
        if self.by_model:
            yield table_of(self.causes, {
                'nonlinearity': '{nonlinearity}', 'necessary': '{necessary}',
                'sufficient': '{sufficient}', 'share': '{share:.0%}',
                'alone Hz': '{alone_frequency_hz:.1f}', 'N': '{alone_amplitude_n:.0f}',
                'predicted Hz': '{alone_predicted_frequency_hz:.1f}',
                'predicted N': '{alone_predicted_amplitude_n:.0f}',
                'onset gain': '{alone_onset_gain:.3g}'}, 'each nonlinearity alone')
            yield table_of(self.causes, {
                'nonlinearity': '{nonlinearity}', 'Hz': '{all_but_frequency_hz:.1f}',
                'N': '{all_but_amplitude_n:.0f}',
                'predicted Hz': '{all_but_predicted_frequency_hz:.1f}',
                'predicted N': '{all_but_predicted_amplitude_n:.0f}',
                'onset gain': '{all_but_onset_gain:.3g}'}, 'all but this one')
        if self.get('hysteresis_parts'):
            yield table_of(self.hysteresis_parts, {
                'part of the hysteresis': '{part}', 'share': '{share:.0%}',
                'alone Hz': '{alone_frequency_hz:.1f}', 'N': '{alone_amplitude_n:.0f}',
                'onset gain': '{alone_onset_gain:.3g}', 'at Hz': '{alone_onset_frequency_hz:.1f}'},
                'parts of the hysteresis')
        if self.run is not None:
            yield table_of(self.causes, {'nonlinearity': '{nonlinearity}',
                                         'probability': '{probability:.1%}'},
                           'probability of each cause')
        yield self.verdict

    @property
    def by_model(self) -> bool:
        """Whether the causes come from simulations; otherwise from the shape of the recording."""
        return bool(self.causes) and self.causes[0]['share'] is not None

    def pictures(self) -> Pictures:
        from asi_analysis.limit_cycle.attribution import figure
        if not self.causes:
            raise InputError(self.verdict)
        drawn = (figure.model(self) if self.by_model or self.run is None
                 else figure.recorded(self.run, self, self.signal))
        return {'attribution': (drawn, self.verdict)}
