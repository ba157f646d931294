"""Trajectories of equal shapes, so that lengths share compiled programs and stack.

What is added is masked: errors are those of the unpadded trajectories, to rounding.
"""

from typing import Any, Literal

import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from bodyslam_jax.evaluation.errors import Trajectories

_SMALLEST = 64
_GROWTH = 4


def bucket(num_frames: int) -> int:
    """The length to pad to: 64, 256, 1024, ...

    Compiling takes seconds, evaluating masked frames milliseconds: hence few buckets.
    """
    size = _SMALLEST
    while size < num_frames:
        size *= _GROWTH
    return size


def pad_frames(trajectories: Trajectories, num_frames: int) -> Trajectories:
    """The same with masked frames added at the end, up to `num_frames`."""
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
    """The same arrays of `Trajectories`, `T_WC` to `feet`, with masked frames added."""
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
    """The same with people who are never present added, up to `num_people`.

    Their own errors are NaN, and means over people leave them out.
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
    """`pad_frames` up to `bucket`."""
    return pad_frames(trajectories, bucket(trajectories.T_WC.shape[0]))


def _pad(
    x: Any, axis: int, missing: int, mode: Literal["constant", "edge"] = "constant"
) -> Any:
    widths = [(0, missing * (i == axis)) for i in range(x.ndim)]
    if isinstance(x, jax.core.Tracer):
        return jnp.pad(x, widths, mode)
    # On the host: `jnp.pad` would be compiled for each shape.
    return np.pad(np.asarray(x), widths, mode)
