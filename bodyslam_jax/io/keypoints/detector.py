"""Recognises the detector of a file's keypoints, and so its definition of hip and knee.

Files seldom name the detector. The number of keypoints identifies COCO's and Halpe's.
BODY_25 is written by many programs besides OpenPose: MediaPipe's points have exact
midpoints and lack small toes; a neck in the middle of the shoulders is a detector's,
one well above it a body model's joint.
"""

import re

import numpy as np
from jaxtyping import Float

from bodyslam_jax.body.skeleton import BODY25
from bodyslam_jax.io.keypoints.layouts import usual_layout

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

_NECK, _MID_HIP = BODY25["neck"], BODY25["mid_hip"]
_SHOULDERS = (BODY25["right_shoulder"], BODY25["left_shoulder"])
_HIPS = (BODY25["right_hip"], BODY25["left_hip"])
_SMALL_TOES = (BODY25["left_small_toe"], BODY25["right_small_toe"])
_BIG_TOES = (BODY25["left_big_toe"], BODY25["right_big_toe"])


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
