"""`InputError` and `InputWarning`: wrong or damaged input, which the user has to correct."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager


class InputError(ValueError):
    """
    A file, an option or a value that cannot be used.

    The text is one line: the file or field, what is wrong, what is allowed. Commands print it on
    stderr and end with status 2.
    """

    def __init__(self, text: str) -> None:
        """Take the text; what a library said in several lines becomes one."""
        super().__init__(' '.join(line.strip() for line in text.splitlines()))


class InputWarning(UserWarning):
    """A file is used in part only; its text is one line that says what is missing."""


@contextmanager
def input_warnings() -> Iterator[list[str]]:
    """Give a list that has, at the end, the texts of the InputWarnings within; all are shown."""
    texts: list[str] = []
    found: list[warnings.WarningMessage] = []
    try:
        with warnings.catch_warnings(record=True) as found:
            warnings.simplefilter('always', InputWarning)
            yield texts
    finally:
        texts += [str(each.message) for each in found if issubclass(each.category, InputWarning)]
        for each in found:
            warnings.warn_explicit(each.message, each.category, each.filename, each.lineno)
