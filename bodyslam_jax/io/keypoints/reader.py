"""Keypoint files of common detectors -> detections in each frame, BODY_25, pixels.

Detections of a frame have no order, but numbers of people if the file has them;
`associate` tracks people through them.

The detector of a file's keypoints is recognised for its definition of hip and knee.
Files seldom name the detector. The number of keypoints identifies COCO's and Halpe's.
BODY_25 is written by many programs besides OpenPose: MediaPipe's points have exact
midpoints and lack small toes; a neck in the middle of the shoulders is a detector's,
one well above it a body model's joint.
"""

import dataclasses
import logging
import re
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax.body.skeleton import BODY25
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io.archive import Archive
from bodyslam_jax.io.budget import MAX_PEOPLE
from bodyslam_jax.io.declared_size import Size, factor_to, scaled
from bodyslam_jax.io.formats import attributed, format_of, names_of
from bodyslam_jax.io.frame_index import InvalidContent, Warn, frames_of_names
from bodyslam_jax.io.keypoints.arrange import MIN_CONFIDENCE, arranged
from bodyslam_jax.io.keypoints.keypoint_format import (
    Listed,
    keypoint_formats,
    parsed,
)
from bodyslam_jax.io.keypoints.layouts import usual_layout

_log = logging.getLogger(__name__)
Detections = list[np.ndarray]
"""For each frame the keypoints (n, 25, 3) of `n` people: u px, v px, confidence."""
_MIN_OUTSIDE_SHARE, _MIN_INSIDE_SHARE = 0.02, 0.995
"""Least share of points outside the video, and within the rotated one, of keypoints in
the stored frames of a phone's video, before its rotation tag."""
_MIN_LYING_SHARE = 0.8
"""Least share of people whose trunk is horizontal, there."""
_NECK, _MID_HIP = BODY25["neck"], BODY25["mid_hip"]
UNKNOWN = "unknown"
_DEFINITION_BY_NAME = {
    "mediapipe|blazepose": "mediapipe",
    "openpose|body_?25": "openpose",
    "halpe|alphapose": "halpe",
    "coco|movenet|vitpose|rtmpose|dwpose|hrnet|rtmo|yolo|wholebody": "coco",
    "smpl|joints|simulat": UNKNOWN,
}
_MIDPOINT_TOLERANCE_PX = 0.02
"""Largest distance of a written midpoint from the middle of its two points, px."""
_MAX_NECK_HEIGHT = 0.06
"""Largest height of a detector's neck over the middle of the shoulders, in lengths of
the trunk: it is about 0, where the default body's joint has 0.15."""
_MIN_DETECTIONS = 5
_SHOULDERS = (BODY25["right_shoulder"], BODY25["left_shoulder"])
_HIPS = (BODY25["right_hip"], BODY25["left_hip"])
_SMALL_TOES = (BODY25["left_small_toe"], BODY25["right_small_toe"])
_BIG_TOES = (BODY25["left_big_toe"], BODY25["right_big_toe"])


@dataclasses.dataclass(frozen=True)
class Detected:
    """The detections in each frame."""

    points: Detections
    person: list[np.ndarray] | None = None
    """For each frame the numbers (n,) of its `n` people, the same for the same person;
    `None` if the file does not track people."""
    definition: str = UNKNOWN
    """Definition of hip and knee, a name in `body.KEYPOINT_DEFINITIONS`."""


def read_detections(
    path: Path,
    *,
    num_frames: int | None,
    width: int,
    height: int,
    images: tuple[str, ...] = (),
    warn: Warn = _log.warning,
) -> Detected:
    """Reads a file or folder of any format in `keypoint_formats`, recognised by
    content: OpenPose's, AlphaPose's, COCO's, MMPose's, easy_ViTPose's, or arrays.

    Points that are not finite are missing; points in another order than usual, in
    (y, x), or in images of another declared size are converted, with warnings.

    Args:
        num_frames: of the video; None for as many as the file has.
        images: names of the video's frames, if it is a folder of images.

    **Raises:** `InputError`, naming the file, if it is none of these, is mostly NaN, is
    in no known order, or belongs to another video.
    """
    if not path.exists():
        raise InputError(f"{path}: no such file or folder.")
    listed = _listed(path, num_frames)
    if path.suffix.lower() == ".npz":
        images = ()  # its frames are rows, not names
    try:
        frames = frames_of_names(
            listed.names,
            what="keypoints",
            num_frames=num_frames,
            images=images,
            complete=listed.complete,
            warn=warn,
        )
    except InvalidContent as error:
        raise InputError(f"{path}: {error}.") from None
    if num_frames is None:
        num_frames = max(frames.values(), default=-1) + 1
    by_frame: list[list[tuple[np.ndarray, int]]] = [[] for _ in range(num_frames)]
    for (name, _, who), points in zip(
        listed.rows, arranged(path, listed, warn), strict=True
    ):
        by_frame[frames[name]].append((points, who))
    busiest = max(map(len, by_frame), default=0)
    if busiest > MAX_PEOPLE:
        raise InputError(
            f"{path}: {busiest} people in one frame, expected at most {MAX_PEOPLE}."
        )
    points = [np.array([p for p, _ in f]).reshape(-1, 25, 3) for f in by_frame]
    person = [np.array([who for _, who in f], dtype=np.int64) for f in by_frame]
    person = _checked(person, warn)
    found = _to_pixels(path, points, person, (width, height), listed.size, warn)
    counts = {len(points) for _, points, _ in listed.rows}
    count = counts.pop() if len(counts) == 1 else 0
    every = np.concatenate([np.zeros((0, 25, 3)), *found.points])
    definition = definition_of(every, count, listed.detector)
    return dataclasses.replace(found, definition=definition)


def _listed(path: Path, num_frames: int | None) -> Listed:
    """Returns the content of the file or folder, as its format reads it."""
    among = keypoint_formats()
    chosen, source = format_of(path, among, parsed)
    if chosen is not None:
        with attributed(path, f"keypoints of {chosen.name}"):
            listed = chosen.read(source, num_frames)
        if listed.parts is None and chosen.layout is not None:
            listed = dataclasses.replace(listed, parts=chosen.layout)
        return listed
    data = source.content
    if isinstance(data, Archive):
        found = ", ".join(data.names[:12])
        raise InputError(f"{path}: no array `keypoints`, only {found}.")
    what = list(data)[:5] if isinstance(data, dict) else type(data).__name__
    expected = names_of([f for f in among if not f.folder])
    raise InputError(f"{path}: not keypoints of {expected}, but {what}.")


def _checked(person: list[np.ndarray], warn: Warn) -> list[np.ndarray] | None:
    """Returns the numbers of people, if all have one and no two in a frame have the
    same."""
    numbers = np.concatenate(person) if person else np.zeros(0)
    if not (numbers >= 0).any():
        return None
    wrong = "given for some only" if (numbers < 0).any() else ""
    for frame, who in enumerate(person):
        if not wrong and len(np.unique(who)) < len(who):
            wrong = f"given twice in frame {frame}"
    if wrong:
        warn(f"keypoints: people's numbers {wrong}: people are tracked by position.")
        return None
    return person


def _to_pixels(
    path: Path,
    detections: Detections,
    person: list[np.ndarray] | None,
    size: tuple[int, int],
    declared: Size | None,
    warn: Warn,
) -> Detected:
    """Undoes OpenPose's `--keypoint_scale`, another declared size and the rotation of a
    phone's video; sets missing points to 0."""
    counts = [len(d) for d in detections]
    if not sum(counts):
        raise InputError(f"{path}: no person in any frame.")
    points = np.concatenate(detections)
    present = points[..., 2] > 0
    if not present.any():
        raise InputError(f"{path}: all confidences are zero.")
    sure = points[..., 2] > MIN_CONFIDENCE
    sure = sure if sure.any() else present
    if (uv := _relative(points, sure, size, warn)) is not None:
        points[..., :2] = uv
    elif declared is not None:
        try:
            factor = factor_to(declared, size, points[sure][:, :2], "keypoints", warn)
        except InvalidContent as error:
            raise InputError(f"{path}: {error}") from None
        points[..., :2] = scaled(points[..., :2], factor)
    at = points[points[..., 2] > MIN_CONFIDENCE][:, :2]
    outside = ((at < 0) | (at > size)).any(axis=-1)
    if (turned := _rotated_upright(points, sure, size, warn)) is not None:
        points[..., :2] = turned
    elif len(at) and outside.mean() > 0.3:
        raise InputError(
            f"{path}: {100 * outside.mean():.0f} % of the keypoints outside the image "
            f"of {size[0]}x{size[1]} px: of another video?"
        )
    points[~present] = 0.0
    split = np.split(points, np.cumsum(counts)[:-1])
    kept = [(d[..., 2] > 0).any(axis=-1) for d in split]
    if person is not None:
        person = [who[k] for who, k in zip(person, kept, strict=True)]
    return Detected([d[k] for d, k in zip(split, kept, strict=True)], person)


def _relative(
    points: np.ndarray, sure: np.ndarray, size: tuple[int, int], warn: Warn
) -> np.ndarray | None:
    """Returns pixels of points that are relative to the image, in [0, 1] or [-1, 1];
    `None` if they are pixels already.

    Decided by quantiles: single points may be well outside the image.
    """
    uv = points[..., :2]
    low, high = np.quantile(uv[sure], [0.05, 0.95], axis=0)
    if high.max() > 1.5 or low.min() < -1.5:
        return None
    # In [0, 1] a twentieth of the points is rarely as far beyond the left or top side.
    zero = -1.0 if low.min() < -0.1 else 0.0
    warn(f"keypoints in [{zero:g}, 1]: taken as relative to the size of the image.")
    return (uv - zero) / (1 - zero) * (np.asarray(size, dtype=np.float64) - 1)


def _rotated_upright(
    points: Float[np.ndarray, "m 25 3"],
    sure: Bool[np.ndarray, "m 25"],
    size: tuple[int, int],
    warn: Warn,
) -> Float[np.ndarray, "m 25 2"] | None:
    """Returns pixels of the video of `size` (width, height), if the points fit a video
    of height x width in which people lie; `None` otherwise.

    The rotation is the one that turns heads up.

    Args:
        points: u px, v px, confidence.
        sure: points whose position is trusted.
    """
    width, height = size
    uv = points[..., :2]
    inside = lambda limit: ((uv[sure] >= 0) & (uv[sure] <= limit)).all(axis=-1)
    beyond = np.any(uv[sure] > np.array([width, height]), axis=-1)
    if not len(beyond) or beyond.mean() < _MIN_OUTSIDE_SHARE:
        return None
    trunk = (uv[:, _MID_HIP] - uv[:, _NECK])[sure[:, _NECK] & sure[:, _MID_HIP]]
    across = np.abs(trunk[:, 0]) > 2 * np.abs(trunk[:, 1])
    if inside(np.array([height, width])).mean() < _MIN_INSIDE_SHARE or not len(trunk):
        return None
    right = float((across & (trunk[:, 0] < 0)).mean())  # heads
    left = float((across & (trunk[:, 0] > 0)).mean())
    if max(left, right) < _MIN_LYING_SHARE:
        return None
    warn(
        f"keypoints are of a video of {height}x{width} px in which people lie, this "
        f"one has {width}x{height} px: taken as detected before the video's rotation "
        "was applied, and turned."
    )
    u, v = uv[..., 0], uv[..., 1]
    if right > left:  # the stored image is the shown one turned clockwise
        return np.stack([v, height - 1 - u], axis=-1)
    return np.stack([width - 1 - v, u], axis=-1)


def definition_of(
    points: Float[np.ndarray, "n 25 3"], count: int, named: str | None
) -> str:
    """Returns the definition of the keypoints, a name in `body.KEYPOINT_DEFINITIONS`.

    Args:
        points: all detections, BODY_25 (u px, v px, confidence).
        count: keypoints a person in the file.
        named: the detector's name, if the file has it.
    """
    if named is not None:
        words = named.lower().replace("-", "").replace(" ", "")
        for pattern, definition in _DEFINITION_BY_NAME.items():
            if re.search(pattern, words):
                return definition
    usual = usual_layout(count)
    if usual is not None and usual.definition is not None:
        return usual.definition
    needed = [_NECK, _MID_HIP, *_SHOULDERS, *_HIPS]
    points = points[(points[:, needed, 2] > 0).all(axis=1)]
    if count != 25 or len(points) < _MIN_DETECTIONS:
        return UNKNOWN
    uv, given = points[..., :2], points[..., 2] > 0
    shoulders, hips = uv[:, _SHOULDERS].mean(axis=1), uv[:, _HIPS].mean(axis=1)
    away = np.abs(uv[:, [_NECK, _MID_HIP]] - np.stack([shoulders, hips], axis=1))
    if np.median(away.max(axis=(1, 2))) < _MIDPOINT_TOLERANCE_PX:
        feet = given[:, _BIG_TOES].any() and not given[:, _SMALL_TOES].any()
        return "mediapipe" if feet else "coco"
    trunk = shoulders - hips
    length = np.sum(trunk**2, axis=1)
    above = np.sum((uv[:, _NECK] - shoulders) * trunk, axis=1)
    height = np.median(above / np.maximum(length, 1e-9))
    return "openpose" if height < _MAX_NECK_HEIGHT else UNKNOWN
