"""
The classifier of the attribution by shape: logistic regression of the features of `shape.py`.

Its weights are in shape_weights.json, written by `python -m bench.train_attribution`.
"""

from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy import special

from asi_analysis.arrays import Array

WEIGHTS: Final = Path(__file__).with_name('shape_weights.json')
CAUSES: Final = ('stiction', 'backlash', 'hysteresis', 'saturation', 'tight_tuning',
                 'disturbance')
# Faults of the valve.
VALVE_FAULTS: Final = CAUSES[:3]
# Least probability at which the most probable cause is named as the cause.
LEAST_PROBABILITY: Final = 0.8


def expanded(features: Array, centre: Array, scale: Array) -> Array:
    """Return a constant, the standardised features, clipped to ±3, and their squares."""
    x = np.clip((np.atleast_2d(features) - centre) / scale, -3.0, 3.0)
    return np.hstack([np.ones((len(x), 1)), x, x * x])


def probabilities(features: Array, trained: dict[str, Any]) -> Array:
    """
    Return the probability of each of CAUSES, row by row.

    Outside the range of the training set they tend to equal probabilities.
    """
    centre, scale = np.array(trained['centre']), np.array(trained['scale'])
    scores = expanded(features, centre, scale) @ np.array(trained['weights'])
    classified = special.softmax(scores / trained['temperature'], axis=1)
    relative = np.clip((np.atleast_2d(features) - centre) / scale, -5.0, 5.0)
    size = np.linalg.norm(relative, axis=1, keepdims=True)
    outlying = np.clip(size / trained['usual_size'] - 1.0, 0.0, 1.0)
    return (1.0 - outlying) * classified + outlying / len(CAUSES)
