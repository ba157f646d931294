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

_LYING = 55.0
"""Angle from the image's vertical beyond which a trunk is lying, degrees."""
_WIDE = 0.15
"""Width of hips and shoulders over the length of the trunk above which front and back
are distinguishable."""


def trunk_directions(uv: Float[np.ndarray, "*n 14 2"]) -> Float[np.ndarray, "*n"]:
    """Direction from neck to hips, rad: 0 points down, positive to the image's right.

    NaN where visible legs point another way, as of people who bend or sit.
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
    """Number of people in all frames, and the shares of those who are upright, upside
    down, or whose heads point to the left or to the right."""
    angle = np.degrees(directions[np.isfinite(directions)])
    if not len(angle):
        return 0, dict.fromkeys(("upright", "upside down", "left", "right"), 0.0)
    lying = np.abs(np.abs(angle) - 90) < 90 - _LYING
    return len(angle), {
        "upright": float((np.abs(angle) <= _LYING).mean()),
        "upside down": float((np.abs(angle) >= 180 - _LYING).mean()),
        "left": float((lying & (angle > 0)).mean()),
        "right": float((lying & (angle < 0)).mean()),
    }


def facings(uv: Float[np.ndarray, "*n 14 2"]) -> Float[np.ndarray, "*n"]:
    """Signed width of shoulders and hips over the trunk's length: positive from behind,
    negative from the front; NaN if unknown."""
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
    """Where the facing is distinguishable in both, and where both contradict."""
    a, b = facings(detected), facings(projected)
    shown = (np.abs(np.nan_to_num(a)) > _WIDE) & (np.abs(np.nan_to_num(b)) > _WIDE)
    return shown, shown & (np.nan_to_num(a) * np.nan_to_num(b) < 0)
