"""
`python -m bench.train_attribution [COUNT]`: train the classifier of `asi attribute` for bags.

Writes shape_weights.json: trained on COUNT (200) loops of each cause from the family of models
'learn'. Loops of the family 'judge', which has other equations (`valve_loops.py`), are the
validation set: COUNT / 5 for the temperature of the probabilities, and COUNT / 5 for the accuracy.
"""

import json
import sys
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy import optimize, special

from asi_analysis.arrays import Array
from asi_analysis.errors import InputError
from asi_analysis.limit_cycle.attribution.classifier import (
    CAUSES,
    LEAST_PROBABILITY,
    VALVE_FAULTS,
    WEIGHTS,
    expanded,
    probabilities,
)
from asi_analysis.limit_cycle.attribution.shape import FEATURES, shape
from bench.valve_loops import loop

Causes = npt.NDArray[np.int64]

# Strength of the ridge penalty on the weights, in loops.
RIDGE: Final = 20.0
# Percentile of the distances of the training set from its centre; beyond it, an outlier.
USUAL: Final = 99.0


def examples(world: str, count: int, seed: int) -> tuple[Array, Causes]:
    """Return features (n x features) and causes (indices) of `count` loops of each cause."""
    rows, causes = [], []
    for number, cause in enumerate(CAUSES):
        random = np.random.default_rng([seed, number])
        accepted = 0
        while accepted < count:
            run = loop(cause, random, world)
            if run is None:
                continue
            assert run.command_n is not None and run.force_n is not None
            try:
                rows.append(shape(run.time_s, run.command_n, run.force_n).features)
            except InputError:
                continue
            causes.append(number)
            accepted += 1
    return np.array(rows), np.array(causes)


def train(features: Array, causes: Causes) -> dict[str, Any]:
    """Return centre, scale and weights of the logistic regression."""
    centre, scale = features.mean(0), features.std(0) + 1e-9
    x = expanded(features, centre, scale)
    truth = np.eye(len(CAUSES))[causes]

    def loss(flat: Array) -> tuple[float, Array]:
        weights = flat.reshape(x.shape[1], len(CAUSES))
        p = special.softmax(x @ weights, axis=1)
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


def temperature(features: Array, causes: Causes, trained: dict[str, Any]) -> float:
    """Return the divisor of the scores that calibrates the probabilities (temperature scaling)."""
    def loss(value: float) -> float:
        p = probabilities(features, trained | {'temperature': value})
        return -float(np.log(np.maximum(p[np.arange(len(p)), causes], 1e-12)).mean())

    return float(optimize.minimize_scalar(loss, bounds=(0.5, 5.0), method='bounded').x)


def validate(features: Array, causes: Causes, trained: dict[str, Any]) -> dict[str, Any]:
    """
    Return the accuracy of the most probable cause, and the calibration of its probability.

    Also the accuracy for the valve as a whole, because its faults are hard to distinguish.
    """
    p = probabilities(features, trained)
    best = p.argmax(1)
    sure = p.max(1) > LEAST_PROBABILITY
    confusion = np.zeros((len(CAUSES), len(CAUSES)), int)
    np.add.at(confusion, (causes, best), 1)
    valve = p[:, :len(VALVE_FAULTS)].sum(1)
    at_fault = causes < len(VALVE_FAULTS)
    blamed = valve > LEAST_PROBABILITY
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
    """Train, validate and write the weights."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    trained = train(*examples('learn', count, 1))
    validation_count = max(count // 5, 10)
    trained['temperature'] = temperature(*examples('judge', validation_count, 2), trained)
    trained['judged_on_others'] = validate(*examples('judge', validation_count, 3), trained)
    WEIGHTS.write_text(json.dumps(trained, indent=1) + '\n')
    print(json.dumps(trained['judged_on_others'], indent=1))


if __name__ == '__main__':
    main()
