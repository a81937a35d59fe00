"""The report of `asi reproduce`: the facts, and the simulated Figs. 3 to 12."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from asi_analysis.loop.linear_model import linear_model
from asi_analysis.paper.reproduction.answer import Reproduction
from asi_analysis.reporting.report import write_report
from asi_common.files import write_text


def write_reproduction_report(result: Reproduction, out: Path) -> Path:
    """Write report.html and a PNG of each figure into `out`; return the path of report.html."""
    held_out = [fact for fact in result.facts if fact['role'] == 'held out']
    page = write_report(
        out, 'reproduction.html', result.pictures(),
        document=result, stated={fact['id']: (fact['conditions'], fact['method'])
                                  for fact in result.facts},
        held_out=len(held_out), held_out_met=sum(fact['met'] for fact in held_out),
        linear=linear_model(result.actuator), roots=_roots)
    write_text(out / 'table.md', _table(result))
    return page


def _roots(values: np.ndarray) -> str:
    """Return roots in words, conjugate pairs as one."""
    return ', '.join(f'{root.real:.4g}' + (f' ± {root.imag:.4g}i' if root.imag > 0.0 else '')
                     for root in values if root.imag >= 0.0)


def _table(document: Mapping[str, Any]) -> str:
    """Return the table in Markdown, for doc/explanation/reproduction."""
    lines = ['| fact | quantity | paper | published | simulated | change | met if | | role |',
             '|---|---|---|---|---|---|---|---|---|']
    for fact in document['facts']:
        simulated = '-' if fact['simulated'] is None else f'{fact["simulated"]:.4g}'
        change = '-' if fact['change_percent'] is None else f'{fact["change_percent"]:.2g} %'
        lines.append(f'| {fact["id"]} | {fact["quantity"]} | {fact["section"]} | '
                     f'{fact["published"]:.4g} | {simulated} {fact["unit"]} | {change} | '
                     f'{fact["tolerance"]} | {"met" if fact["met"] else "**not met**"} | '
                     f'{fact["role"]} |')
    lines += ['', f'{document["met"]} of {document["total"]} rows met; '
              f'{len(document["ids_met"])} of {document["ids_total"]} facts met whole.']
    lines += ['', '| Table 1, a column alone | its condition | rows met (not counted) '
              '| not plausible |',
              '|---|---|---|---|']
    lines += [f'| {each["id"]} | {each["conditions"]} | {each["met"]} of {each["total"]} | '
              f'{", ".join(each["not_plausible"]) or "-"} |'
              for each in document['alone']]
    lines += ['', '| not plausible | value | range | because | the range rests on |',
              '|---|---|---|---|---|']
    lines += [f'| {each["name"]} | {each["value"]:.3g} {each["unit"]} | {each["low"]:.3g} to '
              f'{each["high"]:.3g} | {each["problem"]} | {each["source"]} |'
              for each in document['not_plausible']]
    lines += [f'\n{fact["quantity"]}: {fact["note"]}.' for fact in document['facts']
              if fact['note']]
    return '\n'.join(lines) + '\n'
