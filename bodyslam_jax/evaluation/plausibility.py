"""Plausibility of an estimate or a truth: gravity, feet, knees, acceleration.

Errors of trajectories do not show that a person slides, floats or crouches. These are
the quantities by which `bodyslam_jax.diagnostics` judges a result, as functions that
jit and vmap; they are reported for the estimate and for the truth.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from bodyslam_jax.body.skeleton import (
    ANKLES,
    ANKLES_AND_FEET,
    FEET,
    HIPS,
    KNEES,
    NECK,
    PELVIS,
)
from bodyslam_jax.evaluation.metrics import norm, only

_HIPS, _KNEES, _ANKLES, _FEET = map(np.array, (HIPS, KNEES, ANKLES, FEET))
_ANKLES_AND_FEET = np.array(ANKLES_AND_FEET)
_MIN_TRUNK_COSINE = float(np.cos(np.radians(35.0)))
"""Cosine of the angle between people's mean trunk and the up axis from which that axis
is known: cos 35°."""
UP = np.array([0.0, 1.0, 0.0])
"""Up in a result."""


def up_axis(
    joints: Float[Array, "h t 24 3"], present: Bool[Array, "h t"]
) -> tuple[Float[Array, " 3"], Bool[Array, ""]]:
    """Returns the world axis that points up, and whether it is known.

    It is the axis nearest to the mean direction of people's trunks, and known if that
    is within 35 degrees.
    """
    trunk = jnp.where(
        present[..., None], joints[..., NECK, :] - joints[..., PELVIS, :], 0
    )
    total = jnp.sum(trunk, (0, 1))
    largest = jnp.argmax(jnp.abs(total))
    sign = jnp.where(total[largest] < 0, -1, 1).astype(joints.dtype)
    axis = jnp.zeros(3, joints.dtype).at[largest].set(sign)
    known = jnp.abs(total[largest]) > _MIN_TRUNK_COSINE * norm(total)
    return axis, known


def gravity_error(
    T_WC: Float[Array, "t 4 4"],
    true_T_WC: Float[Array, "t 4 4"],
    valid: Bool[Array, " t"],
    true_up: Float[Array, " 3"],
) -> Float[Array, ""]:
    """Returns the mean angle between the up directions of estimate (y) and truth in the
    camera frame, rad; it needs no alignment. NaN without cameras."""
    T, true_T = (
        jnp.where(valid[:, None, None], x, jnp.eye(4, dtype=x.dtype))
        for x in (T_WC, true_T_WC)
    )
    up = T[:, 1, :3]
    true_up_C = jnp.einsum("tji,j->ti", true_T[:, :3, :3], true_up)
    # The arc cosine is inaccurate at small angles.
    angle = jnp.arctan2(norm(jnp.cross(up, true_up_C)), jnp.sum(up * true_up_C, -1))
    return _mean(angle, valid)


def posture_figures(
    joints: Float[Array, "t 24 3"],
    valid: Bool[Array, " t"],
    up: Float[Array, " 3"],
    fps: Float[Array, ""],
) -> dict[str, Float[Array, ""]]:
    """Returns figures of one person's posture and motion, in rad, m, s.

    `knee`, `straighter_knee`: mean angle between thigh and shin, of both and of the
    straighter leg. `feet_low`, `feet_high`: 5th and 95th percentile of the height of
    the lowest of ankle and toe joints, over the world's zero. `foot_speed`: median
    horizontal speed of the lower toe joint. `joint_acceleration`: median over joints
    and frames.
    """
    (joints,) = only(valid, joints)
    thigh = joints[:, _KNEES] - joints[:, _HIPS]
    shin = joints[:, _ANKLES] - joints[:, _KNEES]
    knee = jnp.arctan2(norm(jnp.cross(thigh, shin)), jnp.sum(thigh * shin, -1))
    lowest = jnp.min(joints[:, _ANKLES_AND_FEET] @ up, 1)
    feet = joints[:, _FEET]
    step = jnp.diff(feet, axis=0)
    flat = norm(step - (step @ up)[..., None] * up) * fps
    lower = jnp.argmin(feet[:-1] @ up, 1)
    speed = jnp.take_along_axis(flat, lower[:, None], 1)[:, 0]
    two = valid[1:] & valid[:-1]
    bent = norm(jnp.diff(joints, n=2, axis=0)) * fps**2
    three = two[1:] & two[:-1]
    return {
        "knee": _mean(jnp.mean(knee, 1), valid),
        "straighter_knee": _mean(jnp.min(knee, 1), valid),
        "feet_low": _quantile(lowest, valid, 0.05),
        "feet_high": _quantile(lowest, valid, 0.95),
        "foot_speed": _quantile(speed, two, 0.5),
        "joint_acceleration": _quantile(bent, three[:, None], 0.5),
    }


FIGURES = (
    "knee",
    "straighter_knee",
    "feet_low",
    "feet_high",
    "foot_speed",
    "joint_acceleration",
)
"""Names of `posture_figures`; those of the truth have the suffix `_of_truth`."""


def _mean(x: Float[Array, " n"], valid: Bool[Array, " n"]) -> Float[Array, ""]:
    count = jnp.sum(valid).astype(x.dtype)
    total = jnp.sum(jnp.where(valid, x, 0))
    return jnp.where(count > 0, total / jnp.maximum(count, 1), jnp.nan)


def _quantile(
    x: Float[Array, "*n"], valid: Bool[Array, "*#n"], share: float
) -> Float[Array, ""]:
    """Returns a quantile of the valid values; NaN without any, or if one of them is
    NaN."""
    if not x.size:  # differences of one frame or two
        return jnp.full((), jnp.nan, x.dtype)
    broken = jnp.any(jnp.isnan(x) & valid)
    found = jnp.nanquantile(jnp.where(valid, x, jnp.nan), jnp.asarray(share, x.dtype))
    return jnp.where(broken, jnp.nan, found)
