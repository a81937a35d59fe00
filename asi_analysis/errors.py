"""`InputError` and `InputWarning`: wrong or damaged input, which the user has to correct."""


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
