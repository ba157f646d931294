"""Weak-perspective bodies of cropped images -> bodies in the camera frame.

A network that sees a crop regresses the body's size (`s`) and position (`tx, ty`) in
the crop, and its rotation relative to the crop's viewing direction. Formulas:
`cam_crop2full` of CLIFF (Li et al., ECCV 2022) with the true principal point; the
rotation by the crop's ray is that of Henning et al. (ECCV 2022, Section 3.3).
"""

import numpy as np
from jaxtyping import Float

from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.types import Intrinsics

_MIN_SIZE_PX = 1e-9
"""Least size, px, which avoids a division by 0; far below that of any person."""


def full_translation(
    camera: Float[np.ndarray, "m 3"],
    box: Float[np.ndarray, "m 3"],
    intrinsics: Intrinsics,
) -> Float[np.ndarray, "m 3"]:
    """Returns `trans` (m) of bodies given as `(s, tx, ty)` in square boxes `(cx, cy,
    side px)`.

    Distortion is ignored: it moves a box's centre, whose own error is larger.
    """
    fx, fy, px, py = intrinsics.params[:4]
    s, tx, ty = camera.T
    cx, cy, side = box.T
    scale = side * s + _MIN_SIZE_PX
    z = 2 * fx / scale
    x = tx + 2 * (cx - px) / scale
    # With fx != fy a row of the crop spans fx / fy as many metres as a column.
    y = ty * fx / fy + 2 * (cy - py) / scale * fx / fy
    return np.stack([x, y, z], axis=-1)


def turn_to_camera(
    orientation: Float[np.ndarray, "m 3"],
    box: Float[np.ndarray, "m 3"],
    intrinsics: Intrinsics,
) -> Float[np.ndarray, "m 3"]:
    """Returns root rotations (axis-angle, rad) in the camera, of those relative to each
    crop's ray; NaN where a rotation or box is not finite.

    The pelvis does not move: rotations pivot at `J_0(β) + trans`.
    """
    fx, fy, px, py = intrinsics.params[:4]
    ray = np.stack([(box[:, 0] - px) / fx, (box[:, 1] - py) / fy], axis=-1)
    finite = np.isfinite(np.hstack([orientation, ray])).all(axis=1, keepdims=True)
    ray, turn = np.where(finite, ray, 0.0), np.where(finite, orientation, 0.0)
    turned = so3.compose(so3.optical_axis_to_ray(ray), turn)
    return np.where(finite, turned, np.nan)
