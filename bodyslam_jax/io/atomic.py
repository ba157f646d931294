"""Files are written whole or not at all.

What is written goes to a hidden sibling first, which then takes the name asked for in
one step (`os.replace`). An error or an interruption leaves an earlier file as it was.
"""

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yields a hidden file name beside `path`, which becomes `path` when the block ends
    without an error.

    If the block raises, what it wrote is deleted. The name has the suffix of `path`.

    **Raises:** `OSError` of `path`, not of the hidden file, if that cannot be written.
    """
    partial = path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")
    try:
        yield partial
        os.replace(partial, path)
    except OSError as error:
        if error.filename != str(partial):
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        with contextlib.suppress(OSError):
            partial.unlink()


def write_bytes(path: Path, content: bytes) -> None:
    """Writes a file, whole or not at all.

    **Raises:** `OSError`, naming `path`.
    """
    with replacing(path) as partial, _naming(path):
        partial.write_bytes(content)


def write_text(path: Path, text: str) -> None:
    """Writes a text (UTF-8), whole or not at all.

    **Raises:** `OSError`, naming `path`.
    """
    write_bytes(path, text.encode())


def write_npz(
    path: Path, arrays: Mapping[str, Any], *, compressed: bool = True
) -> None:
    """Writes named arrays, whole or not at all.

    **Raises:** `OSError`, naming `path`.
    """
    save: Any = np.savez_compressed if compressed else np.savez
    with replacing(path) as partial, _naming(path), partial.open("wb") as file:
        save(file, **arrays)


@contextlib.contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Adds the file's name to errors of writing in the block; that of a full disk lacks
    it."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        raise OSError(error.errno, reason, str(path)) from error


@contextlib.contextmanager
def hidden_folder(home: Path, prefix: str = ".partial-") -> Iterator[Path]:
    """Yields an empty hidden folder in `home`, which is deleted after the block.

    `home` and its parents are made if need be, and deleted again if left empty.
    """
    made = [folder for folder in (home, *home.parents) if not folder.exists()]
    try:
        home.mkdir(parents=True, exist_ok=True)
        partial = Path(tempfile.mkdtemp(prefix=prefix, dir=home))
        try:
            yield partial
        finally:
            shutil.rmtree(partial, ignore_errors=True)
    finally:
        for folder in made:
            with contextlib.suppress(OSError):
                folder.rmdir()
