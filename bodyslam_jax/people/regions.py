"""Image regions to search for expected people, and overlap between detections."""

import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax.people import movenet
from bodyslam_jax.people.movenet import Region
from bodyslam_jax.people.tracking import height

_ROOM = 1.35
"""Side of the square around an expected person, of their box."""
_MOSTLY = 0.5
"""Share of a box, covered by a surer one, from which no new track begins in it."""
_ALIKE = 0.6
"""Ratio of sizes down to which one square suits both people."""


def regions(expected: list[np.ndarray], least: float, most: int) -> list[Region]:
    """Squares around expected people, the largest first. Who is well within the
    square of somebody about as large needs none."""
    large = [p for p in expected if height(p) >= least]
    found: list[tuple[Region, float]] = []
    for points in sorted(large, key=height, reverse=True):
        left, top, right, bottom = movenet.box(points)
        size = height(points)
        covered = any(
            left >= r[0] and top >= r[1] and right <= r[2] and bottom <= r[3]
            for r, other in found
            if size > _ALIKE * other
        )
        if not covered:
            found.append((square_around(points), size))
    return [region for region, _ in found[:most]]


def square_around(points: Float[np.ndarray, "17 3"]) -> Region:
    """The square to search for a person with these predicted keypoints."""
    box = movenet.box(points)
    x, y = (box[:2] + box[2:]) / 2
    half = max(16.0, _ROOM * height(points) / 2)
    left, top, side = round(x - half), round(y - half), round(2 * half)
    return left, top, left + side, top + side


def behind(
    points: Float[np.ndarray, "n 17 3"], score: Float[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Detections mostly covered by a surer one: detectors often combine the limbs of
    two overlapping people into a third person."""
    boxes = [movenet.box(p) for p in points]
    return np.array(
        [
            any(
                score[j] > score[i] and covered(boxes[i], boxes[j]) > _MOSTLY
                for j in range(len(points))
            )
            for i in range(len(points))
        ],
        bool,
    )


def covered(box: np.ndarray, other: np.ndarray) -> float:
    """Share of a box (left, top, right, bottom) that another covers."""
    low, high = np.maximum(box[:2], other[:2]), np.minimum(box[2:], other[2:])
    area = max(float(np.prod(box[2:] - box[:2])), 1e-9)
    return float(np.prod(np.maximum(high - low, 0))) / area
