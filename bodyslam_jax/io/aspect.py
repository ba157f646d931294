"""Pixels that are not square: what the file says of them, and what the camera does.

Images are never stretched: keypoints, masks and results stay in the pixels that are
stored, and the two focal lengths differ. `fx / fy` is the height of a pixel over its
width.
"""

import dataclasses

import numpy as np

from bodyslam_jax.io.video import Footage
from bodyslam_jax.types import Intrinsics

_SQUARE = 0.01
"""Difference from 1 of a ratio that is 1."""


def at_size_of(intrinsics: Intrinsics, footage: Footage) -> Intrinsics:
    """The camera in the pixels that are stored, where it was given for those shown:
    players stretch the images of such a video to square pixels."""
    shown = round(footage.width * footage.pixel_aspect), footage.height
    stored = footage.width, footage.height
    if shown == stored or (intrinsics.width, intrinsics.height) != shown:
        return intrinsics
    ratio = footage.width / shown[0]
    params = np.array(intrinsics.params, float)
    params[0] *= ratio
    params[2] = (params[2] + 0.5) * ratio - 0.5
    return dataclasses.replace(intrinsics, params=params, width=footage.width)


def aspect_warnings(intrinsics: Intrinsics, footage: Footage) -> tuple[str, ...]:
    """What is to be said of pixels that are not square."""
    said = footage.pixel_aspect
    used = float(intrinsics.params[1] / intrinsics.params[0])
    if abs(said - 1) < _SQUARE:
        return ()
    name = footage.path.name
    if abs(used / said - 1) < _SQUARE:
        return (
            f"{name}: its pixels are {said:.4g} times as wide as high, as it says "
            "itself: fx and fy differ by that.",
        )
    return (
        f"{name}: says that its pixels are {said:.4g} times as wide as high, but "
        f"camera.json has fy/fx = {used:.4g}: camera.json used.",
    )
