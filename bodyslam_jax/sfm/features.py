"""BRISK keypoints, spread over the image; descriptor matching; epipolar RANSAC.

BRISK: Leutenegger et al., ICCV 2011, the detector of Henning et al. (ECCV 2022).
"""

from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.sfm.multiview import essential_matrix

_MAX_RATIO = 0.8
"""Largest ratio of the distances to the nearest and to the second descriptor (Lowe,
IJCV 2004)."""
BRISK_THRESHOLD, _BRISK_OCTAVES = 20, 3
"""Initial threshold of BRISK, grey levels, and number of octaves of its pyramid."""
_MISSING_BRISK_TEXT = (
    f"OpenCV {cv2.__version__} has no BRISK: install opencv-python-headless<5 or "
    "opencv-contrib-python-headless."
)


def make_brisk() -> Any:
    """Returns OpenCV's BRISK, from the main module or the contributed ones.

    **Raises:** `InputError` that says how to install it, if OpenCV has none.
    """
    home = _home_of_brisk()
    if home is None:
        raise InputError(_MISSING_BRISK_TEXT)
    return home.BRISK_create(BRISK_THRESHOLD, _BRISK_OCTAVES)


def brisk_status() -> str:
    """Returns one line of text: which module has BRISK, or how to install it."""
    home = _home_of_brisk()
    return (
        _MISSING_BRISK_TEXT
        if home is None
        else f"found in {home.__name__} {cv2.__version__}"
    )


def _home_of_brisk() -> Any | None:
    """Returns the module that has BRISK: OpenCV 5 moved it to the contributed ones."""
    modules = (cv2, getattr(cv2, "xfeatures2d", None))
    return next((p for p in modules if hasattr(p, "BRISK_create")), None)


def spread(
    uv: Float[np.ndarray, "n 2"],
    response: Float[np.ndarray, " n"],
    taken: Float[np.ndarray, "k 2"],
    *,
    size: tuple[int, int],
    cell: int,
    quota: int,
    distance: float,
) -> list[int]:
    """Picks points that cover the image: the strongest in each cell that lacks some.

    Args:
        taken: existing points; they count for their cell.
        size: width and height, px.
        cell: side of a cell, px.
        quota: points wanted in each cell.
        distance: least distance between any two points, px.
    """
    columns, rows = -(-size[0] // cell), -(-size[1] // cell)
    lacking = np.full((rows, columns), quota)
    # A map of blocked pixels is faster than a search for neighbours.
    blocked = np.zeros((size[1], size[0]), dtype=np.uint8)
    radius = max(1, round(distance))
    for x, y in taken:
        cv2.circle(blocked, (round(float(x)), round(float(y))), radius, 1, -1)
        i, j = int(y) // cell, int(x) // cell
        if 0 <= i < rows and 0 <= j < columns:
            lacking[i, j] -= 1
    chosen = []
    for k in np.argsort(-response):
        x, y = (int(c) for c in uv[k])
        if not (0 <= x < size[0] and 0 <= y < size[1]):
            continue
        i, j = y // cell, x // cell
        if lacking[i, j] <= 0 or blocked[y, x]:
            continue
        cv2.circle(blocked, (x, y), radius, 1, -1)
        lacking[i, j] -= 1
        chosen.append(int(k))
    return chosen


def epipolar_inliers(
    xy_a: Float[np.ndarray, "n 2"], xy_b: Float[np.ndarray, "n 2"], threshold: float
) -> Bool[np.ndarray, " n"]:
    """Returns which pairs fit one essential matrix; all if there are too few to test.

    Args:
        xy_a, xy_b: undistorted points at depth 1.
        threshold: distance from the epipolar line, in the same unit.
    """
    if len(xy_a) < 12:
        return np.ones(len(xy_a), dtype=bool)
    _, inlier = essential_matrix(xy_a, xy_b, threshold)
    if inlier is None:
        return np.ones(len(xy_a), dtype=bool)
    return inlier.ravel() > 0


def match(a: UInt8[np.ndarray, "n d"], b: UInt8[np.ndarray, "m d"]) -> np.ndarray:
    """Returns pairs (k, 2) of mutually nearest descriptors that pass the ratio test."""
    if len(a) < 2 or len(b) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
    forward = matcher.knnMatch(a, b, k=2)
    backward = {m.queryIdx: m.trainIdx for m in matcher.match(b, a)}
    found = [
        (first.queryIdx, first.trainIdx)
        for first, second in forward
        if first.distance < min(_MAX_RATIO * second.distance, 110)
        and backward[first.trainIdx] == first.queryIdx
    ]
    return np.asarray(found, dtype=np.int64).reshape(-1, 2)
