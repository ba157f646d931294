"""Keypoints of any common layout -> BODY_25.

OpenPose's documentation, COCO, COCO-WholeBody, Halpe (AlphaPose).
"""

from pathlib import Path

import numpy as np

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

_NECK, _R_SHOULDER, _L_SHOULDER, _MID_HIP, _R_HIP, _L_HIP = 1, 2, 5, 8, 9, 12


def to_body25(path: Path, points: np.ndarray) -> np.ndarray:
    """BODY_25 of keypoints (..., j, 3) in another layout, recognised by `j`."""
    num = points.shape[-2]
    if num not in BODY25_FROM:
        *others, last = BODY25_FROM
        known = f"{', '.join(map(str, others))} or {last}"
        raise ValueError(f"{path}: {num} keypoints a person, not {known}.")
    index = np.asarray(BODY25_FROM[num])
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
