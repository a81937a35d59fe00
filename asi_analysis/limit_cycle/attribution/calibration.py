"""
The weights of the attribution by shape, from simulated loops, and how well they do on others.

`python -m asi_analysis.limit_cycle.attribution.calibration COUNT` makes shape_weights.json anew:
COUNT loops of each cause of the world 'learn' to learn from; of the world 'judge', whose equations
are others (`loops.py`), a fifth as many to find out how much less sure to be, and a fifth to
judge by.
"""

import json
import sys
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy import optimize

from asi_analysis.errors import InputError
from asi_analysis.limit_cycle.attribution.loops import CAUSES, VALVE_FAULTS, loop
from asi_analysis.limit_cycle.attribution.shape import FEATURES, shape

Array = npt.NDArray[np.float64]
Causes = npt.NDArray[np.int64]

WEIGHTS: Final = Path(__file__).with_name('shape_weights.json')
# Strength of the prior that keeps weights small, in loops.
RIDGE: Final = 20.0
# Percentile of the distance from the centre of all examples beyond which a record is strange.
USUAL: Final = 99.0
SURE: Final = 0.8


def examples(world: str, count: int, seed: int) -> tuple[Array, Causes]:
    """Return features (n x features) and causes (indices) of `count` loops of each cause."""
    rows, causes = [], []
    for number, cause in enumerate(CAUSES):
        random = np.random.default_rng([seed, number])
        made = 0
        while made < count:
            run = loop(cause, random, world)
            if run is None:
                continue
            assert run.command_n is not None and run.force_n is not None
            try:
                rows.append(shape(run.time_s, run.command_n, run.force_n).features)
            except InputError:
                continue
            causes.append(number)
            made += 1
    return np.array(rows), np.array(causes)


def expanded(features: Array, centre: Array, scale: Array) -> Array:
    """Return standardised features, their squares and a constant; outliers are drawn in."""
    x = np.clip((np.atleast_2d(features) - centre) / scale, -3.0, 3.0)
    return np.hstack([np.ones((len(x), 1)), x, x * x])


def softmax(scores: Array) -> Array:
    """Return probabilities (rows add up to 1)."""
    relative = np.exp(scores - scores.max(1, keepdims=True))
    return relative / relative.sum(1, keepdims=True)


def learn(features: Array, causes: Causes) -> dict[str, Any]:
    """Return centre, scale and weights of the logistic regression."""
    centre, scale = features.mean(0), features.std(0) + 1e-9
    x = expanded(features, centre, scale)
    truth = np.eye(len(CAUSES))[causes]

    def loss(flat: Array) -> tuple[float, Array]:
        weights = flat.reshape(x.shape[1], len(CAUSES))
        p = softmax(x @ weights)
        value = -np.log(np.maximum((p * truth).sum(1), 1e-12)).sum()
        value += 0.5 * RIDGE * (weights[1:] ** 2).sum()
        slope = x.T @ (p - truth)
        slope[1:] += RIDGE * weights[1:]
        return float(value), slope.ravel()

    found = optimize.minimize(loss, np.zeros(x.shape[1] * len(CAUSES)), jac=True,
                              method='L-BFGS-B', options={'maxiter': 2000})
    relative = np.clip((features - centre) / scale, -5.0, 5.0)
    return {'features': list(FEATURES), 'causes': list(CAUSES), 'centre': centre.tolist(),
            'scale': scale.tolist(), 'temperature': 1.0,
            'usual_size': float(np.percentile(np.linalg.norm(relative, axis=1), USUAL)),
            'weights': found.x.reshape(x.shape[1], len(CAUSES)).tolist()}


def temperature(features: Array, causes: Causes, learnt: dict[str, Any]) -> float:
    """Return by how much to divide the scores, so that probabilities mean what they say."""
    def loss(value: float) -> float:
        p = probabilities(features, learnt | {'temperature': value})
        return -float(np.log(np.maximum(p[np.arange(len(p)), causes], 1e-12)).mean())

    return float(optimize.minimize_scalar(loss, bounds=(0.5, 5.0), method='bounded').x)


def probabilities(features: Array, learnt: dict[str, Any]) -> Array:
    """
    Return the probability of each of CAUSES, row by row.

    The further a record is from all that was learnt from, the more even they become.
    """
    centre, scale = np.array(learnt['centre']), np.array(learnt['scale'])
    scores = expanded(features, centre, scale) @ np.array(learnt['weights'])
    known = softmax(scores / learnt['temperature'])
    relative = np.clip((np.atleast_2d(features) - centre) / scale, -5.0, 5.0)
    size = np.linalg.norm(relative, axis=1, keepdims=True)
    strange = np.clip(size / learnt['usual_size'] - 1.0, 0.0, 1.0)
    return (1.0 - strange) * known + strange / len(CAUSES)


def judged(features: Array, causes: Causes, learnt: dict[str, Any]) -> dict[str, Any]:
    """
    Return how often the most probable cause is right, and what stated probabilities mean.

    Beside that, how often the valve as a whole is rightly blamed: its faults are hard to tell
    apart.
    """
    p = probabilities(features, learnt)
    best = p.argmax(1)
    sure = p.max(1) > SURE
    confusion = np.zeros((len(CAUSES), len(CAUSES)), int)
    np.add.at(confusion, (causes, best), 1)
    valve = p[:, :len(VALVE_FAULTS)].sum(1)
    at_fault = causes < len(VALVE_FAULTS)
    blamed = valve > SURE
    return {'right': float((best == causes).mean()), 'sure': float(sure.mean()),
            'right_when_sure': _mean((best == causes)[sure]),
            'mean_probability': float(p.max(1).mean()),
            'mean_probability_when_sure': _mean(p.max(1)[sure]),
            'valve_right': float(((valve > 0.5) == at_fault).mean()),
            'valve_blamed': _mean(blamed[at_fault]), 'right_when_blamed': _mean(at_fault[blamed]),
            'confusion': confusion.tolist()}


def _mean(values: npt.NDArray[Any]) -> float | None:
    return float(values.mean()) if len(values) else None


def main() -> None:
    """Learn, judge, write."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    learnt = learn(*examples('learn', count, 1))
    judged_count = max(count // 5, 10)
    learnt['temperature'] = temperature(*examples('judge', judged_count, 2), learnt)
    learnt['judged_on_others'] = judged(*examples('judge', judged_count, 3), learnt)
    WEIGHTS.write_text(json.dumps(learnt, indent=1) + '\n')
    print(json.dumps(learnt['judged_on_others'], indent=1))


if __name__ == '__main__':
    main()
