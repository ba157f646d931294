"""What the processes of an engine run in tests: quick, and with every way to fail."""

import json
import os
import time
from pathlib import Path

from bodyslam_jax.io import atomic


def nothing() -> None:
    """A `Setup` that needs none."""


def refuse() -> None:
    """A `Setup` of a machine that lacks something."""
    raise ValueError("--device gpu: JAX finds no GPU")


def twice(item: int) -> int:
    return 2 * item


def obey(item: tuple[str, str, float]) -> tuple[str, int]:
    """Does what an item says, in a folder: `("kill once", FOLDER, SECONDS)`.

    Appends a line to `FOLDER/log`, before and after, by which tests count.
    """
    word, folder, seconds = item
    note = lambda text: _append(Path(folder, "log"), f"{word} {text} {os.getpid()}")
    note("begun")
    time.sleep(seconds)
    if "raise" in word:
        raise ValueError(f"{word} went wrong")
    mark = Path(folder, f"{word.replace(' ', '-')}.tried")
    if "kill always" in word or ("kill once" in word and not mark.exists()):
        mark.touch()
        os.kill(os.getpid(), 9)
    note("done")
    return word, os.getpid()


def estimate(job) -> dict:
    """A run that takes no time; its clip's content is what it finds."""
    content = job.source.path.read_text()
    if content == "bad":
        raise ValueError(f"{job.source.path}: no frames in it.")
    if content == "slow":
        time.sleep(0.5)
    _append(job.batch / "log", job.name)
    summary = {"status": "doubtful" if content == "doubtful" else "ok", "reasons": []}
    if content == "doubtful":
        summary["reasons"] = [{"message": "feet slide."}]
    job.out.mkdir(exist_ok=True)
    atomic.write_text(job.out / "summary.json", json.dumps(summary))
    return summary


def _append(path: Path, line: str) -> None:
    with path.open("a") as file:
        file.write(f"{line}\n")
