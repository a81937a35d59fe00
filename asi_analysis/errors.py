"""The one error that the user, not the program, has to mend."""


class InputError(ValueError):
    """
    A file, an option or a value that cannot be used.

    Its text is one line that names the file or field, what is wrong and what is allowed. The
    commands print it on stderr and end with status 2.
    """


class InputWarning(UserWarning):
    """A file could be used only in part; its text is one line that says what is missing."""
