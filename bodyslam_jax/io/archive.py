"""`.npz` files of unknown origin: opened without unpickling, checked by array."""

from pathlib import Path
from typing import Any

import numpy as np

from bodyslam_jax.config.errors import InputError


def open_npz(path: Path) -> "np.lib.npyio.NpzFile":
    """Opens an `.npz` without ever unpickling; `ValueError` if it is not one."""
    if not path.exists():
        raise InputError(f"{path}: no such file.")
    try:
        archive = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"{path}: not a NumPy archive ({error}).") from None
    except Exception as error:  # zipfile's own errors are not of one family
        raise InputError(f"{path}: damaged NumPy archive ({error}).") from None
    if not isinstance(archive, np.lib.npyio.NpzFile):
        raise InputError(f"{path}: one array, not a NumPy archive (.npz).")
    return archive


def numbers(path: Path, archive: Any, key: str, *, finite: bool = True) -> np.ndarray:
    """A float64 array of an archive.

    **Raises:** `InputError`, naming the file, if the array holds anything but numbers
    or, unless `finite` is false, numbers that are not finite.
    """
    try:
        array = archive[key]
    except Exception as error:
        raise InputError(f"{path}: cannot read array `{key}` ({error}).") from None
    if array.dtype.kind not in "fiub":
        raise InputError(f"{path}: array `{key}` holds {array.dtype}, not numbers.")
    array = np.asarray(array, dtype=np.float64)
    if finite and not np.isfinite(array).all():
        bad = int((~np.isfinite(array)).sum())
        raise InputError(
            f"{path}: {bad} of {array.size} numbers of `{key}` not finite."
        )
    return array
