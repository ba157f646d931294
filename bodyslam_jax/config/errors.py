"""The error of an input: a file, a folder, an option or an argument that is wrong."""


class InputError(ValueError):
    """What the user gave cannot be used; the message names it, in one line.

    The command line ends with exit code 1 for it, and with 70 for every error that
    nobody expected, so that no fault of the program is blamed on a file.

    Messages quote what files hold, which may be anything: each argument is one line of
    the message, without signs that no terminal should get, and of bounded length.
    """

    def __init__(self, *lines: object) -> None:
        self.lines = [_line(str(line)) for line in lines]
        """Each mistake, where there are several; the message has them in one line."""
        super().__init__(" ".join(self.lines))


_MAX_LETTERS = 1000
"""Of a line of a message; what it quotes is seldom a tenth of that."""


def _line(text: str) -> str:
    """The text in one line: signs that cannot be printed as Python writes them."""
    if not text.isprintable():
        text = "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)
    if len(text) > _MAX_LETTERS:
        half = _MAX_LETTERS // 2
        text = f"{text[:half]} ... {text[-half:]}"
    return text
