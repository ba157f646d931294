"""Reads and writes `failed.jsonl`: a line for each clip of a batch without a usable
result.

Several drivers (`--shard`) may write it: they hold a lock on `.failed.lock` meanwhile.
"""

import contextlib
import json
import logging
import os
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

from bodyslam_jax.batch.inputs import is_file_name
from bodyslam_jax.batch.job import Outcome
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io import atomic, files

try:
    import fcntl
except ImportError:  # Windows: shards of one folder must not run at once
    fcntl = None

log = logging.getLogger(__name__)
FAILURES_FILE = "failed.jsonl"


def read(folder: Path) -> list[dict[str, str]]:
    """Returns the lines of the file whose name, status and message are text; others,
    such as those truncated by a killed process, are left out with a warning."""
    path, found = folder / FAILURES_FILE, []
    if not path.exists():
        return []
    try:
        lines = files.read_lines(path, "a list of failed clips")
    except InputError as error:
        log.warning("%s Its clips are left out.", error)
        return []
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        try:
            one = files.parse_json(line, path)
        except InputError as error:
            log.warning("line %d: %s It is left out.", number, error)
            continue
        if _is_line(one):
            found.append(one)
        else:
            log.warning("%s: line %d tells of no clip; left out.", path, number)
    return found


def _is_line(one: Any) -> bool:
    if not isinstance(one, dict):
        return False
    texts = (one.get(key) for key in ("name", "status", "message"))
    return all(isinstance(x, str) for x in texts) and is_file_name(one["name"])


def forget(folder: Path, names: Collection[str]) -> None:
    """Removes the lines of clips that are about to be run."""
    with _locked(folder):
        lines = read(folder)
        kept = [line for line in lines if line["name"] not in names]
        if len(kept) < len(lines):
            text = "".join(f"{json.dumps(line)}\n" for line in kept)
            atomic.write_text(folder / FAILURES_FILE, text)


def add(folder: Path, outcome: Outcome) -> None:
    """Appends the line of a failed clip."""
    line = {
        "name": outcome.name,
        "status": outcome.status,
        "message": outcome.message,
        "log": f"logs/{outcome.name}.txt",
        "machine": outcome.machine,
    }
    with _locked(folder), (folder / FAILURES_FILE).open("a") as file:
        file.write(f"{json.dumps(line)}\n")


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    # A symbolic link of this name is not followed.
    flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0)
    # Permissions are what the umask leaves of these.
    with os.fdopen(os.open(folder / ".failed.lock", flags, 0o666), "r+b") as lock:
        if fcntl is not None:
            with contextlib.suppress(OSError):  # a file system without locks
                fcntl.lockf(lock, fcntl.LOCK_EX)
        yield
