"""Unexpected errors are reported in one line, with the details in a file."""

import contextlib
import platform
import shlex
import sys
import tempfile
import traceback
from collections.abc import Iterator
from pathlib import Path

import bodyslam_jax
from bodyslam_jax.config.errors import InputError

EXIT_CODE = 70
"""`EX_SOFTWARE` of BSD's sysexits.h: an internal error."""
FILE = "error.txt"
"""Name of the file with the details, in the run folder."""
_MEMORY = ("RESOURCE_EXHAUSTED", "out of memory", "Unable to allocate")


class Unexpected(Exception):
    """An error that no reader and no check has foreseen, with details in a file."""

    def __init__(self, error: BaseException, details: Path) -> None:
        super().__init__(str(error))
        self.error, self.details = error, details


def is_input(error: BaseException) -> bool:
    """Returns True if an error is one of the input: of a file, a folder or an option.

    Errors of the operating system are, if they name a file.
    """
    if isinstance(error, OSError):
        return error.filename is not None
    return isinstance(error, InputError)


@contextlib.contextmanager
def noted_in(folder: Path) -> Iterator[None]:
    """Writes the details of unexpected errors of the block into a run folder.

    **Raises:** `Unexpected` in place of such an error.
    """
    try:
        yield
    except Exception as error:
        if is_input(error):
            raise
        raise Unexpected(error, write_details(error, folder)) from error


def write_details(error: BaseException, folder: Path | None = None) -> Path:
    """Writes command, versions and traceback into the folder, or where that cannot be
    written, into a file for temporary ones; returns the file."""
    lines = [
        shlex.join(sys.argv),
        f"bodyslam-jax {bodyslam_jax.__version__}, Python {platform.python_version()}, "
        f"{platform.platform()}",
        "",
        *traceback.format_exception(error),
    ]
    text = "\n".join(lines).encode("utf-8", "backslashreplace")
    if folder is not None and folder.is_dir():
        with contextlib.suppress(OSError):
            (folder / FILE).write_bytes(text)
            return folder / FILE
    with tempfile.NamedTemporaryFile(
        prefix="bodyslam-error-", suffix=".txt", delete=False
    ) as file:
        file.write(text)
    return Path(file.name)


def line(error: BaseException) -> str:
    """Returns the line that reports an unexpected error."""
    from bodyslam_jax.config.errors import error_line

    details = error.details if isinstance(error, Unexpected) else write_details(error)
    cause = error.error if isinstance(error, Unexpected) else error
    found = error_line(cause).rstrip(".")
    if isinstance(cause, MemoryError) or any(word in str(cause) for word in _MEMORY):
        return (
            f"out of memory ({found}): give fewer frames (--start, --end) or people "
            f"(--person); details are in {details}"
        )
    return (
        f"an error that nobody expected ({type(cause).__name__}: "
        f"{found.removeprefix(f'{type(cause).__name__}: ')}): please report it with "
        f"{details}"
    )
