"""Checks of a data set's files; every error names the file."""

from pathlib import Path
from typing import Any

import numpy as np

from bodyslam_jax import io
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io.declared import MAX_MAGNITUDE
from bodyslam_jax.io.safe_pickle import restricted_load

_WEBSITES = {
    "EMDB": "https://emdb.ait.ethz.ch",
    "3DPW": "https://virtualhumans.mpi-inf.mpg.de/3DPW",
    "RICH": "https://rich.is.tue.mpg.de",
    "AMASS": "https://amass.is.tue.mpg.de",
}
_IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp")


def not_there(path: Path, dataset: str) -> InputError:
    """Returns the error for a missing file, with the address at which to register."""
    return InputError(
        f"{path}: not there; {dataset} is given to researchers who register at "
        f"{_WEBSITES[dataset]}."
    )


def dictionary(file: Path, needed: tuple[str, ...]) -> dict[str, Any]:
    """Reads a pickled dictionary that has all keys in `needed`.

    **Raises:** `InputError` if it is no such dictionary.
    """
    return fields(file, "", restricted_load(file), needed)


def fields(file: Path, name: str, data: Any, needed: tuple[str, ...]) -> dict[str, Any]:
    """Returns `data`, called `name` in `file`, if it is a dictionary with the keys
    `needed`.

    **Raises:** `InputError` otherwise.
    """
    where = f"{file}: {name + ' is ' if name else ''}"
    if not isinstance(data, dict):
        raise InputError(f"{where}a {type(data).__name__}, not a dictionary.")
    missing = [f"{name}.{key}" if name else key for key in needed if key not in data]
    if missing:
        raise InputError(f"{file}: no {', '.join(missing)}, only {[*data]}.")
    return data


def entries(file: Path, name: str, data: Any, count: int | None = None) -> list[Any]:
    """Returns the entries of `name`, one for each of `count` people; at least one.

    **Raises:** `InputError` for another number.
    """
    is_list = isinstance(data, list | tuple)
    if not is_list and not (isinstance(data, np.ndarray) and data.ndim):
        raise InputError(f"{file}: {name}: a {type(data).__name__}, not a list.")
    if not len(data) or len(data) != (count or len(data)):
        wanted = "at least one person" if count is None else f"{count} people"
        raise InputError(f"{file}: {name}: {len(data)} entries, not of {wanted}.")
    return list(data)


def array(
    file: Path, name: str, values: Any, shape: tuple[int | None, ...]
) -> np.ndarray:
    """Returns `values` as finite float64 of this shape; `None` is any length but 0.

    **Raises:** `InputError` if they are not.
    """
    try:
        found = np.asarray(values, np.float64)
    except (TypeError, ValueError, OverflowError, MemoryError):
        kind = type(values).__name__
        raise InputError(
            f"{file}: {name}: a {kind}, not an array of numbers."
        ) from None
    fits = found.ndim == len(shape) and all(
        n == wanted or (wanted is None and n > 0)
        for n, wanted in zip(found.shape, shape, strict=True)
    )
    if not fits or not np.all(np.abs(found) <= MAX_MAGNITUDE):
        wanted = str(shape).replace("None", "any")
        raise InputError(
            f"{file}: {name}: {found.shape} values, not {wanted} finite numbers."
        )
    return found


def first(file: Path, name: str, values: Any, count: int) -> np.ndarray:
    """Returns the first `count` of the flattened `values`, checked by `array`."""
    try:
        flat = np.ravel(values)[:count]
    except ValueError:  # lists of different lengths
        flat = values
    return array(file, name, flat, (count,))


def whole(file: Path, name: str, value: Any) -> int:
    """Returns a value that must be a whole number above 0.

    **Raises:** `InputError` if it is not.
    """
    number = float(array(file, name, value, ()))
    if number < 1 or number != round(number):
        raise InputError(f"{file}: {name}: {number:g}, not a whole number above 0.")
    return int(number)


def extrinsics(file: Path, name: str, values: Any, num: int | None) -> np.ndarray:
    """Returns world-to-camera matrices, checked to be rigid motions.

    **Raises:** `InputError` if they are not.
    """
    found = array(file, name, values, (num, 4, 4))
    R = np.clip(found[:, :3, :3], -10, 10)
    away = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(initial=0)
    rows = np.abs(found[:, 3] - [0, 0, 0, 1]).max(initial=0)
    if max(away, rows) > 0.01 or (np.linalg.det(R) < 0).any():
        raise InputError(f"{file}: {name}: matrices that are no rigid motions.")
    return found


def images(folder: Path, num: int = 1) -> list[Path]:
    """Returns the images of a folder, sorted by name; at least `num`.

    Fewer images than frames mean an incomplete download, whose images would be assigned
    to wrong frames.

    **Raises:** `InputError` if there are fewer.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder of images.")
    found = (p for p in folder.iterdir() if p.suffix.lower() in _IMAGE_SUFFIXES)
    listed = sorted(found, key=lambda file: file.name)
    if not listed:
        raise InputError(f"{folder}: no image in it.")
    if len(listed) < num:
        raise InputError(f"{folder}: {len(listed)} images, not one for {num} frames.")
    return listed


def image_size(folder: Path) -> tuple[int, int]:
    """Returns width and height of the first image, px."""
    image = next(io.frames(folder))
    return image.shape[1], image.shape[0]
