"""Detects x and y that were exchanged, by people who lie on their side.

With (y, x) in place of (x, y) everybody lies with the head to the left. So they do if
the image is rotated by 90 degrees, but then they are not mirrored: in an upright image,
a person who faces the camera has the right side of the body on the left.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from bodyslam_jax.body.skeleton import BODY25, BODY25_FACE, BODY25_TOES_AND_HEELS

_MIN_PRESENT_CONFIDENCE = 0.05
_MIN_CONFIDENCE = 0.3
_NECK, _MID_HIP = BODY25["neck"], BODY25["mid_hip"]
_RIGHT, _LEFT = (
    (BODY25[f"{side}_shoulder"], BODY25[f"{side}_hip"]) for side in ("right", "left")
)
_FEET = (BODY25_TOES_AND_HEELS[:2], BODY25_TOES_AND_HEELS[2:])
"""Toe and heel of either foot."""
_MAX_TRUNK_SLOPE_DEG = 35.0
"""Largest angle between the trunk of a lying person and the image's rows, degrees."""
_MIN_BREADTH_RATIO = 0.2
"""Ratio of breadth to length of the trunk below which a person is seen from the side,
and left and right are not informative."""
_MAX_FACE_SHARE = 0.99
"""Share of detections with a face above which the detector gives a face to people seen
from behind, too."""
_MIN_DETECTIONS = 5
"""Least number of detections for a decision."""


@dataclasses.dataclass(frozen=True)
class Lying:
    """Detections that lie on their side with the head to the left of the image."""

    share: float
    """Share of all detections."""
    mirrored: float
    """Of the lying detections with evidence, the share whose face and feet fit an
    exchange of x and y; those of the others fit a rotation. NaN without evidence."""


def lying(points: Float[np.ndarray, "n 25 3"], has_face: bool) -> Lying:
    """Evaluates whether `n` detections (u px, v px, confidence; BODY_25 order) lie
    sideways, and whether they are mirrored.

    Args:
        has_face: whether the detector's layout has nose and eyes, so that their absence
            means a person seen from behind.
    """
    has_trunk = (points[:, [_NECK, _MID_HIP], 2] > _MIN_PRESENT_CONFIDENCE).all(axis=1)
    points = points[has_trunk]
    if not len(points):
        return Lying(0.0, np.nan)
    trunk = points[:, _MID_HIP, :2] - points[:, _NECK, :2]
    length = np.maximum(np.linalg.norm(trunk, axis=1), 1e-9)
    flat = trunk[:, 0] > np.cos(np.radians(_MAX_TRUNK_SLOPE_DEG)) * length
    sure = points[..., 2] > _MIN_CONFIDENCE
    sides = zip(_RIGHT, _LEFT, strict=True)
    across = [points[:, r, 1] - points[:, l, 1] for r, l in sides]
    breadth = np.mean(across, axis=0) / length
    usable = (
        flat
        & sure[:, [*_RIGHT, *_LEFT]].all(axis=1)
        & (np.abs(breadth) > _MIN_BREADTH_RATIO)
    )
    facing = _facing(points, sure, length, has_face)
    usable &= facing != 0
    if usable.sum() < _MIN_DETECTIONS:
        return Lying(float(flat.mean()), np.nan)
    # With x and y exchanged, the right side of a person who faces the camera has the
    # smaller y.
    fits = np.sign(-breadth[usable]) == np.sign(facing[usable])
    share = float(np.average(fits, weights=np.abs(facing[usable])))
    return Lying(float(flat.mean()), share)


def _facing(
    points: np.ndarray, sure: np.ndarray, length: np.ndarray, has_face: bool
) -> np.ndarray:
    """Returns positive numbers for people who face the camera, negative ones for those
    seen from behind, 0 for unknown.

    By whether a face is detected; if everybody has one, by the feet: toes of a person
    who faces the camera are lower in an upright image than the heels, as the camera is
    above the ground. With the head to the left, lower is further to the right.
    """
    face = sure[:, list(BODY25_FACE)].sum(axis=1) >= 2
    if has_face and face.mean() <= _MAX_FACE_SHARE:
        none = (points[:, list(BODY25_FACE), 2] <= _MIN_PRESENT_CONFIDENCE).all(axis=1)
        return np.where(face, 1.0, np.where(none, -1.0, 0.0))
    lower = np.zeros((len(_FEET), len(points)))
    for row, (toe, heel) in zip(lower, _FEET, strict=True):
        both = sure[:, toe] & sure[:, heel]
        row[both] = ((points[:, toe, 0] - points[:, heel, 0]) / length)[both]
    return lower.mean(axis=0)
