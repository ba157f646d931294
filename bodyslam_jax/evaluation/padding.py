"""Pads trajectories to equal shapes, so that they share compiled programs and can be
stacked.

Padding is masked: errors equal those of the unpadded trajectories up to rounding.
"""

from typing import Any, Literal

import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from bodyslam_jax.evaluation.errors import Trajectories

_MIN_BUCKET_FRAMES = 64
_BUCKET_GROWTH_FACTOR = 4


def bucket(num_frames: int) -> int:
    """Returns the length to pad to: 64, 256, 1024, ...

    Compiling takes seconds, evaluating masked frames milliseconds: hence few buckets.
    """
    size = _MIN_BUCKET_FRAMES
    while size < num_frames:
        size *= _BUCKET_GROWTH_FACTOR
    return size


def pad_frames(trajectories: Trajectories, num_frames: int) -> Trajectories:
    """Returns the trajectories with masked frames appended, up to `num_frames`."""
    t = trajectories
    if num_frames == t.T_WC.shape[0]:
        return t
    T_WC, camera_valid, joints, present, feet = map(
        jnp.asarray,
        padded_frames(
            (t.T_WC, t.camera_valid, t.joints, t.present, t.feet), num_frames
        ),
    )
    return Trajectories(T_WC, camera_valid, joints, present, feet, t.fps)


def padded_frames(arrays: tuple[Any, ...], num_frames: int) -> tuple[Any, ...]:
    """Returns the arrays of `Trajectories`, `T_WC` to `feet`, with masked frames
    appended."""
    T_WC, camera_valid, joints, present, feet = arrays
    missing = num_frames - len(T_WC)
    return (
        _pad(T_WC, 0, missing, "edge"),
        _pad(camera_valid, 0, missing),
        _pad(joints, 1, missing, "edge"),
        _pad(present, 1, missing),
        _pad(feet, 1, missing, "edge"),
    )


def pad_people(trajectories: Trajectories, num_people: int) -> Trajectories:
    """Returns the trajectories with people appended who are never present, up to
    `num_people`.

    The errors of these are NaN, and means over people leave them out.
    """
    missing = num_people - trajectories.present.shape[0]
    if not missing:
        return trajectories
    return Trajectories(
        trajectories.T_WC,
        trajectories.camera_valid,
        jnp.asarray(_pad(trajectories.joints, 0, missing)),
        jnp.asarray(_pad(trajectories.present, 0, missing)),
        jnp.asarray(_pad(trajectories.feet, 0, missing)),
        trajectories.fps,
    )


def to_bucket(trajectories: Trajectories) -> Trajectories:
    """Returns the trajectories padded by `pad_frames` to the length `bucket`."""
    return pad_frames(trajectories, bucket(trajectories.T_WC.shape[0]))


def _pad(
    x: Any, axis: int, missing: int, mode: Literal["constant", "edge"] = "constant"
) -> Any:
    widths = [(0, missing * (i == axis)) for i in range(x.ndim)]
    if isinstance(x, jax.core.Tracer):
        return jnp.pad(x, widths, mode)
    # NumPy is used because `jnp.pad` would be compiled for each shape.
    return np.pad(np.asarray(x), widths, mode)
