"""
`python -m bench.public_recordings DIRECTORY`: recordings by others, of known cause, diagnosed.

`bench/public_recordings.toml` lists them. --links prints how to fetch them into DIRECTORY.
Each is checked against its checksum, imported and diagnosed by the `asi` command itself, in a
folder of its own, which --keep keeps; the table of the answers is printed.
"""

import argparse
import hashlib
import json
import shlex
import subprocess
import sys
import tempfile
import time
import tomllib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple
from urllib.parse import quote

import numpy as np

LIST: Final = Path(__file__).with_suffix('.toml')
CONFIDENT: Final = 0.9
NONE: Final = ('no_gap', 'unknown')
REFUSED: Final = 'refused'


class Answer(NamedTuple):
    """What the diagnosis says: verdict, its probability, what it may also be, and the notes."""

    verdict: str
    probability: float
    ambiguity: Sequence[str] = ()
    notes: str = ''


class FaultyError(Exception):
    """A recording is absent, another than the listed one, or a command ended in a traceback."""


def rigs() -> list[dict[str, Any]]:
    """Return the list of the recordings."""
    listed: list[dict[str, Any]] = tomllib.loads(LIST.read_text())['rig']
    return listed


def folder_of(rig: Mapping[str, Any]) -> str:
    """Return the folder of a rig's files below the directory of the data."""
    return str(rig.get('folder', rig['repository'].replace('/', '+')))


def links(directory: str) -> Iterator[str]:
    """Yield a command for each file that fetches it, or says where it is."""
    seen = set()
    for rig in rigs():
        for name in rig['files']:
            target = f'{directory}/{folder_of(rig)}/{name}'
            if target in seen:
                continue
            seen.add(target)
            if 'commit' in rig:
                url = (f'https://raw.githubusercontent.com/{rig["repository"]}/{rig["commit"]}/'
                       f'{quote(name)}')
                yield f'curl --fail --create-dirs -o {shlex.quote(target)} {url}'
            else:
                yield f'# {target}: from {rig["repository"]}'


def checked(directory: Path, rig: Mapping[str, Any]) -> dict[str, Path]:
    """Return the files of a rig by name; raise FaultyError if one is absent or another one."""
    files = {}
    for name, expected in rig['files'].items():
        path = directory / folder_of(rig) / name
        if not path.exists():
            raise FaultyError(f'{path}: not there (--links says how to fetch it)')
        found = hashlib.sha256(path.read_bytes()).hexdigest()
        if found != expected:
            raise FaultyError(f'{path}: SHA-256 {found}, not the {expected} of the list')
        files[name] = path
    return files


def with_difference(path: Path, names: Sequence[str], folder: Path) -> Path:
    """Return a copy of a comma-separated file with one more column: the first minus the second."""
    first, second, result = names
    table = np.genfromtxt(path, delimiter=',', names=True)
    columns = [*(table.dtype.names or ())]
    values = np.column_stack([*(table[name] for name in columns), table[first] - table[second]])
    out = folder / path.name
    np.savetxt(out, values, '%.9g', ',', header=','.join([*columns, result]), comments='')
    return out


def asi(arguments: Sequence[str], folder: Path) -> subprocess.CompletedProcess[str]:
    """Run the command; raise FaultyError if it ended in a traceback."""
    done = subprocess.run([sys.executable, '-m', 'asi_analysis.cli', *arguments], cwd=folder,
                          capture_output=True, text=True, check=False)
    if 'Traceback' in done.stderr or done.returncode not in (0, 1, 2):
        raise FaultyError(f'asi {shlex.join(arguments)}: {done.stderr[-2000:]}')
    return done


def error_line(done: subprocess.CompletedProcess[str]) -> str:
    """Return the last line of the error output."""
    return done.stderr.strip().splitlines()[-1] if done.stderr.strip() else ''


def diagnosed(directory: Path, rig: Mapping[str, Any], folder: Path) -> Answer:
    """Return the answer about one rig, from the `asi` command."""
    files = {name: path.resolve() for name, path in checked(directory, rig).items()}
    if 'difference' in rig:
        files = {name: with_difference(path, rig['difference'], folder)
                 for name, path in files.items()}
    for bag, arguments in rig['import'].items():
        words = [str(files.get(word, word)) for word in shlex.split(arguments)]
        done = asi(['import', *words, '--out', bag], folder)
        if done.returncode:
            return Answer(REFUSED, 0.0, notes=error_line(done))
    done = asi(['gap', *shlex.split(rig['gap']), '--json'], folder)
    if done.returncode == 2:
        return Answer(REFUSED, 0.0, notes=error_line(done))
    found = json.loads(done.stdout)
    (folder / 'answer.json').write_text(done.stdout)
    return Answer(found['verdict'], found['probability'], found['ambiguity_set'],
                  ' · '.join(found['notes']))


def judged(rig: Mapping[str, Any], answer: Answer) -> str:
    """
    Return how good an answer is: right, undecided, wrong, or wrong with 0.9 or more.

    Right: it names at least one known effect, and nothing that is not known. Undecided: "unknown",
    a refusal, or a probability below 0.9 with a known effect among what it may also be.
    """
    names = set(answer.verdict.split('+'))
    known = set(rig['right'])
    if answer.verdict == REFUSED:
        return 'undecided'
    if names & known and names <= known | set(rig['also']):
        return 'right' if rig.get('note', '') in answer.notes else 'undecided'
    if answer.verdict == 'unknown':
        return 'undecided'
    if answer.probability >= CONFIDENT:
        return 'wrong with 0.9'
    possible = {name for one in answer.ambiguity for name in one.split('+')}
    return 'undecided' if possible & (known | {'unknown'}) else 'wrong'


def main() -> None:
    """Print the table, and how many answers are right, undecided and wrong; 1 if any failed."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('directory', help='where the fetched recordings are')
    parser.add_argument('--links', action='store_true', help='print how to fetch them')
    parser.add_argument('--half', choices=('first', 'second', 'later'), help='only these')
    parser.add_argument('--only', metavar='WORD', help='only rigs with this in their name')
    parser.add_argument('--keep', type=Path, metavar='FOLDER', help='where bags and answers stay')
    arguments = parser.parse_args()
    if arguments.links:
        print('\n'.join(links(arguments.directory)))
        return
    chosen = [rig for rig in rigs() if rig['half'] == (arguments.half or rig['half'])
              and (arguments.only or '') in rig['name']]
    if not chosen:
        parser.error(f'no rig of that half has {arguments.only!r} in its name')
    for rig in chosen if arguments.keep else ():
        if (kept := arguments.keep / rig['name'].replace(' ', '_')).exists():
            parser.error(f'{kept} exists: name another folder to --keep')
    counts: Counter[tuple[str, str]] = Counter()
    print('| half | rig | known cause | answer | probability | |\n|---|---|---|---|---|---|')
    for number, rig in enumerate(chosen, 1):
        print(f'{number} of {len(chosen)}: {rig["name"]}', file=sys.stderr, flush=True)
        begin = time.perf_counter()
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary)
            if arguments.keep:
                folder = arguments.keep.resolve() / rig['name'].replace(' ', '_')
                folder.mkdir(parents=True)
            try:
                answer = diagnosed(Path(arguments.directory), rig, folder)
                judgement = judged(rig, answer)
            except FaultyError as error:
                answer, judgement = Answer('', 0.0, notes=str(error)), 'failed'
        counts[rig['half'], judgement] += 1
        print(f'| {rig["half"]} | {rig["name"]} | {rig["cause"]} | {answer.verdict} | '
              f'{answer.probability:.2f} | {judgement} |', flush=True)
        print(f'{rig["name"]}: {time.perf_counter() - begin:.0f} s; {answer.ambiguity}; '
              f'{answer.notes}', file=sys.stderr, flush=True)
    for (half, judgement), count in sorted(counts.items()):
        print(f'{half} half: {judgement} {count}')
    if any(judgement == 'failed' for _, judgement in counts):
        sys.exit(1)


if __name__ == '__main__':
    main()
