"""A figure and its change at twice the resolution."""

import math

from asi_analysis.paper.facts.converged import Converged, converged


def test_change_and_its_share():
    figure = converged(lambda refinement: {'x': 2.0 + 1.0 / refinement})['x']
    assert figure == Converged(3.0, 2.5)
    assert figure.change == -0.5 and figure.relative_change == 0.2


def test_infinite_figures():
    assert Converged(math.inf, math.inf).change == 0.0
    assert Converged(math.inf, math.inf).relative_change == 0.0
    assert Converged(1.0, math.inf).relative_change == math.inf
    assert Converged(0.0, 0.0).relative_change == 0.0
    assert Converged(1.0, 0.0).relative_change == math.inf
    assert math.isnan(Converged(math.nan, 1.0).change)
