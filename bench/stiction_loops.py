"""
`python -m bench.stiction_loops DIRECTORY`: fourteen loops with a known cause, attributed.

The loops are of the International Stiction Data Base (Jelali and Huang, Detection and Diagnosis of
Stiction in Control Loops, 2010), as github nPoKhappy/control-valve-stiction-implementation has
them: several loops one after another in a file. --links prints how to fetch them. Each is
attributed whole, in halves, and without a tenth at either end; stiction is named if it is the most
probable cause.
"""

import argparse
import hashlib
import shlex
import warnings
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError
from asi_analysis.limit_cycle.attribution.recording import attribute_cycle
from asi_analysis.limit_cycle.detection.agreement import judge_run

REPOSITORY: Final = 'nPoKhappy/control-valve-stiction-implementation'
COMMIT: Final = '7e03a4e3600a2debd9ac093b85ebb672d6b12b03'
FOLDER: Final = 'new_project/csv/final'
STICTION: Final = 'stiction'
CONFIDENT: Final = 0.9
# SHA-256 of the files of command and output.
FILES: Final = {
    '12_2_23_29': ('4745ee39d7cb71ed1fd9569885b389d8d8225ecaeec3b52518d1f91df28a52d7',
                   'cbe27de4f511e7e40851cf67ed98e3c8c5cd12bf918ea5587f16e45ee9be179b'),
    '13_11_1_10_24': ('fdc19b5b4f89eb2451b9cb2e87c2fa8f29c357a8a9b49723c131b0b36c7e1091',
                      '3d397821f0d3209e95085a9111a4aacd8425cf98772ce900080f8d973da18d20'),
    'pulp_4_7_9_2_5': ('0f4e964bb1b0ff80a2dd4e135b945395759089913df65fd38150cd2fe7d0cf1e',
                       '57a6b320d831510d68a4e6a3a2baf379e878ecadc425f3c57236983fbda4e334')}


class Loop(NamedTuple):
    """A loop: name, file, its first sample and the one after its last, and its stated cause."""

    name: str
    file: str
    first: int
    last: int
    cause: str


LOOPS: Final = (
    Loop('chemical 1', '13_11_1_10_24', 2500, 4125, STICTION),
    Loop('chemical 2', '12_2_23_29', 2000, 3000, STICTION),
    Loop('chemical 10', '13_11_1_10_24', 4125, 5125, STICTION),
    Loop('chemical 11', '13_11_1_10_24', 1500, 2500, STICTION),
    Loop('chemical 12', '12_2_23_29', 0, 2000, STICTION),
    Loop('chemical 13', '13_11_1_10_24', 0, 1500, 'faulty sensor'),
    Loop('chemical 23', '12_2_23_29', 3000, 4500, STICTION),
    Loop('chemical 24', '13_11_1_10_24', 5125, 6625, STICTION),
    Loop('chemical 29', '12_2_23_29', 4500, 11701, STICTION),
    Loop('paper 2', 'pulp_4_7_9_2_5', 17097, 18293, STICTION),
    Loop('paper 4', 'pulp_4_7_9_2_5', 0, 1196, 'dead zone and tuning'),
    Loop('paper 5', 'pulp_4_7_9_2_5', 18293, 36293, STICTION),
    Loop('paper 7', 'pulp_4_7_9_2_5', 1196, 15297, 'disturbance'),
    Loop('paper 9', 'pulp_4_7_9_2_5', 15297, 17097, 'no stiction'))
CUTS: Final = {'whole': (0.0, 1.0), 'first half': (0.0, 0.5), 'second half': (0.5, 1.0),
               'without the first tenth': (0.1, 1.0), 'without the last tenth': (0.0, 0.9)}


def links(directory: str) -> Iterator[str]:
    """Yield a command for each file that fetches it."""
    for name in FILES:
        for kind in ('op', 'pv'):
            path = f'{FOLDER}/{name}_{kind}.csv'
            target = shlex.quote(f'{directory}/{REPOSITORY.replace("/", "+")}/{path}')
            yield (f'curl --fail --create-dirs -o {target} '
                   f'https://raw.githubusercontent.com/{REPOSITORY}/{COMMIT}/{path}')


def read(directory: Path) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return command and output of each file; exit if one is absent or another one."""
    found = {}
    for name, sums in FILES.items():
        signals = []
        for kind, expected in zip(('op', 'pv'), sums, strict=True):
            path = directory / REPOSITORY.replace('/', '+') / FOLDER / f'{name}_{kind}.csv'
            if hashlib.sha256(path.read_bytes()).hexdigest() != expected:
                raise SystemExit(f'{path}: not the file of the list')
            signals.append(np.loadtxt(path))
        found[name] = (signals[0], signals[1])
    return found


def cause_of(run: Run) -> tuple[str, float, float]:
    """Return the most probable cause and its probability, and the probability of stiction."""
    try:
        causes = attribute_cycle(run)['causes']
    except InputError:
        return 'refused', 0.0, 0.0
    chance = {each['nonlinearity']: each['probability'] for each in causes}
    most = max(chance, key=lambda cause: chance[cause])
    return most, chance[most], chance.get(STICTION, 0.0)


def verdict_of(run: Run) -> str:
    """Return the verdict of `asi limit-cycle` on the longest segment, with its confidence."""
    try:
        segment = max(judge_run(run), key=lambda each: each.end_s - each.start_s)
    except InputError:
        return 'refused'
    return f'{segment.verdict} {segment.confidence:.2f}'


def main() -> None:
    """Print a table of the loops, and precision, recall and F1 of stiction for each cut."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('directory', help='where the fetched files are')
    parser.add_argument('--links', action='store_true', help='print how to fetch them')
    arguments = parser.parse_args()
    if arguments.links:
        print('\n'.join(links(arguments.directory)))
        return
    warnings.simplefilter('ignore')
    signals = read(Path(arguments.directory))
    answers: dict[str, list[tuple[str, str, float, float]]] = defaultdict(list)
    print(f'| loop | stated cause | asi limit-cycle | {" | ".join(CUTS)} |')
    print('|---' * (3 + len(CUTS)) + '|')
    for loop in LOOPS:
        command, output = (values[loop.first:loop.last] for values in signals[loop.file])
        run = Run(np.arange(command.size, dtype=float), command_n=command, force_n=output,
                  source=loop.name)
        cells = []
        for cut, (begin, end) in CUTS.items():
            part = run[int(begin * command.size):int(end * command.size)]
            most, chance, stiction = cause_of(part)
            answers[cut].append((loop.cause, most, chance, stiction))
            cells.append(f'{most} {chance:.2f}')
        print(f'| {loop.name} | {loop.cause} | {verdict_of(run)} | {" | ".join(cells)} |',
              flush=True)
    print('\n| cut | F1 | precision | recall | stated probability of stiction, mean (loops with '
          'it, without) | wrong with 0.9 |\n|---|---|---|---|---|---|')
    for cut, given in answers.items():
        named = [cause == STICTION for _, cause, _, _ in given]
        true = [stated == STICTION for stated, _, _, _ in given]
        hits = sum(a and b for a, b in zip(named, true, strict=True))
        precision, recall = hits / max(sum(named), 1), hits / sum(true)
        sure = sum(chance >= CONFIDENT and (cause == STICTION) != (stated == STICTION)
                   for stated, cause, chance, _ in given)
        means = [np.mean([s for t, (_, _, _, s) in zip(true, given, strict=True) if t is want])
                 for want in (True, False)]
        print(f'| {cut} | {2 * hits / max(sum(named) + sum(true), 1):.2f} | {precision:.2f} | '
              f'{recall:.2f} | {means[0]:.2f}, {means[1]:.2f} | {sure} |')


if __name__ == '__main__':
    main()
