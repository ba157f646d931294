"""Selects image regions to search for expected people, and measures overlap of
detections."""

import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax.people import movenet
from bodyslam_jax.people.movenet import Region, height

_SQUARE_FACTOR = 1.35
"""Side of the search square, relative to the height of the expected person."""
_MIN_COVERED_SHARE = 0.5
"""Share of a box covered by that of a more confident detection, from which it begins no
new track."""
_MIN_SIZE_RATIO = 0.6
"""Ratio of sizes from which one square suits both people."""


def regions(expected: list[np.ndarray], least: float, most: int) -> list[Region]:
    """Returns up to `most` squares around expected people of at least `least` px, the
    largest first.

    People within the square of somebody of about the same size need none.
    """
    large = [p for p in expected if height(p) >= least]
    found: list[tuple[Region, float]] = []
    for points in sorted(large, key=height, reverse=True):
        left, top, right, bottom = movenet.box(points)
        size = height(points)
        covered = any(
            left >= r[0] and top >= r[1] and right <= r[2] and bottom <= r[3]
            for r, other in found
            if size > _MIN_SIZE_RATIO * other
        )
        if not covered:
            found.append((square_around(points), size))
    return [region for region, _ in found[:most]]


def square_around(points: Float[np.ndarray, "17 3"]) -> Region:
    """Returns the square to search for a person with these predicted keypoints."""
    box = movenet.box(points)
    x, y = (box[:2] + box[2:]) / 2
    half = max(16.0, _SQUARE_FACTOR * height(points) / 2)
    left, top, side = round(x - half), round(y - half), round(2 * half)
    return left, top, left + side, top + side


def behind(
    points: Float[np.ndarray, "n 17 3"], score: Float[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Returns the detections mostly covered by a more confident one.

    Detectors often combine the limbs of two overlapping people into a third person.
    """
    boxes = [movenet.box(p) for p in points]
    return np.array(
        [
            any(
                score[j] > score[i] and covered(boxes[i], boxes[j]) > _MIN_COVERED_SHARE
                for j in range(len(points))
            )
            for i in range(len(points))
        ],
        bool,
    )


def covered(box: np.ndarray, other: np.ndarray) -> float:
    """Returns the share of a box (left, top, right, bottom) that another covers."""
    low, high = np.maximum(box[:2], other[:2]), np.minimum(box[2:], other[2:])
    area = max(float(np.prod(box[2:] - box[:2])), 1e-9)
    return float(np.prod(np.maximum(high - low, 0))) / area
