"""Keypoints in the frames of a phone's video as stored, before its rotation tag."""

import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax.body.skeleton import BODY25
from bodyslam_jax.io.frame_index import Warn

_BEYOND, _WITHIN = 0.02, 0.995
"""Share of points outside the video, and within the rotated one, at least."""
_LYING = 0.8
"""Share of people whose trunk is horizontal, at least."""
_NECK, _MID_HIP = BODY25["neck"], BODY25["mid_hip"]


def turned_back(
    points: Float[np.ndarray, "m 25 3"],
    sure: Bool[np.ndarray, "m 25"],
    size: tuple[int, int],
    warn: Warn,
) -> Float[np.ndarray, "m 25 2"] | None:
    """Pixels of the video of `size` (width, height), if the points fit a video of
    height x width in which people lie; `None` if they do not.

    The rotation is the one that turns heads up.

    Args:
        points: u px, v px, confidence.
        sure: points whose position is trusted.
    """
    width, height = size
    uv = points[..., :2]
    inside = lambda limit: ((uv[sure] >= 0) & (uv[sure] <= limit)).all(axis=-1)
    beyond = np.any(uv[sure] > np.array([width, height]), axis=-1)
    if not len(beyond) or beyond.mean() < _BEYOND:
        return None
    trunk = (uv[:, _MID_HIP] - uv[:, _NECK])[sure[:, _NECK] & sure[:, _MID_HIP]]
    across = np.abs(trunk[:, 0]) > 2 * np.abs(trunk[:, 1])
    if inside(np.array([height, width])).mean() < _WITHIN or not len(trunk):
        return None
    right = float((across & (trunk[:, 0] < 0)).mean())  # heads
    left = float((across & (trunk[:, 0] > 0)).mean())
    if max(left, right) < _LYING:
        return None
    warn(
        f"keypoints are of a video of {height}x{width} px in which people lie, this "
        f"one has {width}x{height} px: taken as detected before the video's rotation "
        "was applied, and turned."
    )
    u, v = uv[..., 0], uv[..., 1]
    if right > left:  # the stored image is the shown one turned clockwise
        return np.stack([v, height - 1 - u], axis=-1)
    return np.stack([width - 1 - v, u], axis=-1)
