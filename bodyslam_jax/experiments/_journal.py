"""Finished rows kept on disk: an interrupted experiment goes on where it stopped."""

import json
import logging
import math
import os
import re
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from bodyslam_jax.cache import fingerprint

log = logging.getLogger(__name__)
Row = dict[str, Any]


class Journal:
    """A folder with one JSON file a row, named by all that the row follows from."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.computed = 0
        """Rows that were not on disk."""

    def path(self, name: str, label: str, *key: Any) -> Path:
        words = re.sub(r"[^A-Za-z0-9.]+", "_", label).strip("_")
        return self.folder / f"{name}-{words}-{fingerprint(name, label, *key)}.json"

    def row(
        self, name: str, label: str, key: Sequence[Any], compute: Callable[[], Row]
    ) -> Row:
        """The row of this `key`, from disk if it is there; `label` is for people."""
        path = self.path(name, label, *key)
        if path.exists():
            try:
                found = json.loads(path.read_text())
            except ValueError:
                log.warning("%s: not readable; computed again", path)
            else:
                log.info("%s %s: taken from an earlier run", name, label)
                return found
        start = time.perf_counter()
        row = _plain(compute())
        self.computed += 1
        log.info("%s %s: %.0f s", name, label, time.perf_counter() - start)
        self.folder.mkdir(parents=True, exist_ok=True)
        partial = path.with_suffix(".partial")
        partial.write_text(json.dumps(row, indent=1))
        os.replace(partial, path)
        return row


def _plain(value: Any) -> Any:
    """Arrays as lists, what is not finite as null: JSON that others can read."""
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
