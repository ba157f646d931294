"""Orientation of people in the image: upright or lying, from the front or behind."""

import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax.diagnostics.agreement.image_points import (
    ANKLES,
    L_HIP,
    L_SHOULDER,
    MID_HIP,
    NECK,
    R_HIP,
    R_SHOULDER,
)

_MAX_UPRIGHT_ANGLE_DEG = 55.0
"""Angle between trunk and image vertical beyond which a person lies."""
_MIN_WIDTH_RATIO = 0.15
"""Ratio of the width of hips and shoulders to the length of the trunk from which front
and back are distinguishable."""


def trunk_directions(uv: Float[np.ndarray, "*n 14 2"]) -> Float[np.ndarray, "*n"]:
    """Returns the direction from neck to hips, rad: 0 points down, positive to the
    right of the image.

    NaN where visible legs point in another direction, as those of people who bend or
    sit.
    """
    trunk = uv[..., MID_HIP, :] - uv[..., NECK, :]
    ankles = uv[..., ANKLES, :]
    valid = np.isfinite(ankles[..., :1])
    count = valid.sum(-2)
    foot = np.where(valid, ankles, 0.0).sum(-2) / np.maximum(count, 1)
    leg = foot - uv[..., MID_HIP, :]
    with np.errstate(invalid="ignore"):
        straight = (leg * trunk).sum(-1) > 0.5 * np.linalg.norm(
            leg, axis=-1
        ) * np.linalg.norm(trunk, axis=-1)
    angle = np.arctan2(trunk[..., 0], trunk[..., 1])
    return np.where((count[..., 0] == 0) | straight, angle, np.nan)


def shares(
    directions: Float[np.ndarray, "*n"],
) -> tuple[int, dict[str, float]]:
    """Returns the number of people in all frames with a known direction, and the shares
    of those who are upright, upside down, or lie with the head to the left or right."""
    angle = np.degrees(directions[np.isfinite(directions)])
    if not len(angle):
        return 0, dict.fromkeys(("upright", "upside down", "left", "right"), 0.0)
    lying = np.abs(np.abs(angle) - 90) < 90 - _MAX_UPRIGHT_ANGLE_DEG
    return len(angle), {
        "upright": float((np.abs(angle) <= _MAX_UPRIGHT_ANGLE_DEG).mean()),
        "upside down": float((np.abs(angle) >= 180 - _MAX_UPRIGHT_ANGLE_DEG).mean()),
        "left": float((lying & (angle > 0)).mean()),
        "right": float((lying & (angle < 0)).mean()),
    }


def facings(uv: Float[np.ndarray, "*n 14 2"]) -> Float[np.ndarray, "*n"]:
    """Returns the signed width of shoulders and hips over the trunk's length: positive
    from behind, negative from the front, NaN if unknown."""
    trunk = uv[..., MID_HIP, :] - uv[..., NECK, :]
    across = (
        uv[..., R_SHOULDER, :]
        - uv[..., L_SHOULDER, :]
        + uv[..., R_HIP, :]
        - uv[..., L_HIP, :]
    ) / 2
    length2 = np.maximum((trunk**2).sum(-1), 1.0)
    return (across[..., 0] * trunk[..., 1] - across[..., 1] * trunk[..., 0]) / length2


def opposed(
    detected: Float[np.ndarray, "*n 14 2"], projected: Float[np.ndarray, "*n 14 2"]
) -> tuple[Bool[np.ndarray, "*n"], Bool[np.ndarray, "*n"]]:
    """Returns where both facings are distinguishable, and where they also contradict
    each other."""
    a, b = facings(detected), facings(projected)
    shown = (np.abs(np.nan_to_num(a)) > _MIN_WIDTH_RATIO) & (
        np.abs(np.nan_to_num(b)) > _MIN_WIDTH_RATIO
    )
    return shown, shown & (np.nan_to_num(a) * np.nan_to_num(b) < 0)
