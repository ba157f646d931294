"""Keypoints of any common layout -> BODY_25.

A layout lists the part of the body that each of a detector's points is; the parts are
BODY_25's, and two more that other detectors have. Sources: OpenPose's documentation
(BODY_25, BODY_25B, COCO-18), COCO, COCO-WholeBody, Halpe (AlphaPose), ViTPose+ with
feet (easy_ViTPose's `coco_25`), Human3.6M as in MMPose, Kinect v2 (NTU RGB+D).
"""

import dataclasses

import numpy as np

from bodyslam_jax.body.skeleton import BODY25

HEAD_TOP, SPINE = 25, 26
"""Parts that BODY_25 does not have, after those that it has."""
NUM_PARTS = 27


@dataclasses.dataclass(frozen=True)
class Layout:
    """An order of keypoints."""

    parts: list[int]
    """The part of the body that each point is, or -1 for none of them."""
    definition: str | None = None
    """Definition of hip and knee of its detectors, a name in
    `body.KEYPOINT_DEFINITIONS`; `None` if detectors of several definitions write this
    order."""


_AS_COCO17 = [0, 16, 15, 18, 17, 5, 2, 6, 3, 7, 4, 12, 9, 13, 10, 14, 11]
_HUMAN36M = [*range(8, 15), SPINE, 1, 0, HEAD_TOP, 5, 6, 7, 2, 3, 4]
_FEET = [19, 20, 21, 22, 23, 24]
_HALPE = [*_AS_COCO17, HEAD_TOP, 1, 8, 19, 22, 20, 23, 21, 24]

VITPOSE = [0, 16, 15, 18, 17, 1, 5, 2, 6, 3, 7, 4, 12, 9, 8, 13, 10, 14, 11, *_FEET]
LAYOUTS: dict[int, dict[str, Layout]] = {
    17: {
        "COCO": Layout(_AS_COCO17, "coco"),
        "Human3.6M": Layout(_HUMAN36M),
    },
    18: {
        "OpenPose's COCO": Layout(
            [0, 1, 2, 3, 4, 5, 6, 7, *range(9, 15), 15, 16, 17, 18], "openpose"
        ),
        "COCO, then the neck": Layout([*_AS_COCO17, 1], "coco"),
    },
    25: {
        "BODY_25": Layout(list(range(25))),
        # Its neck is the upper end of the neck, not the middle of the shoulders.
        "BODY_25B": Layout([*_AS_COCO17, -1, HEAD_TOP, *_FEET], "openpose"),
        "ViTPose with feet": Layout(VITPOSE, "coco"),
        "Kinect v2": Layout(
            [
                *[8, SPINE, -1, HEAD_TOP, 5, 6, 7, -1, 2, 3, 4, -1, 12, 13, 14, -1],
                *[9, 10, 11, -1, 1, -1, -1, -1, -1],
            ]
        ),
    },
    26: {"Halpe": Layout(_HALPE, "halpe")},
    133: {"COCO-WholeBody": Layout([*_AS_COCO17, *_FEET, *[-1] * 110], "coco")},
    # Face and hands follow.
    136: {"Halpe, full body": Layout([*_HALPE, *[-1] * 110], "halpe")},
}
"""Layouts by their number of keypoints, the usual one first."""

_MIDPOINTS = (
    (BODY25["neck"], BODY25["right_shoulder"], BODY25["left_shoulder"]),
    (BODY25["mid_hip"], BODY25["right_hip"], BODY25["left_hip"]),
)
"""Keypoints that are the middle of two others."""


def usual_layout(num: int) -> Layout | None:
    """Returns the usual layout of `num` keypoints; `None` if none has as many."""
    return next(iter(LAYOUTS.get(num, {}).values()), None)


def from_layout(points: np.ndarray, layout: list[int]) -> np.ndarray:
    """Returns BODY_25 of keypoints (..., j, 3) whose parts are those of `layout`."""
    index = np.full(25, -1)
    for place, part in enumerate(layout):
        if 0 <= part < 25:
            index[part] = place
    found = np.where((index >= 0)[:, None], points[..., index, :], 0.0)
    for missing, a, b in _MIDPOINTS:
        if index[missing] < 0:
            # As OpenPose was trained: the middle of the pair, if both are detected.
            found[..., missing, :2] = (found[..., a, :2] + found[..., b, :2]) / 2
            found[..., missing, 2] = np.minimum(found[..., a, 2], found[..., b, 2])
    return found
