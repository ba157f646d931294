"""Runs MoveNet MultiPose: up to six people and their 17 keypoints in a part of an
image.

The network's input may have any size whose sides are multiples of 32. It finds people
who are about 40 to 250 px high in its input, so each part of the image is rescaled for
the size of the people in it.
"""

from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from bodyslam_jax.body.skeleton import COCO17_MIRRORED
from bodyslam_jax.tracking.tracker import PointSet

NUM_KEYPOINTS = 17
"""Number of COCO keypoints, in COCO's order: nose, eyes, ears, shoulders, elbows,
wrists, hips, knees, ankles, left before right."""
_INPUT_MULTIPLE_PX = 32
"""Divisor of the sides that the network's input may have."""
_KEYPOINT_SHIFT_PX = -0.25
"""Shift in the network's input, added to `relative place x size`: half a pixel is from
pixel edges to centres, and a quarter back is the network's own offset, from images and
their mirror images (five clips, 545 keypoints; -0.27)."""
_MAX_COINCIDENT_DISTANCE = 0.05
"""Distance, relative to the person's size, up to which two keypoints coincide."""
_MIN_SHARED_KEYPOINTS = 3
"""Number of keypoints that two detections of one person must share."""

Region = tuple[int, int, int, int]
"""Left, top, right, bottom of a part of an image, px; the last two are exclusive. It
may extend beyond the image."""


def find_people(
    session: Any, image: UInt8[np.ndarray, "y x 3"], region: Region, longer: int
) -> tuple[Float[np.ndarray, "n 17 3"], Float[np.ndarray, " n"]]:
    """Returns the keypoints (u px, v px, score) and a score of each person in a part of
    an image.

    Args:
        session: MoveNet.
        image: BGR.
        longer: longer side of the region in the network's input, px.
    """
    canvas, scale = letterbox(image, region, longer)
    rgb = canvas[..., ::-1].astype(np.int32)[None]
    (raw,) = session.run(None, {session.get_inputs()[0].name: rgb})
    points, score = decode(raw[0], canvas.shape[:2])
    points[..., :2] = to_image(points[..., :2], region, scale)
    return points, score


def letterbox(
    image: UInt8[np.ndarray, "y x 3"], region: Region, longer: int
) -> tuple[UInt8[np.ndarray, "h w 3"], float]:
    """Returns a part of an image at another scale, black beyond the image.

    **Returns:** the canvas, its sides the next multiples of 32, its content in the
    upper left corner; and its pixels per pixel of the image.
    """
    left, top, right, bottom = region
    width, height = right - left, bottom - top
    scale = longer / max(width, height)
    patch = np.zeros((height, width, 3), np.uint8)
    x0, y0 = max(left, 0), max(top, 0)
    x1, y1 = min(right, image.shape[1]), min(bottom, image.shape[0])
    if x1 > x0 and y1 > y0:
        patch[y0 - top : y1 - top, x0 - left : x1 - left] = image[y0:y1, x0:x1]
    size = max(1, round(width * scale)), max(1, round(height * scale))
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    scaled = cv2.resize(patch, size, interpolation=how)
    rows, columns = (
        -(-n // _INPUT_MULTIPLE_PX) * _INPUT_MULTIPLE_PX for n in scaled.shape[:2]
    )
    canvas = np.zeros((rows, columns, 3), np.uint8)
    canvas[: scaled.shape[0], : scaled.shape[1]] = scaled
    return canvas, scale


def decode(
    raw: Float[np.ndarray, "6 56"], size: tuple[int, int]
) -> tuple[Float[np.ndarray, "6 17 3"], Float[np.ndarray, " 6"]]:
    """Converts the network's output for six people.

    **Returns:** keypoints (x px, y px, score) on the network's input of `size` (rows,
    columns), and each person's score. In `raw`, keypoints are (y, x, score) with y and
    x relative to the input's size.
    """
    yxs = raw[:, : 3 * NUM_KEYPOINTS].reshape(-1, NUM_KEYPOINTS, 3).astype(float)
    rows, columns = size
    x, y = (
        yxs[..., 1] * columns + _KEYPOINT_SHIFT_PX,
        yxs[..., 0] * rows + _KEYPOINT_SHIFT_PX,
    )
    return np.stack([x, y, yxs[..., 2]], axis=-1), raw[:, 55].astype(float)


def to_image(
    xy: Float[np.ndarray, "*n 2"], region: Region, scale: float
) -> Float[np.ndarray, "*n 2"]:
    """Converts pixels of the canvas of `letterbox` to pixels of the image (pixel
    centres have integer coordinates in both)."""
    return (xy + 0.5) / scale - 0.5 + np.array(region[:2])


def distinct(
    points: Float[np.ndarray, "n 17 3"], score: Float[np.ndarray, " n"]
) -> Int[np.ndarray, " k"]:
    """Returns the indices of detections without duplicates of a person, highest score
    first.

    A detection is a duplicate if it is of the same person (`same_person`) as one with a
    higher score.
    """
    kept: list[int] = []
    for index in np.argsort(-score, kind="stable").tolist():
        if all(not same_person(points[index], points[k]) for k in kept):
            kept.append(index)
    return np.array(kept, int)


def same_person(a: Float[np.ndarray, "17 3"], b: Float[np.ndarray, "17 3"]) -> bool:
    """Returns whether two detections in one image are of one person.

    They are if they share at least three keypoints. The face counts as one of them, as
    its five keypoints are close together.
    """
    near = np.linalg.norm(a[:, :2] - b[:, :2], axis=1)
    size = max(box_size(a), box_size(b), 1.0)
    shared = (near < _MAX_COINCIDENT_DISTANCE * size) & sure_points(a) & sure_points(b)
    return int(shared[5:].sum() + shared[:5].any()) >= _MIN_SHARED_KEYPOINTS


def sure_points(points: Float[np.ndarray, "17 3"]) -> Bool[np.ndarray, " 17"]:
    """Returns the keypoints whose score exceeds `MIN_SURE_SCORE`."""
    return points[:, 2] > MIN_SURE_SCORE


MIN_SURE_SCORE = 0.15
"""Score up to which a keypoint's place is a guess: at 0.2 it errs by 4 to 9 % of a
person's height (`found.confidence`)."""


MOVENET_POINTS = PointSet(MIN_SURE_SCORE, COCO17_MIRRORED, remembered=False)
"""What the tracker knows of MoveNet's keypoints."""
_TRUNK_HEIGHT_RATIO = 0.3
"""Length of the trunk as a share of the height."""


def box(points: Float[np.ndarray, "17 3"]) -> Float[np.ndarray, " 4"]:
    """Returns left, top, right, bottom (px) of a person's keypoints with a score above
    `MIN_SURE_SCORE`, or of all keypoints if fewer than two have such a score."""
    sure = sure_points(points)
    chosen = points[sure if sure.sum() >= 2 else slice(None), :2]
    return np.concatenate([chosen.min(0), chosen.max(0)])


def box_size(points: Float[np.ndarray, "17 3"]) -> float:
    """Returns the longer side of a person's `box`, px."""
    left, top, right, bottom = box(points)
    return float(max(right - left, bottom - top))


def height(points: Float[np.ndarray, "17 3"]) -> float:
    """Returns the size of a person in the image (px), also if bent or partly hidden."""
    size = max(box_size(points), 1.0)
    if sure_points(points)[[5, 6, 11, 12]].all():
        trunk = points[[5, 6], :2].mean(0) - points[[11, 12], :2].mean(0)
        size = max(size, float(np.linalg.norm(trunk)) / _TRUNK_HEIGHT_RATIO)
    return size
