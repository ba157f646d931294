"""A sequence whose intrinsics were refined: what its bodies and keypoints become."""

import dataclasses

import numpy as np
from jaxtyping import Float

from bodyslam_jax.types import Sequence


def with_intrinsics(
    sequence: Sequence,
    intrinsics: Float[np.ndarray, " i"],
    zoom: Float[np.ndarray, " t"] | None = None,
) -> Sequence:
    """The sequence with other intrinsics, and bodies and keypoints to match.

    Regressed bodies keep their position and size in the image: a regressor reads depth
    off the size, so depth is proportional to the focal length.

    Args:
        zoom: logarithm of each frame's focal length over that of `intrinsics`. The
            keypoints and bodies returned are those of the images with the zoom undone.
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
    size = np.exp(zoom)
    keypoints, bodies = sequence.keypoints, sequence.bodies
    if keypoints is not None:
        centre = np.asarray(sequence.intrinsics.params[2:4], float)
        uv = centre + (keypoints.uv - centre) / size[:, None, None]
        uv = np.where(keypoints.confidence[..., None] > 0, uv, keypoints.uv)
        keypoints = dataclasses.replace(keypoints, uv=uv)
    if bodies is not None:
        # The same offset from the optical axis; depth in proportion to magnification.
        trans = bodies.trans * np.stack([size * 0 + 1, size * 0 + 1, size], axis=-1)
        bodies = dataclasses.replace(bodies, trans=trans)
    return dataclasses.replace(sequence, keypoints=keypoints, bodies=bodies)
