"""
Fit the constants of the weighing to blind cases whose answers are known.

    python -m asi_analysis.gap.check.tune DIRECTORY...

DIRECTORY is what `asi gap check DIRECTORY` has been through: its rows hold what every hypothesis
leaves, so that no fit is made again. The constants maximise the probability that the diagnosis
gives to the truth, in the mean of its logarithm, with a pull towards the ones in use: a calibrated
answer is one that could not say the truth with more confidence. Prints the old and the new score
and the constants, which a person then puts into verdict.py. Never on the seeds of a final check.
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
from asi_analysis.gap.diagnose import told
from asi_analysis.gap.inference.verdict import (
    CONSTANTS,
    Constants,
    Evidence,
    as_evidence,
    join_probabilities,
    probabilities,
)
from asi_analysis.gap.model.effects import UNKNOWN

LEAST = 1e-3    # probability that a truth is taken to have at least: one outlier is not all
PULL = 0.02     # of the constants in use, on one that changes by a factor of e


class Known(NamedTuple):
    """A case: what its hypotheses leave, group by group, and its answer."""

    evidence: tuple[Evidence, ...]
    kind: str
    truth: str
    effects: tuple[str, ...]


def read(folder: Path) -> list[Known]:
    """Return the cases of a directory that a check has been through."""
    answers = unseal(folder / 'answers.sealed')
    rows = [json.loads(line) for line in (folder / 'rows.jsonl').read_text().splitlines()]
    return [Known(tuple(map(as_evidence, row['evidence'])), answers[row['bag']]['kind'],
                  truth_of(answers[row['bag']]), tuple(sorted(answers[row['bag']]['effects'])))
            for row in rows if row.get('evidence') and row['bag'] in answers]


def of_truth(case: Known, constants: Constants) -> float:
    """Return the probability that the diagnosis gives to what is true of a case."""
    joined = join_probabilities([probabilities(e, constants) for e in case.evidence])
    chance = sum(p for names, p in joined.items()
                 if told(names) == case.truth or (case.kind == 'small' and names == case.effects)
                 or (case.kind == 'outside' and UNKNOWN in names))
    return max(chance, LEAST)


def score(cases: Sequence[Known], constants: Constants) -> float:
    """Return the mean log probability of the truth."""
    return float(np.mean([math.log(of_truth(case, constants)) for case in cases]))


def tuned(cases: Sequence[Known], start: Constants = CONSTANTS) -> Constants:
    """Return the constants that give the truth of the cases the highest probability."""
    signs = np.sign(start)
    used = np.log(np.abs(start))

    def constants_at(logs: np.ndarray) -> Constants:
        return Constants(*(float(value) for value in signs * np.exp(logs)))

    def loss(logs: np.ndarray) -> float:
        return -score(cases, constants_at(logs)) + PULL * float(np.sum((logs - used) ** 2))

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
