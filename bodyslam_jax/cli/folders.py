"""Default output folder of `run`, and the command that opens the report of a run."""

import itertools
import shlex
import sys
from collections.abc import Callable
from pathlib import Path

from bodyslam_jax.types import Sequence

_ROOT = Path("runs")
_OPENERS = {"darwin": "open", "win32": "start"}


def default_folder(sequence: Sequence) -> Path:
    """Returns `runs/NAME`, or `runs/NAME-2` and so on where an earlier run is finished.

    An unfinished run of the same input is continued.
    """
    is_ours = lambda folder: _is_unfinished(folder, sequence)
    return free_folder(sequence.name or "run", is_ours)


def free_folder(
    name: str, is_ours: Callable[[Path], bool] = lambda folder: False
) -> Path:
    """Returns the first of `runs/NAME`, `runs/NAME-2` and so on that does not exist or
    for which `is_ours` is true."""
    for number in itertools.count(1):
        folder = _ROOT / (name if number == 1 else f"{name}-{number}")
        if not folder.exists() or is_ours(folder):
            return folder
    raise AssertionError("unreachable")


def look_at(folder: Path) -> str:
    """Returns the command that opens a run's report."""
    opener = _OPENERS.get(sys.platform, "xdg-open")
    return f"{opener} {shlex.quote(str(folder / 'report.html'))}"


def _is_unfinished(folder: Path, sequence: Sequence) -> bool:
    from bodyslam_jax.export.summary import describe
    from bodyslam_jax.pipeline.stage_cache import Cache

    if any(not entry.name.startswith(".") for entry in folder.iterdir()):
        return False
    return Cache(folder / ".cache").owner() in (None, describe(sequence))
