"""Trajectories of equal shapes, so that lengths share compiled programs and stack.

What is added is masked: errors are those of the unpadded trajectories, to rounding.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

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
    missing = num_frames - trajectories.T_WC.shape[0]
    if not missing:
        return trajectories
    return Trajectories(
        _pad(trajectories.T_WC, 0, missing, "edge"),
        _pad(trajectories.camera_valid, 0, missing),
        _pad(trajectories.joints, 1, missing, "edge"),
        _pad(trajectories.present, 1, missing),
        _pad(trajectories.feet, 1, missing, "edge"),
        trajectories.fps,
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
        _pad(trajectories.joints, 0, missing),
        _pad(trajectories.present, 0, missing),
        _pad(trajectories.feet, 0, missing),
        trajectories.fps,
    )


def to_bucket(trajectories: Trajectories) -> Trajectories:
    """`pad_frames` up to `bucket`."""
    return pad_frames(trajectories, bucket(trajectories.T_WC.shape[0]))


def _pad(x: Array, axis: int, missing: int, mode: str = "constant") -> Array:
    widths = [(0, missing * (i == axis)) for i in range(x.ndim)]
    if isinstance(x, jax.core.Tracer):
        return jnp.pad(x, widths, mode)
    # On the host: `jnp.pad` would be compiled for each shape.
    pad = np.pad(np.asarray(x), widths, mode)  # pyright: ignore[reportCallIssue]
    return jnp.asarray(pad)
