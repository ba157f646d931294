"""A format of keypoint files: its base class, and what the formats share.

`frame_index` maps the names of images to frames, `arrange` the points to BODY_25.
"""

import abc
import dataclasses
import math
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io.archive import read_npz
from bodyslam_jax.io.declared import as_array
from bodyslam_jax.io.declared_size import Size
from bodyslam_jax.io.files import read_json
from bodyslam_jax.io.formats import Format, Source, formats
from bodyslam_jax.io.keypoints.layouts import names_in

GROUP = "bodyslam_jax.keypoint_formats"
"""Entry points of this group are formats of other packages."""
_MAX_PERSON = 10**15
"""Largest number of a person."""


@dataclasses.dataclass(frozen=True)
class Listed:
    """The content of a file, before frames and parts of the body are known."""

    rows: list[tuple[str, np.ndarray, int]]
    """Name of the image, keypoints (j, 3: u px, v px, confidence; perhaps not finite),
    and number of the person, or -1."""
    names: list[str]
    """All images that are listed, with people or without."""
    complete: bool = True
    """True if images without people are listed, too."""
    parts: tuple[str, ...] | None = None
    """Names of the `j` points, if the file has them."""
    row_first: bool = False
    """True if the tool writes (y, x)."""
    size: Size | None = None
    """Width and height of the images that the points are in, px, if the file declares
    it."""
    detector: str | None = None
    """The detector's name, if the file has it."""


class KeypointFormat(Format):
    """A detector's files of keypoints.

    `Source.content` is an `Archive` for `.npz`, else what JSON gives.
    """

    layout: ClassVar[tuple[str, ...] | None] = None
    """Names of the points in the files' order, such as `left_knee`; `None` for formats
    that are written in several orders: then names in the file count, or the number of
    points and the distances between them (`layouts`, `arrange`)."""

    @abc.abstractmethod
    def read(self, source: Source, num_frames: int | None) -> Listed:
        """Returns the content of a file that `recognises` accepts.

        Args:
            num_frames: of the video; `None` for as many as the file has.

        **Raises:** `InputError`, naming the file, or any error that a damaged file
        causes; the caller adds the file's name to it.
        """


def keypoint_formats() -> list[KeypointFormat]:
    """Returns all keypoint formats, of this package and of others."""
    package = "bodyslam_jax.io.keypoints.formats"
    # The class is abstract, which a type of classes may not be for the checker.
    return formats(KeypointFormat, package, GROUP)  # pyright: ignore


def parsed(path: Path) -> Any:
    """Returns the content of a file of a general kind: `.npz`, or else JSON."""
    return read_npz(path) if path.suffix.lower() == ".npz" else read_json(path)


def has(data: Any, *keys: str) -> bool:
    """Returns True if the data is a dictionary with the keys."""
    return isinstance(data, dict) and set(keys) <= set(data)


def points_of(path: Path, values: Any) -> np.ndarray:
    """Returns numbers of keypoints; NaN for those that are missing.

    **Raises:** `InputError`, naming the file, if they are no numbers.
    """
    if isinstance(values, list):  # `null` is how JSON writes a missing number
        values = _without_null(values)
    return as_array(path, "keypoints", values, finite=False)


def triples(path: Path, flat: Any) -> np.ndarray:
    """Returns keypoints (j, 3: u, v, score) of a table or of one list of 3j numbers.

    **Raises:** `InputError`, naming the file, if they are something else.
    """
    array = points_of(path, flat)
    if array.ndim == 1 and array.size and array.size % 3 == 0:
        array = array.reshape(-1, 3)
    if array.ndim != 2 or array.shape[1] != 3:
        raise InputError(f"{path}: {array.shape} keypoints, not triples (u, v, score).")
    return array


def person_in(entry: dict, *keys: str) -> int:
    """Returns the number of a tracked person, alone or in a list; -1 if there is
    none."""
    value = next((entry[k] for k in keys if k in entry), None)
    while isinstance(value, list):
        value = value[0] if value else None
    if value is None:
        return -1
    try:
        number = int(value)
    except (TypeError, ValueError, OverflowError):
        return -1  # not a number, such as a name: people are tracked by position
    return number if 0 <= number < _MAX_PERSON else -1


def part_names(data: Any) -> tuple[str, ...] | None:
    """Returns the names of the points in a file's header, in order."""
    found = names_in(data)
    return None if found is None else tuple(found)


def detector_in(data: Any) -> str | None:
    """Returns the detector's name in a file's header."""
    if not isinstance(data, dict):
        return None
    for key in ("meta_info", "dataset_meta", "metadata", "meta", "info"):
        if (found := detector_in(data.get(key))) is not None:
            return found
    value = data.get("detector", data.get("dataset_name"))
    return value if isinstance(value, str) else None


def _without_null(values: list) -> list:
    return [
        math.nan if x is None else _without_null(x) if isinstance(x, list) else x
        for x in values
    ]
