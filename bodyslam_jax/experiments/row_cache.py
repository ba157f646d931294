"""Caches finished rows on disk, so that an interrupted experiment can be resumed."""

import json
import logging
import math
import re
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io import atomic, files
from bodyslam_jax.pipeline.stage_cache import fingerprint

log = logging.getLogger(__name__)
Row = dict[str, Any]


class Journal:
    """Cache of rows: a folder with one JSON file per row, named by a fingerprint of its
    inputs."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.computed = 0
        """Number of rows that were not on disk."""

    def path(self, name: str, label: str, *key: Any) -> Path:
        """Returns the file of the row with this label and key."""
        words = re.sub(r"[^A-Za-z0-9.]+", "_", label).strip("_")
        return self.folder / f"{name}-{words}-{fingerprint(name, label, *key)}.json"

    def kept(
        self, name: str, label: str, key: Sequence[Any], form: Any = dict
    ) -> Row | None:
        """Returns the row of this `key` if it is on disk and has that `form` (`fits`),
        else `None`."""
        path = self.path(name, label, *key)
        if not path.exists():
            return None
        try:
            found = files.read_json(path, "a row of an experiment")
        except InputError:
            return None
        return found if fits(found, form) else None

    def row(
        self,
        name: str,
        label: str,
        key: Sequence[Any],
        compute: Callable[[], Row],
        form: Any = dict,
    ) -> Row:
        """Returns the row of this `key`, from disk if present; `label` is used in the
        log."""
        found = self.kept(name, label, key, form)
        if found is not None:
            log.info("%s %s: taken from an earlier run", name, label)
            return found
        path = self.path(name, label, *key)
        if path.exists():
            log.warning("%s: not a row as expected; computed again", path)
        start = time.perf_counter()
        row = _plain(compute())
        self.computed += 1
        log.info("%s %s: %.0f s", name, label, time.perf_counter() - start)
        self.folder.mkdir(parents=True, exist_ok=True)
        atomic.write_text(path, json.dumps(row, indent=1))
        return row


def fits(value: Any, form: Any) -> bool:
    """Returns whether a JSON value has a form: a type, a fixed text, or parts with
    forms.

    `{"a": float}` has at least an `a`, `[float]` any number of items. A number that was
    not finite is stored as `None`, which fits `float`.
    """
    if isinstance(form, dict):
        return isinstance(value, dict) and all(
            name in value and fits(value[name], one) for name, one in form.items()
        )
    if isinstance(form, list):
        return isinstance(value, list) and all(fits(item, form[0]) for item in value)
    if isinstance(form, str):
        return value == form
    if form is float:
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        return value is None or number
    return isinstance(value, form)


def _plain(value: Any) -> Any:
    """Converts arrays to lists and numbers that are not finite to null, as standard
    JSON requires."""
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
