"""The error of an input: a file, a folder, an option or an argument that is wrong."""


class InputError(ValueError):
    """What the user gave cannot be used; the message names it, in one line.

    The command line ends with exit code 1 for it, and with 70 for every error that
    nobody expected, so that no fault of the program is blamed on a file.
    """
