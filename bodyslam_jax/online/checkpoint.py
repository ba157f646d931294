"""The state of a running estimate in a file, with which another process goes on.

The file is a pickle of what `Online` has learnt. What a new one makes from its settings
(body model, networks) is in it by name. Reading it creates arrays and objects of this
package's classes, and calls nothing else.
"""

import gzip
import importlib
import logging
import pickle
from pathlib import Path
from typing import Any

import jax
import numpy as np

from bodyslam_jax.config.errors import InputError, error_line
from bodyslam_jax.geometry.lengths import put
from bodyslam_jax.io import atomic
from bodyslam_jax.online.online import Online

log = logging.getLogger(__name__)

_PACKAGE = "bodyslam_jax"
_OF_SETTINGS = ("config", "body", "pool", "job", "prepared")
"""Attributes of an `Online` that are made from its arguments, or by `prepare`."""
_NUMPY = ("_frombuffer", "_reconstruct", "dtype", "ndarray", "scalar")
"""Names with which NumPy pickles arrays and numbers."""
_FUNCTIONS = {
    ("bodyslam_jax.geometry.lengths", "put"),
    ("bodyslam_jax.motion.resampling", "contact_between"),
    ("bodyslam_jax.motion.resampling", "predict_between"),
    ("collections", "deque"),
}
"""Modules and names of what is no class of this package: functions of arrays only."""


def save(online: Online, path: Path) -> None:
    """Writes the state of an estimate, whole or not at all.

    **Raises:** `InputError` if windows are solved in a second thread, whose state is
    not known between two calls of `update`; `OSError`, naming `path`, if it cannot be
    written.
    """
    if online.pool is not None:
        raise InputError("checkpoint: found a second thread, expected threads=False.")
    state = {k: v for k, v in vars(online).items() if k not in _OF_SETTINGS}
    path.parent.mkdir(parents=True, exist_ok=True)
    # Not compressed, but with the checksum of a gzip file.
    with atomic.replacing(path) as partial, gzip.open(partial, "wb", 0) as file:
        _Pickler(file, _shared(online)).dump(state)


def resume(online: Online, path: Path) -> bool:
    """Sets a new estimate to the state that `save` wrote of one with the same settings;
    returns false, and leaves it as it is, if the file is not there or damaged."""
    if not path.is_file():
        return False
    try:
        with gzip.open(path, "rb") as file:
            state = _Unpickler(file, _shared(online)).load()
            file.read()  # The checksum is at its end.
    except Exception as error:
        # Whatever the file contains, the video can be read from its beginning again.
        reason = error_line(error).rstrip(".")
        log.warning("%s: not readable (%s); begun again", path, reason)
        return False
    vars(online).update(state)
    return True


def _shared(online: Online) -> dict[str, Any]:
    """Returns what every estimate with the same settings has, or loads when it needs
    it, by the name that it has in a file."""
    networks = online.bodies.found.networks
    return {"body": online.body, "config": online.config, "networks": networks}


class _Pickler(pickle.Pickler):
    """Writes JAX's arrays as those of NumPy, and shared objects by their names."""

    def __init__(self, file: Any, shared: dict[str, Any]) -> None:
        super().__init__(file, pickle.HIGHEST_PROTOCOL)
        self.names = {id(x): name for name, x in shared.items() if x is not None}

    def persistent_id(self, obj: Any) -> str | None:
        return self.names.get(id(obj))

    def reducer_override(self, obj: Any) -> Any:
        if isinstance(obj, jax.Array):
            return put, (np.asarray(obj),)
        return NotImplemented


class _Unpickler(pickle.Unpickler):
    """Reads what `_Pickler` writes."""

    def __init__(self, file: Any, shared: dict[str, Any]) -> None:
        super().__init__(file)
        self.shared = shared

    def persistent_load(self, pid: Any) -> Any:
        return self.shared[pid]

    def find_class(self, module_name: str, global_name: str) -> Any:
        known = (module_name, global_name) in _FUNCTIONS
        package = module_name.split(".")[0]
        if package == "numpy" and global_name in _NUMPY:
            known = True
        elif package == _PACKAGE and not known:
            found = getattr(importlib.import_module(module_name), global_name, None)
            known = isinstance(found, type) and found.__module__ == module_name
        if not known:
            raise InputError(f"{module_name}.{global_name}: not of a state")
        return super().find_class(module_name, global_name)
