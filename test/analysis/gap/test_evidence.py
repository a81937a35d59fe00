"""The volume of a posterior, against integrals over a grid."""

import itertools
import math
from types import SimpleNamespace

import numpy as np
import pytest

from asi_analysis.gap.inference.posterior import Best, Posterior
from asi_analysis.gap.inference.simulated.evidence import (
    _slopes_of_mass,
    log_volume,
    that_count,
)

UNIFORM = np.zeros(2)


def integral(square, slope, theta, points=500):
    """Return the log of the integral over two ranges from 0 to 1."""
    edges = np.concatenate([[0.0], np.geomspace(1e-7, 1.0, points)])
    axes = []
    for value in theta:   # fine about the most probable value
        axis = np.unique(np.clip(np.concatenate([value - edges, value + edges]), 0.0, 1.0))
        axes.append((0.5 * (axis[1:] + axis[:-1]), np.diff(axis)))
    x, y = (middle - value for (middle, _), value in zip(axes, theta, strict=True))
    cost = (slope[0] * x[:, None] + slope[1] * y[None]
            + 0.5 * (square[0, 0] * x[:, None] ** 2 + square[1, 1] * y[None] ** 2)
            + square[0, 1] * x[:, None] * y[None])
    return math.log(float(axes[0][1] @ np.exp(-cost) @ axes[1][1]))


@pytest.mark.parametrize('theta', [(0.4, 0.6), (0.0, 0.6), (0.4, 1.0), (0.0, 1.0)])
@pytest.mark.parametrize('slope', [0.0, 100.0, 1e5])
def test_volume_is_the_integral_of_uncorrelated_parameters(theta, slope):
    square, at = np.diag([1e4, 3e4]), np.array(theta)
    outward = slope * np.select([at == 0.0, at == 1.0], [1.0, -1.0], 0.0)
    ours = log_volume(square, outward, at, UNIFORM)
    assert ours == pytest.approx(integral(square, outward, at), abs=0.02)


def test_one_at_its_end_is_integrated_with_the_other_given():
    square = np.array([[1e4, 9e3], [9e3, 1e4]])
    for slope in (0.0, 50.0, 1e4):
        args = square, np.array([slope, 0.0]), np.array([0.0, 0.5])
        assert log_volume(*args, UNIFORM) == pytest.approx(integral(*args), abs=0.02)


@pytest.mark.parametrize('correlation', [0.5, 0.9, 0.999])
def test_two_at_their_ends_that_act_alike_have_at_most_this_volume(correlation):
    square = 1e4 * np.array([[1.0, correlation], [correlation, 1.0]])
    for slope in (0.0, 300.0, 1e4):
        args = square, np.full(2, slope), np.zeros(2)
        exact, ours = integral(*args), log_volume(*args, UNIFORM)
        assert exact - 0.02 < ours < exact + 1.0


def test_volume_is_finite_and_no_larger_than_the_range():
    sizes = (0.0, 1e-9, 1.0, 1e9, 1e16)
    for size, slope, theta in itertools.product(sizes, sizes, (0.0, 0.3)):
        square = np.full((2, 2), size)   # both act alike
        outward = np.array([slope, 0.0]) if theta == 0.0 else np.zeros(2)
        value = log_volume(square, outward, np.array([theta, 0.5]), UNIFORM)
        assert math.isfinite(value) and value < 1e-6


class _Rough(Posterior):
    """A correlated, perhaps curved residual, which jumps wherever a parameter moves."""

    def __init__(self, count, correlation, rough, curved, slope=100.0, samples=2000):
        noise = np.random.default_rng(0).standard_normal((samples, 2 * count + 1))
        axes, _ = np.linalg.qr(noise)
        self.slopes = slope * (math.sqrt(correlation) * axes[:, :1]
                               + math.sqrt(1.0 - correlation) * axes[:, 1:count + 1])
        self.bend = curved * axes[:, count + 1:]
        self.middle, self.slope, self.rough = np.full(count, 0.45), slope, rough
        self.free = tuple(SimpleNamespace(field=str(number)) for number in range(count))

    @property
    def prior(self):
        return self.middle, np.full(self.middle.size, 100.0)

    def record(self, theta):
        return theta

    def split(self, rows):
        return rows[None], rows[:0]

    def _residual_of(self, p):
        moved = self.slope * (p - self.middle)
        jump = np.random.default_rng(list((p * 1e7).astype(int))).standard_normal(len(self.slopes))
        return (self.slopes @ moved / self.slope + self.bend @ moved ** 2
                + self.rough * jump / math.sqrt(len(jump)))

    def volume(self, slopes):
        mean, precision = self.prior
        return log_volume(slopes.T @ slopes + np.diag(precision), np.zeros(mean.size), mean,
                          precision)


@pytest.mark.parametrize('count', [1, 6, 20])
@pytest.mark.parametrize('correlation', [0.0, 0.99, 0.9999])
@pytest.mark.parametrize(('rough', 'curved'), [(0.0, 0.0), (0.3, 0.0), (0.5, 0.0), (0.0, 0.1)])
def test_a_rough_cost_makes_no_parameter_sure(count, correlation, rough, curved):
    """As stick and slip does: the jumps are as large whatever the step, here up to 0.7 noises."""
    problem = _Rough(count, correlation, rough, curved)
    theta = problem.middle
    found = SimpleNamespace(problem=problem, best=Best(theta, 0.0, problem.residual(theta)))
    exact = problem.volume(problem.slopes)
    assert problem.volume(_slopes_of_mass(found, np.ones(1))) == pytest.approx(exact, abs=0.5)
    if rough:   # usual differences see the jumps alone
        assert problem.volume(problem.jacobian(theta)) < exact - 3.0 * count


class _Bounded(_Rough):
    """One that overflows where the first parameter is more than a little larger."""

    def _residual_of(self, p):
        return super()._residual_of(p) * (math.inf if p[0] > 0.5 else 1.0)


@pytest.mark.parametrize('slope', [100.0, 10.0])
def test_where_no_plant_is_possible_the_volume_is_that_of_narrow_differences(slope):
    """Further away than the prior allows, or within it."""
    problem = _Bounded(3, 0.9, 0.0, 0.0, slope)
    theta = problem.middle
    found = SimpleNamespace(problem=problem, best=Best(theta, 0.0, problem.residual(theta)))
    exact = problem.volume(problem.slopes)
    with np.errstate(invalid='ignore'):
        assert problem.volume(_slopes_of_mass(found, np.ones(1))) == pytest.approx(exact, abs=0.1)


def test_a_hypothesis_with_few_parameters_counts_by_its_volume():
    """Its volume is larger. Of what cannot reach it, none is computed."""
    known = {'single': (0.0, -100.0, 10), 'pair': (14.0, -122.0, 15), 'none': (-30.0, -95.0, 9),
             'worse pair': (-2.0, -123.0, 15), 'hopeless': (-20.0, -121.0, 15)}
    found = [SimpleNamespace(name=name, best=SimpleNamespace(theta=np.zeros(size)))
             for name, (_, _, size) in known.items()]
    counted = {each.name: weight for each, weight in that_count(
        found, lambda each: known[each.name][0], lambda each: known[each.name][1])}
    assert counted == {'none': -125.0, 'pair': -108.0, 'single': -100.0, 'worse pair': -125.0}
