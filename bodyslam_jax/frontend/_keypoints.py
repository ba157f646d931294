"""Keypoint files of any common detector -> people in BODY_25 order, in pixels.

A reader gives the detections of every frame, in no order; `_association.py` makes
people of them. Layouts: OpenPose's documentation, COCO, Halpe (AlphaPose).
"""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

Detections = list[np.ndarray]
"""For each frame the keypoints (n, 25, 3) of `n` people: u px, v px, confidence."""

_JSON_SUFFIX = "_keypoints.json"

# Index in the source for each of BODY_25; -1 where the source has no such point.
_FROM_COCO18 = [0, 1, 2, 3, 4, 5, 6, 7, -1, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17] + [
    -1
] * 6
_FROM_COCO17 = [0, -1, 6, 8, 10, 5, 7, 9, -1, 12, 14, 16, 11, 13, 15, 2, 1, 4, 3] + [
    -1
] * 6
_FROM_HALPE26 = _FROM_COCO17[:1] + [18] + _FROM_COCO17[2:8] + [19] + _FROM_COCO17[9:19]
_FROM_HALPE26 += [20, 22, 24, 21, 23, 25]
_LAYOUTS = {17: _FROM_COCO17, 18: _FROM_COCO18, 26: _FROM_HALPE26}
_NECK, _R_SHOULDER, _L_SHOULDER, _MID_HIP, _R_HIP, _L_HIP = 1, 2, 5, 8, 9, 12


def read_detections(
    path: Path, *, num_frames: int, width: int, height: int
) -> Detections:
    """Reads whatever `path` is: a folder of OpenPose JSON files, a JSON file of
    AlphaPose, MMPose or COCO, or a generic `.npz`.

    **Raises:** `ValueError`, naming the file, if it is none of these, has NaN or
    infinity in it, or belongs to another video.
    """
    if not path.exists():
        raise ValueError(f"{path}: no such file or folder.")
    if path.is_dir():
        detections = _read_openpose(path, num_frames)
    elif path.suffix.lower() == ".npz":
        detections = _read_npz(path, num_frames)
    else:
        detections = _read_json(path, num_frames)
    return _to_pixels(path, detections, width, height)


def to_body25(path: Path, points: np.ndarray) -> np.ndarray:
    """BODY_25 of keypoints (..., j, 3) in another layout, recognised by `j`."""
    num = points.shape[-2]
    if num == 136:  # Halpe's body, then hands and face
        points, num = points[..., :26, :], 26
    if num == 133:  # COCO-WholeBody
        points, num = points[..., :17, :], 17
    if num == 25:
        return points
    if num not in _LAYOUTS:
        raise ValueError(f"{path}: {num} keypoints a person, not 17, 18, 25 or 26.")
    index = np.asarray(_LAYOUTS[num])
    found = np.where((index >= 0)[:, None], points[..., index, :], 0.0)
    for missing, a, b in (
        (_NECK, _R_SHOULDER, _L_SHOULDER),
        (_MID_HIP, _R_HIP, _L_HIP),
    ):
        if index[missing] < 0:
            # As OpenPose was trained: the middle of the pair, if both were seen.
            found[..., missing, :2] = (found[..., a, :2] + found[..., b, :2]) / 2
            found[..., missing, 2] = np.minimum(found[..., a, 2], found[..., b, 2])
    return found


def _read_openpose(folder: Path, num_frames: int) -> Detections:
    files = sorted(folder.glob(f"*{_JSON_SUFFIX}")) or sorted(folder.glob("*.json"))
    if not files:
        raise ValueError(f"{folder}: no *{_JSON_SUFFIX} in this folder.")
    numbers = [_number_in(f.name.removesuffix(_JSON_SUFFIX)) for f in files]
    index = _to_frames(folder, numbers, num_frames)
    detections = [np.zeros((0, 25, 3)) for _ in range(num_frames)]
    for file, frame in zip(files, index, strict=True):
        detections[frame] = _read_openpose_frame(file)
    return detections


def _read_openpose_frame(file: Path) -> np.ndarray:
    data = _load_json(file)
    people = data.get("people") if isinstance(data, dict) else None
    if not isinstance(people, list):
        raise ValueError(f"{file}: no list `people`, so not OpenPose's output.")
    found = []
    for person in people:
        if not isinstance(person, dict):
            raise ValueError(f"{file}: `people` holds {type(person).__name__}s.")
        flat = person.get("pose_keypoints_2d", person.get("pose_keypoints"))
        if flat is None:
            raise ValueError(f"{file}: a person without `pose_keypoints_2d`.")
        found.append(to_body25(file, _triples(file, flat)))
    return np.stack(found) if found else np.zeros((0, 25, 3))


def _read_json(path: Path, num_frames: int) -> Detections:
    data = _load_json(path)
    for recognise, read in _JSON_READERS:
        if recognise(data):
            entries = read(path, data)
            break
    else:
        what = list(data)[:5] if isinstance(data, dict) else type(data).__name__
        raise ValueError(
            f"{path}: neither AlphaPose, MMPose nor COCO keypoints, but {what}."
        )
    index = _to_frames(path, [frame for frame, _ in entries], num_frames)
    by_frame: list[list[np.ndarray]] = [[] for _ in range(num_frames)]
    for frame, (_, points) in zip(index, entries, strict=True):
        by_frame[frame].append(to_body25(path, points))
    return [np.stack(p) if p else np.zeros((0, 25, 3)) for p in by_frame]


_Entries = list[tuple[int | None, np.ndarray]]


def _is_flat_list(data: Any) -> bool:
    """AlphaPose and COCO results: one entry per person."""
    return (
        isinstance(data, list)
        and len(data) > 0
        and all(
            isinstance(e, dict) and {"image_id", "keypoints"} <= set(e) for e in data
        )
    )


def _read_flat_list(path: Path, data: Any) -> _Entries:
    return [
        (_number_in(str(e["image_id"])), _triples(path, e["keypoints"])) for e in data
    ]


def _read_coco(path: Path, data: Any) -> _Entries:
    """COCO annotations: images have numbers and names, of which the name counts."""
    try:
        name = {i["id"]: str(i.get("file_name", i["id"])) for i in data["images"]}
        return [
            (_number_in(name[a["image_id"]]), _triples(path, a["keypoints"]))
            for a in data["annotations"]
            if "keypoints" in a
        ]
    except (KeyError, TypeError) as error:
        raise ValueError(f"{path}: incomplete COCO annotations ({error}).") from None


def _read_mmpose(path: Path, data: Any) -> _Entries:
    entries: _Entries = []
    try:
        for i, info in enumerate(data["instance_info"]):
            frame = int(info.get("frame_id", i))
            for person in info["instances"]:
                xy = _array(path, person["keypoints"])
                score = _array(path, person["keypoint_scores"])
                if xy.shape != (len(score), 2):
                    raise ValueError(
                        f"{path}: {xy.shape} keypoints, {len(score)} scores."
                    )
                points = np.concatenate([xy, score[:, None]], axis=-1)
                entries.append((frame, points))
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path}: incomplete MMPose result ({error!r}).") from None
    return entries


def _has(*keys: str) -> Callable[[Any], bool]:
    return lambda data: isinstance(data, dict) and set(keys) <= set(data)


_JSON_READERS: list[tuple[Callable[[Any], bool], Callable[[Path, Any], _Entries]]] = [
    (_is_flat_list, _read_flat_list),
    (_has("annotations", "images"), _read_coco),
    (_has("instance_info"), _read_mmpose),
]


def _read_npz(path: Path, num_frames: int) -> Detections:
    """Generic: `keypoints` (t, j, 3) or (h, t, j, 3), or `uv` and `confidence`."""
    with open_npz(path) as archive:
        if "keypoints" in archive.files:
            points = numbers(path, archive, "keypoints")
        elif {"uv", "confidence"} <= set(archive.files):
            uv, confidence = (numbers(path, archive, k) for k in ("uv", "confidence"))
            if uv.shape != (*confidence.shape, 2):
                raise ValueError(
                    f"{path}: uv {uv.shape}, confidence {confidence.shape}."
                )
            points = np.concatenate([uv, confidence[..., None]], axis=-1)
        else:
            raise ValueError(f"{path}: no array `keypoints`, only {archive.files}.")
    if points.ndim == 3:
        points = points[None]
    if points.ndim != 4 or points.shape[-1] != 3:
        raise ValueError(f"{path}: keypoints {points.shape}, not (t, j, 3).")
    if points.shape[1] != num_frames:
        raise ValueError(
            f"{path}: keypoints of {points.shape[1]} frames, but the video has "
            f"{num_frames}."
        )
    points = to_body25(path, points)
    seen = points[..., 2].max(axis=-1) > 0
    return [points[seen[:, k], k] for k in range(num_frames)]


def open_npz(path: Path) -> "np.lib.npyio.NpzFile":
    """Opens an `.npz` without ever unpickling; `ValueError` if it is not one."""
    try:
        archive = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise ValueError(f"{path}: not a NumPy archive ({error}).") from None
    except Exception as error:  # zipfile's own errors are not of one family
        raise ValueError(f"{path}: damaged NumPy archive ({error}).") from None
    if not isinstance(archive, np.lib.npyio.NpzFile):
        raise ValueError(f"{path}: one array, not a NumPy archive (.npz).")
    return archive


def numbers(path: Path, archive: Any, key: str) -> np.ndarray:
    """A float64 array of an archive; `ValueError` if not all finite numbers."""
    try:
        array = archive[key]
    except Exception as error:
        raise ValueError(f"{path}: cannot read array `{key}` ({error}).") from None
    if array.dtype.kind not in "fiub":
        raise ValueError(f"{path}: array `{key}` holds {array.dtype}, not numbers.")
    array = np.asarray(array, dtype=np.float64)
    if not np.isfinite(array).all():
        bad = int((~np.isfinite(array)).sum())
        raise ValueError(
            f"{path}: {bad} of {array.size} numbers of `{key}` not finite."
        )
    return array


def _load_json(file: Path) -> Any:
    try:
        return json.loads(file.read_text())
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(f"{file}: not a JSON file ({error}).") from None


def _array(path: Path, values: Any) -> np.ndarray:
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{path}: keypoints that are not numbers.") from None
    if not np.isfinite(array).all():
        raise ValueError(f"{path}: keypoints with NaN or infinity.")
    return array


def _triples(path: Path, flat: Any) -> np.ndarray:
    array = _array(path, flat)
    if array.ndim == 1 and array.size and array.size % 3 == 0:
        array = array.reshape(-1, 3)
    if array.ndim != 2 or array.shape[1] != 3:
        raise ValueError(f"{path}: {array.shape} keypoints, not triples (u, v, score).")
    return array


def _number_in(name: str) -> int | None:
    """The last number in a name, without its suffix: `clip2_000012.jpg` is 12."""
    stem = re.sub(r"\.[A-Za-z]\w*$", "", name)
    found = re.findall(r"\d+", stem)
    return int(found[-1]) if found else None


def _to_frames(path: Path, numbers: list[int | None], num_frames: int) -> list[int]:
    """Frame of each file or entry, from its number: from 0, or from 1 if it must be."""
    known = [n for n in numbers if n is not None]
    if len(known) < len(numbers):
        raise ValueError(f"{path}: a name without a frame number.")
    if not known:
        return []
    first, last = min(known), max(known)
    if last < num_frames:
        return known
    if last == num_frames and first >= 1:
        return [n - 1 for n in known]
    distinct = sorted(set(known))
    if len(distinct) == num_frames and distinct[-1] - distinct[0] == num_frames - 1:
        return [n - first for n in known]  # a cut-out of a longer video
    raise ValueError(
        f"{path}: keypoints of frames {first} to {last}, but the video has "
        f"{num_frames} frames."
    )


def _to_pixels(
    path: Path, detections: Detections, width: int, height: int
) -> Detections:
    """Undoes OpenPose's `--keypoint_scale`, and clears what is missing."""
    counts = [len(d) for d in detections]
    if not sum(counts):
        raise ValueError(f"{path}: no person in any frame.")
    points = np.concatenate(detections)
    seen = points[..., 2] > 0
    if not seen.any():
        raise ValueError(f"{path}: all confidences are zero.")
    size = np.array([width, height], dtype=np.float64)
    low, high = float(points[seen, :2].min()), float(points[seen, :2].max())
    if high <= 1.5 and low >= -1.5:
        scale = (size - 1) / 2 if low < 0 else size - 1
        points[..., :2] = (points[..., :2] + (1.0 if low < 0 else 0.0)) * scale
    sure = points[points[..., 2] > 0.3][:, :2]
    outside = ((sure < 0) | (sure > size)).any(axis=-1)
    if len(sure) and outside.mean() > 0.3:
        raise ValueError(
            f"{path}: {100 * outside.mean():.0f} % of the keypoints outside the image "
            f"of {width}x{height} px: of another video?"
        )
    points[~seen] = 0.0
    ends = np.cumsum(counts)[:-1]
    return [d[(d[..., 2] > 0).any(axis=-1)] for d in np.split(points, ends)]
