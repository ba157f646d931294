"""An error in one line, as the command line and lists of failures show it."""


def error_line(error: BaseException) -> str:
    """What went wrong, in one line: the file and the system's reason, the message of an
    error of the input, or else the kind of the error and the start of its message."""
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename or 'file'}: {error.strerror}."
    text = " ".join(str(error).split())
    if isinstance(error, (OSError, ValueError)) and text:
        return text
    return f"{type(error).__name__}: {text[:300]}"
