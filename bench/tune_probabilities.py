"""
Fit the constants of the gap diagnosis's probabilities to blind cases with known answers.

    python -m bench.tune_probabilities DIRECTORY...

DIRECTORY was checked by `asi gap check DIRECTORY`: its rows.jsonl holds the residuals of every
hypothesis, so no fit is repeated. The constants maximise the mean log probability of the true
hypothesis, with a penalty on their distance from those in use. Prints the old and the new score
and the constants, to be copied into probability.py. Do not use the seeds of a final check.
"""

import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from asi_analysis.gap.check.check import truth_of, unseal
from asi_analysis.gap.document import hypothesis_name
from asi_analysis.gap.inference.probability import (
    CONSTANTS,
    Constants,
    Evidence,
    as_evidence,
    join_probabilities,
    probabilities,
)
from asi_analysis.gap.model.effects import UNKNOWN

LEAST = 1e-3    # lower limit of the probability of the true hypothesis: bounds outliers
PENALTY = 0.02  # for a constant that changes by a factor of e


class Known(NamedTuple):
    """A case: the evidence of each group of channels, and its answer."""

    evidence: tuple[Evidence, ...]
    kind: str
    truth: str
    effects: tuple[str, ...]


def read(folder: Path) -> list[Known]:
    """Return the cases of a directory that was checked."""
    answers = unseal(folder / 'answers.sealed')
    rows = [json.loads(line) for line in (folder / 'rows.jsonl').read_text().splitlines()]
    return [Known(tuple(map(as_evidence, row['evidence'])), answers[row['bag']]['kind'],
                  truth_of(answers[row['bag']]), tuple(sorted(answers[row['bag']]['effects'])))
            for row in rows if row.get('evidence') and row['bag'] in answers]


def truth_probability(case: Known, constants: Constants) -> float:
    """Return the probability that the diagnosis gives to the truth of a case."""
    joined = join_probabilities([probabilities(e, constants) for e in case.evidence])
    chance = sum(p for names, p in joined.items()
                 if hypothesis_name(names) == case.truth
                 or (case.kind == 'small' and names == case.effects)
                 or (case.kind == 'outside' and UNKNOWN in names))
    return max(chance, LEAST)


def score(cases: Sequence[Known], constants: Constants) -> float:
    """Return the mean log probability of the truth."""
    return float(np.mean([math.log(truth_probability(case, constants)) for case in cases]))


def tuned(cases: Sequence[Known], start: Constants = CONSTANTS) -> Constants:
    """Return the constants with the highest penalised mean log probability of the truth."""
    signs = np.sign(start)
    used = np.log(np.abs(start))

    def constants_at(logs: np.ndarray) -> Constants:
        return Constants(*(float(value) for value in signs * np.exp(logs)))

    def loss(logs: np.ndarray) -> float:
        return -score(cases, constants_at(logs)) + PENALTY * float(np.sum((logs - used) ** 2))

    found = minimize(loss, used, method='Powell', options={'maxfev': 600, 'xtol': 0.02})
    return constants_at(found.x)


def main() -> None:
    """Print the constants that fit the directories given."""
    cases = [case for folder in sys.argv[1:] for case in read(Path(folder))]
    best = tuned(cases)
    print(f'{len(cases)} cases; mean log probability of the truth: in use '
          f'{score(cases, CONSTANTS):.3f}, tuned {score(cases, best):.3f}')
    for name, value in best._asdict().items():
        print(f'    {name}: float = {value:.3g}')


if __name__ == '__main__':
    main()
