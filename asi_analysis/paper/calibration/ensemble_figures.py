"""Figures of the spread of the ensemble, per parameter and pairwise."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from asi_analysis.paper.calibration.quantities import FREE, PHYSICAL
from asi_analysis.reporting.figures import BLUE, ORANGE, drawing

PAIRED_PARAMETERS = 8


def _share(member: Mapping[str, float], k: int) -> float:
    return FREE[k].share(member[FREE[k].name])


def spread(found: Sequence[Mapping[str, float]], best: Mapping[str, float]) -> Figure:
    """Draw the position of the members in the range of each parameter, 0 to 1."""
    with drawing(0.24 * len(PHYSICAL) + 0.8) as figure:
        axes = figure.subplots()
        for row, k in enumerate(PHYSICAL):
            axes.plot([_share(member, k) for member in found], [row] * len(found), 'o',
                      color=BLUE, markersize=3.0, alpha=0.5)
            axes.plot(_share(best, k), row, '|', color=ORANGE, markersize=10.0)
        axes.set_yticks(range(len(PHYSICAL)), [FREE[k].name for k in PHYSICAL], fontsize=7.0)
        axes.set(xlim=(0.0, 1.0), xlabel='share of the range searched; bar: the defaults')
        axes.invert_yaxis()
        axes.set_title('What the paper does not determine')
    return figure


def pairs(found: Sequence[Mapping[str, float]], best: Mapping[str, float]) -> Figure:
    """Draw the parameters with the largest spread against each other."""
    shares = np.array([[_share(member, k) for k in PHYSICAL] for member in found])
    widest = np.argsort(-shares.std(axis=0))[:PAIRED_PARAMETERS]
    with drawing(9.0, 9.0) as figure:
        grid = figure.subplots(len(widest), len(widest), sharex='col')
        for i, down in enumerate(widest):
            for j, across in enumerate(widest):
                axes = grid[i, j]
                axes.set_xticks([])
                axes.set_yticks([])
                if i == j:
                    axes.hist(shares[:, down], color=BLUE, bins=8)
                else:
                    axes.plot(shares[:, across], shares[:, down], 'o', color=BLUE,
                              markersize=2.5)
                    axes.plot(_share(best, PHYSICAL[across]), _share(best, PHYSICAL[down]), 'x',
                              color=ORANGE)
                if i == len(widest) - 1:
                    axes.set_xlabel(FREE[PHYSICAL[across]].name.replace('.', '\n'), fontsize=6.0)
                if j == 0:
                    axes.set_ylabel(FREE[PHYSICAL[down]].name.replace('.', '\n'), fontsize=6.0)
    return figure
