"""
`python -m torture.guided FOLDER SECONDS`: coverage-guided fuzzing of the file readers.

Atheris (libFuzzer; `pip install atheris`) changes the files of the corpus, keeps in FOLDER what
reaches a new branch of a reader, and ends at the first traceback, with the input beside it. `make
torture` tries damage at random; this finds inputs that need several specific changes together.
"""

import sys
import tempfile
import warnings
from pathlib import Path
from typing import Final

import atheris

# Modules without compiled functions: numba cannot compile code that counts its branches.
READERS: Final = ('asi_analysis.bags.exchange', 'asi_analysis.bags.bag',
                  'asi_analysis.bags.information', 'asi_analysis.bags.topic_messages',
                  'asi_common.parameter_file', 'mcap', 'rosbags')
COMPILED: Final = ('asi_analysis.bags.bag_file', 'asi_analysis.bags.encoding')
KINDS: Final = ('.csv', '.txt', '.json', '.jsonl', '.npz', '.parquet', '.mcap', '.yaml', '.db3',
                '.csv.gz')
LARGEST: Final = 60_000     # bytes of an input
TEXT: Final = 30_000        # bytes of an undamaged text file: many lines of one form

with atheris.instrument_imports(include=list(READERS), exclude=list(COMPILED)):
    from torture.inputs import KEPT, corpus, read

from asi_analysis.errors import InputError  # noqa: E402
from asi_common.parameter import ParameterError  # noqa: E402


def seeds(folder: Path) -> None:
    """Write a good file of each kind, and those kept, after a byte that says the kind."""
    with tempfile.TemporaryDirectory() as good:
        for path in [*corpus(Path(good)), *(each for each in KEPT.iterdir() if each.is_file())]:
            kind = next((kind for kind in reversed(KINDS) if path.name.endswith(kind)), None)
            data = path.read_bytes()
            if kind in ('.csv', '.txt', '.json', '.jsonl'):
                data = data[:TEXT]
            if kind:
                (folder / path.name).write_bytes(bytes([KINDS.index(kind)]) + data)


def main() -> None:
    """Try inputs for so long."""
    folder, seconds = Path(sys.argv[1]), sys.argv[2]
    folder.mkdir(parents=True, exist_ok=True)
    seeds(folder)
    place = Path(tempfile.mkdtemp())

    def one(data: bytes) -> None:
        path = place / f'file{KINDS[data[0] % len(KINDS)] if data else KINDS[0]}'
        path.write_bytes(data[1:])
        try:
            read(path)
        except (InputError, ParameterError, OSError) as error:
            assert '\n' not in str(error), 'the refusal has several lines'

    warnings.simplefilter('ignore')
    atheris.Setup([sys.argv[0], str(folder), f'-max_total_time={seconds}', '-timeout=60',
                   '-rss_limit_mb=1000', f'-max_len={LARGEST}'], one)
    atheris.Fuzz()


if __name__ == '__main__':
    main()
