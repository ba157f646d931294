"""`failed.jsonl`: a line for each clip of a batch that has no result to be used.

Several drivers (`--shard`) may write it: they hold a lock on `.failed.lock` meanwhile.
"""

import contextlib
import json
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

from bodyslam_jax.batch.job import Outcome
from bodyslam_jax.io import atomic

try:
    import fcntl
except ImportError:  # Windows: shards of one folder must not run at once
    fcntl = None

NAME = "failed.jsonl"


def read(folder: Path) -> list[dict[str, Any]]:
    """The lines of the file; those that were cut by a killed process are left out."""
    try:
        text = (folder / NAME).read_text()
    except FileNotFoundError:
        return []
    found = []
    for line in text.splitlines():
        with contextlib.suppress(ValueError):
            found.append(json.loads(line))
    return found


def forget(folder: Path, names: Collection[str]) -> None:
    """Removes the lines of clips that are about to be run."""
    with _locked(folder):
        lines = read(folder)
        kept = [line for line in lines if line.get("name") not in names]
        if len(kept) < len(lines):
            text = "".join(f"{json.dumps(line)}\n" for line in kept)
            atomic.write_text(folder / NAME, text)


def add(folder: Path, outcome: Outcome) -> None:
    """Appends a line."""
    line = {
        "name": outcome.name,
        "status": outcome.status,
        "message": outcome.message,
        "log": f"logs/{outcome.name}.txt",
        "machine": outcome.machine,
    }
    with _locked(folder), (folder / NAME).open("a") as file:
        file.write(f"{json.dumps(line)}\n")


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    with (folder / ".failed.lock").open("w") as lock:
        if fcntl is not None:
            with contextlib.suppress(OSError):  # a file system without locks
                fcntl.lockf(lock, fcntl.LOCK_EX)
        yield
