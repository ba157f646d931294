"""An error in one line, as the command line and lists of failures show it."""


def error_line(error: BaseException) -> str:
    """Returns an error in one line: the file and the system's reason, the message of an
    error of the input, or else the kind of the error and the start of its message."""
    if isinstance(error, OSError) and error.strerror:
        return _printable(f"{error.filename or 'file'}: {error.strerror}.")
    text = _printable(str(error))
    if isinstance(error, (OSError, ValueError)) and text:
        return text
    return f"{type(error).__name__}: {text[:300]}"


def _printable(text: str) -> str:
    """Returns the text in one line, without characters that terminals or files
    refuse."""
    line = " ".join(text.encode("utf-8", "backslashreplace").decode().split())
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in line)
