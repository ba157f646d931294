"""Keypoints of any common layout -> BODY_25.

A layout lists the part of the body that each of a detector's points is; the parts are
BODY_25's, and two more that other detectors have. Sources: OpenPose's documentation
(BODY_25, BODY_25B, COCO-18), COCO, COCO-WholeBody, Halpe (AlphaPose), ViTPose+ with
feet (easy_ViTPose's `coco_25`), Human3.6M as in MMPose, Kinect v2 (NTU RGB+D).
"""

from pathlib import Path

import numpy as np

from bodyslam_jax.body.skeleton import BODY25
from bodyslam_jax.config.errors import InputError

_COCO17 = [0, -1, 6, 8, 10, 5, 7, 9, -1, 12, 14, 16, 11, 13, 15, 2, 1, 4, 3]
_COCO18 = [0, 1, 2, 3, 4, 5, 6, 7, -1, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17]
_HALPE = [0, 18, *_COCO17[2:8], 19, *_COCO17[9:], 20, 22, 24, 21, 23, 25]

BODY25_FROM = {
    17: [*_COCO17, *[-1] * 6],
    18: [*_COCO18, *[-1] * 6],
    25: list(range(25)),
    26: _HALPE,
    133: [*_COCO17, 17, 18, 19, 20, 21, 22],
    136: _HALPE,  # then face and hands
}
"""By the number of keypoints: the index of each of BODY_25 among them, or -1."""

HEAD_TOP, SPINE = 25, 26
"""Parts that BODY_25 does not have, after those that it has."""
NUM_PARTS = 27

_AS_COCO17 = [0, 16, 15, 18, 17, 5, 2, 6, 3, 7, 4, 12, 9, 13, 10, 14, 11]
_HUMAN36M = [*range(8, 15), SPINE, 1, 0, HEAD_TOP, 5, 6, 7, 2, 3, 4]
_FEET = [19, 20, 21, 22, 23, 24]

VITPOSE = [0, 16, 15, 18, 17, 1, 5, 2, 6, 3, 7, 4, 12, 9, 8, 13, 10, 14, 11, *_FEET]
LAYOUTS: dict[int, dict[str, list[int]]] = {
    17: {
        "COCO": _AS_COCO17,
        "Human3.6M": _HUMAN36M,
    },
    18: {
        "OpenPose's COCO": [0, 1, 2, 3, 4, 5, 6, 7, *range(9, 15), 15, 16, 17, 18],
        "COCO, then the neck": [*_AS_COCO17, 1],
    },
    25: {
        "BODY_25": list(range(25)),
        # Its neck is the upper end of the neck, not the middle of the shoulders.
        "BODY_25B": [*_AS_COCO17, -1, HEAD_TOP, *_FEET],
        "ViTPose with feet": VITPOSE,
        "Kinect v2": [
            *[8, SPINE, -1, HEAD_TOP, 5, 6, 7, -1, 2, 3, 4, -1, 12, 13, 14, -1],
            *[9, 10, 11, -1, 1, -1, -1, -1, -1],
        ],
    },
}
"""By the number of keypoints: layouts of as many, the usual one first. A layout has the
part of each of its points, or -1."""

_MIDPOINTS = (
    (BODY25["neck"], BODY25["right_shoulder"], BODY25["left_shoulder"]),
    (BODY25["mid_hip"], BODY25["right_hip"], BODY25["left_hip"]),
)
"""Keypoints that are the middle of two others."""


def to_body25(path: Path, points: np.ndarray) -> np.ndarray:
    """BODY_25 of keypoints (..., j, 3) in the usual layout of `j` points.

    **Raises:** `InputError`, naming the file, if there is none.
    """
    num = points.shape[-2]
    if num not in BODY25_FROM:
        *others, last = BODY25_FROM
        expected = f"{', '.join(map(str, others))} or {last}"
        raise InputError(f"{path}: {num} keypoints a person, not {expected}.")
    return _gathered(points, np.asarray(BODY25_FROM[num]))


def from_layout(points: np.ndarray, layout: list[int]) -> np.ndarray:
    """BODY_25 of keypoints (..., j, 3) whose parts are those of `layout`."""
    index = np.full(25, -1)
    for place, part in enumerate(layout):
        if 0 <= part < 25:
            index[part] = place
    return _gathered(points, index)


def _gathered(points: np.ndarray, index: np.ndarray) -> np.ndarray:
    found = np.where((index >= 0)[:, None], points[..., index, :], 0.0)
    for missing, a, b in _MIDPOINTS:
        if index[missing] < 0:
            # As OpenPose was trained: the middle of the pair, if both are detected.
            found[..., missing, :2] = (found[..., a, :2] + found[..., b, :2]) / 2
            found[..., missing, 2] = np.minimum(found[..., a, 2], found[..., b, 2])
    return found
