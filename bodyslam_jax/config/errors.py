"""The error that is raised for invalid files, folders, options and arguments."""


class InputError(ValueError):
    """An input of the user cannot be used; the message names it, in one line.

    The command line ends with exit code 1 for this error, and with 70 for every
    unexpected one, so that no fault of the program is attributed to a file.

    Messages quote the content of files, which is arbitrary: each argument is converted
    to one line of bounded length, with control characters escaped.
    """

    def __init__(self, *lines: object) -> None:
        self.lines = [_line(str(line)) for line in lines]
        """One line per mistake; the message joins them in one line."""
        super().__init__(" ".join(self.lines))


_MAX_LINE_LENGTH = 1000
"""Largest length of a line of a message; most quotations have less than a tenth."""


def _line(text: str) -> str:
    """Converts a text to one line, with characters that cannot be printed escaped."""
    if not text.isprintable():
        text = "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)
    if len(text) > _MAX_LINE_LENGTH:
        half = _MAX_LINE_LENGTH // 2
        text = f"{text[:half]} ... {text[-half:]}"
    return text
