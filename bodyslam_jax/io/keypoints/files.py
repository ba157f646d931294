"""Keypoint files of common detectors -> names of images, and detections in them.

`frame_index` maps the names to frames, `arrange` the points to BODY_25.
"""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io.archive import Archive, read_npz
from bodyslam_jax.io.budget import last_frame_problem
from bodyslam_jax.io.declared import as_array, as_whole
from bodyslam_jax.io.declared_size import Size, size_in
from bodyslam_jax.io.files import read_json, reading
from bodyslam_jax.io.keypoints.names import names_in

_JSON_SUFFIX = "_keypoints.json"
_SMALL = 300
"""Entries of an array that may be metadata."""

_MAX_PERSON = 10**15
"""A larger one is no number of a person."""


@dataclasses.dataclass(frozen=True)
class Listed:
    """The content of a file, before frames and parts of the body are known."""

    rows: list[tuple[str, np.ndarray, int]]
    """Name of the image, keypoints (j, 3: u px, v px, confidence; perhaps not finite),
    and number of the person, or -1."""
    names: list[str]
    """All images that are listed, with people or without."""
    complete: bool = True
    """Whether images without people are listed, too."""
    parts: tuple[str, ...] | None = None
    """Names of the `j` points, if the file has them."""
    row_first: bool = False
    """Whether the tool writes (y, x)."""
    size: Size | None = None
    """Of the images that the points are in, px, if the file declares it."""
    detector: str | None = None
    """The detector's name, if the file has it."""


def read_openpose(folder: Path) -> Listed:
    """OpenPose's folder of `*_keypoints.json`, one file per frame.

    **Raises:** `InputError`, naming the file, if it is not OpenPose's.
    """
    files = sorted(folder.glob(f"*{_JSON_SUFFIX}")) or sorted(folder.glob("*.json"))
    if not files:
        raise InputError(f"{folder}: no *{_JSON_SUFFIX} in this folder.")
    rows = []
    for file in files:
        rows += [(file.name, *found) for found in _read_openpose_frame(file)]
    first = read_json(files[0])
    return Listed(rows, [f.name for f in files], detector=_detector(first))


def _read_openpose_frame(file: Path) -> list[tuple[np.ndarray, int]]:
    data = read_json(file)
    people = data.get("people") if isinstance(data, dict) else None
    if not isinstance(people, list):
        raise InputError(f"{file}: no list `people`, so not OpenPose's output.")
    found = []
    for person in people:
        if not isinstance(person, dict):
            raise InputError(f"{file}: `people` holds {type(person).__name__}s.")
        flat = person.get("pose_keypoints_2d", person.get("pose_keypoints"))
        if flat is None:
            raise InputError(f"{file}: a person without `pose_keypoints_2d`.")
        found.append((_triples(file, flat), _who(file, person, "person_id")))
    return found


def read_json_keypoints(path: Path) -> Listed:
    """A JSON file of AlphaPose, MMPose, COCO or easy_ViTPose, recognised by content.

    **Raises:** `InputError`, naming the file, if it is none of these or incomplete.
    """
    data = read_json(path)
    for recognise, read in _JSON_READERS:
        if recognise(data):
            return read(path, data)
    what = list(data)[:5] if isinstance(data, dict) else type(data).__name__
    raise InputError(
        f"{path}: neither AlphaPose, MMPose, COCO nor easy_ViTPose keypoints, but "
        f"{what}."
    )


def _is_flat_list(data: Any) -> bool:
    """AlphaPose and COCO results: one entry per person."""
    return (
        isinstance(data, list)
        and len(data) > 0
        and all(
            isinstance(e, dict) and {"image_id", "keypoints"} <= set(e) for e in data
        )
    )


def _read_flat_list(path: Path, data: Any) -> Listed:
    rows = [
        (
            str(e["image_id"]),
            _triples(path, e["keypoints"]),
            _who(path, e, "idx", "track_id"),
        )
        for e in data
    ]
    if all(who == 0 for _, _, who in rows):
        # AlphaPose numbers everybody 0 if it does not track.
        rows = [(name, points, -1) for name, points, _ in rows]
    return Listed(rows, [name for name, _, _ in rows], complete=False)


def _read_coco(path: Path, data: Any) -> Listed:
    """COCO annotations: images have numbers and names, of which the name counts."""
    try:
        name = {i["id"]: str(i.get("file_name", i["id"])) for i in data["images"]}
        rows = [
            (
                name[a["image_id"]],
                _triples(path, a["keypoints"]),
                _who(path, a, "track_id"),
            )
            for a in data["annotations"]
            if "keypoints" in a
        ]
    except (KeyError, TypeError) as error:
        raise InputError(f"{path}: incomplete COCO annotations ({error}).") from None
    return Listed(
        rows,
        list(name.values()),
        parts=_parts(data),
        size=size_in(path, data),
        detector=_detector(data),
    )


def _read_mmpose(path: Path, data: Any) -> Listed:
    rows, names = [], []
    try:
        for i, info in enumerate(data["instance_info"]):
            frame = as_whole(path, "frame_id", info.get("frame_id", i))
            names.append(str(frame))
            for person in info["instances"]:
                xy = _array(path, person["keypoints"])
                score = _array(path, person["keypoint_scores"])
                if xy.shape != (len(score), 2):
                    raise InputError(
                        f"{path}: {xy.shape} keypoints, {len(score)} scores."
                    )
                points = np.concatenate([xy, score[:, None]], axis=-1)
                who = _who(path, person, "track_id")
                rows.append((names[-1], points, who))
    except (KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: incomplete MMPose result ({error!r}).") from None
    return Listed(
        rows,
        names,
        parts=_parts(data),
        size=size_in(path, data),
        detector=_detector(data),
    )


def _is_by_frame(data: Any) -> bool:
    """easy_ViTPose: people by number, in a list of frames."""
    frames = data.get("keypoints") if isinstance(data, dict) else None
    return isinstance(frames, list) and all(isinstance(f, dict) for f in frames)


def _read_by_frame(path: Path, data: Any) -> Listed:
    """easy_ViTPose: `keypoints`, for each frame `{person: [[y, x, score], ...]}`."""
    rows = [
        (str(k), _triples(path, points), _who(path, {"id": person}, "id"))
        for k, found in enumerate(data["keypoints"])
        for person, points in found.items()
    ]
    return Listed(
        rows,
        [str(k) for k in range(len(data["keypoints"]))],
        parts=_parts(data),
        row_first=True,
        size=size_in(path, data),
        detector=_detector(data) or "vitpose",
    )


def _parts(data: Any) -> tuple[str, ...] | None:
    found = names_in(data)
    return None if found is None else tuple(found)


def _detector(data: Any) -> str | None:
    """The detector's name in a file's header."""
    if not isinstance(data, dict):
        return None
    for key in ("meta_info", "dataset_meta", "metadata", "meta", "info"):
        if (found := _detector(data.get(key))) is not None:
            return found
    value = data.get("detector", data.get("dataset_name"))
    return value if isinstance(value, str) else None


def _has(*keys: str) -> Callable[[Any], bool]:
    return lambda data: isinstance(data, dict) and set(keys) <= set(data)


_JSON_READERS: list[tuple[Callable[[Any], bool], Callable[[Path, Any], Listed]]] = [
    (_is_flat_list, _read_flat_list),
    (_has("annotations", "images"), _read_coco),
    (_has("instance_info"), _read_mmpose),
    (_is_by_frame, _read_by_frame),
]


def read_npz_keypoints(path: Path, num_frames: int | None) -> Listed:
    """Generic: `keypoints` (t, j, 3) or (h, t, j, 3), or `uv` and `confidence`.

    Without an axis of people it is one person; along the axis, people are tracked.
    """
    archive = read_npz(path)
    if "keypoints" in archive:
        shapes = ("t", "j", 3), ("h", "t", "j", 3)
        points = archive.array("keypoints", *shapes, finite=False)
    elif "uv" in archive and "confidence" in archive:
        shapes = ("t", "j", 2), ("h", "t", "j", 2)
        uv = archive.array("uv", *shapes, finite=False)
        shape = uv.shape[:-1]
        confidence = archive.array("confidence", shape, finite=False)
        points = np.concatenate([uv, confidence[..., None]], axis=-1)
    else:
        found = ", ".join(archive.names[:12])
        raise InputError(f"{path}: no array `keypoints`, only {found}.")
    header = _header(archive)
    if points.ndim == 3:
        points = points[None]
    if num_frames is not None and points.shape[1] != num_frames:
        raise InputError(
            f"{path}: keypoints of {points.shape[1]} frames, but the video has "
            f"{num_frames}."
        )
    if num_frames is None and (
        problem := last_frame_problem(points.shape[1] - 1, points.shape[1], "keypoints")
    ):
        raise InputError(f"{path}: {problem}.")
    rows = [
        (str(k), points[h, k], int(h))
        for h, k in np.argwhere(~(points[..., 2] <= 0).all(axis=-1))
    ]
    return Listed(
        rows,
        [str(k) for k in range(points.shape[1])],
        parts=_parts(header),
        size=size_in(path, header),
        detector=_detector(header),
    )


def _header(archive: Archive) -> dict[str, Any]:
    """The small arrays of numbers or text beside the keypoints, as lists."""
    found = {}
    for name in archive.names:
        shape, dtype = archive.header(name)
        if math.prod(shape) < _SMALL and dtype.kind in "fiuU":
            with reading(archive.path, f"`{name}` of numbers or text"):
                found[name] = archive.raw(name).tolist()
    return found


def _array(path: Path, values: Any) -> np.ndarray:
    if isinstance(values, list):  # `null` is how JSON writes a missing number
        values = _without_null(values)
    return as_array(path, "keypoints", values, finite=False)


def _without_null(values: list) -> list:
    return [
        math.nan if x is None else _without_null(x) if isinstance(x, list) else x
        for x in values
    ]


def _triples(path: Path, flat: Any) -> np.ndarray:
    array = _array(path, flat)
    if array.ndim == 1 and array.size and array.size % 3 == 0:
        array = array.reshape(-1, 3)
    if array.ndim != 2 or array.shape[1] != 3:
        raise InputError(f"{path}: {array.shape} keypoints, not triples (u, v, score).")
    return array


def _who(path: Path, entry: dict, *keys: str) -> int:
    """The number of a tracked person, alone or in a list; -1 if there is none."""
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
