"""The diagnosis as tables in the terminal."""

from collections.abc import Mapping
from typing import Any

from asi_analysis.gap.diagnose import sentences
from asi_analysis.gap.model.effects import NO_GAP
from asi_analysis.terminal import table


def figure(value: float | None) -> str:
    """Return a number with four digits; a dash for none."""
    return '-' if value is None else f'{value:.4g}'


def sizes(row: Mapping[str, Any]) -> list[str]:
    """Return the parameters of an effect with their 95 % intervals, one text each."""
    return [f'{name} {value:.4g} [{row["parameters_low"][name]:.4g}, '
            f'{row["parameters_high"][name]:.4g}]' for name, value in row['parameters'].items()]


def as_text(document: Mapping[str, Any]) -> str:
    """Return the verdict in three sentences, then the tables."""
    lines = [*sentences(document)]
    for title, columns, rows in (
            ('where', ('block', 'share'),
             [(row['block'], f'{100 * row["share"]:.0f} %') for row in document['where']
              if row['share'] > 0.005]),
            ('which', ('effect', 'block', 'probability', 'parameters'),
             [(row['effect'], row['block'], f'{100 * row["probability"]:.1f} %',
               ', '.join(sizes(row))) for row in document['which'][:6]]),
            ('how far, on held-out data (share of the signal)',
             ('channel', 'nominal', 'refitted', 'with the effect', 'noise', 'shrink'),
             [(row['channel'], *(f'{100 * row[key]:.2f} %' for key in (
                 'before_nrmse', 'refitted_nrmse', 'after_nrmse', 'noise_floor_nrmse')),
               '-' if document['verdict'] == NO_GAP else
               f'{row["shrink"]:.3f} [{row["shrink_low"]:.3f}, {row["shrink_high"]:.3f}]')
              for row in document['channels']]),
            ('in the loop', ('quantity', 'nominal', 'improved (95 % interval)', 'measured'),
             [(row['quantity'], figure(row['nominal']), figure(row['improved']) + (
                 '' if row['improved_low'] is None else
                 f' ({figure(row["improved_low"])} to {figure(row["improved_high"])})'),
               figure(row['measured'])) for row in document['consequences']
              if (row['nominal'], row['improved'], row['measured']) != (None, None, None)])):
        if rows:
            lines.append(table(columns, rows, title))
    lines += [f'note: {note}' for note in document['notes']]
    if document['report']:
        lines.append(f'report: {document["report"]}')
    return '\n'.join(lines)
