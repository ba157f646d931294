"""Adapts the bodies and keypoints of a sequence to refined intrinsics."""

import dataclasses

import numpy as np
from jaxtyping import Float

from bodyslam_jax.types import Sequence


def with_intrinsics(
    sequence: Sequence,
    intrinsics: Float[np.ndarray, " i"],
    zoom: Float[np.ndarray, " t"] | None = None,
) -> Sequence:
    """Returns the sequence with other intrinsics, and with bodies and keypoints to
    match.

    Regressed bodies keep their position and size in the image: a regressor infers depth
    from size, so depth is proportional to the focal length.

    Args:
        intrinsics: new intrinsics, px.
        zoom: logarithm of each frame's focal length over that of `intrinsics`. The
            returned keypoints and bodies are those of images without the zoom.
    """
    if zoom is not None:
        sequence = _without_zoom(sequence, zoom)
    given = sequence.intrinsics
    if np.array_equal(given.params, intrinsics):
        return sequence
    bodies = sequence.bodies
    if bodies is not None:
        # The model may have gained distortion, or pixels that are not square.
        focal = np.sqrt(intrinsics[0] * intrinsics[1])
        focal /= np.sqrt(given.params[0] * given.params[1])
        ratio = np.array([1.0, 1.0, focal])
        bodies = dataclasses.replace(bodies, trans=bodies.trans * ratio)
    return dataclasses.replace(
        sequence,
        intrinsics=dataclasses.replace(given, params=intrinsics),
        bodies=bodies,
    )


def _without_zoom(sequence: Sequence, zoom: Float[np.ndarray, " t"]) -> Sequence:
    """Returns the sequence with keypoints and bodies as seen without the zoom."""
    size = np.exp(zoom)
    keypoints, bodies = sequence.keypoints, sequence.bodies
    if keypoints is not None:
        centre = np.asarray(sequence.intrinsics.params[2:4], float)
        uv = centre + (keypoints.uv - centre) / size[:, None, None]
        uv = np.where(keypoints.confidence[..., None] > 0, uv, keypoints.uv)
        keypoints = dataclasses.replace(keypoints, uv=uv)
    if bodies is not None:
        # The offset from the optical axis is kept; depth is proportional to the zoom.
        trans = bodies.trans * np.stack([size * 0 + 1, size * 0 + 1, size], axis=-1)
        bodies = dataclasses.replace(bodies, trans=trans)
    return dataclasses.replace(sequence, keypoints=keypoints, bodies=bodies)
