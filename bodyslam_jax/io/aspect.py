"""Pixels that are not square: the container's aspect ratio against the calibration's.

Images are never stretched: keypoints, masks and results are in the stored pixels, and
fx differs from fy. `fy / fx` is the width of a pixel over its height.
"""

import dataclasses

import numpy as np

from bodyslam_jax.io.video import Footage
from bodyslam_jax.types import Intrinsics

_ASPECT_TOLERANCE = 0.01
"""Difference of an aspect ratio from 1 up to which it counts as 1."""


def at_size_of(intrinsics: Intrinsics, footage: Footage) -> Intrinsics:
    """Returns the camera in stored pixels, if it was calibrated in images that a player
    has stretched to square pixels; unchanged otherwise."""
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
    """Returns warnings about pixels that are not square."""
    declared = footage.pixel_aspect
    used = float(intrinsics.params[1] / intrinsics.params[0])
    if abs(declared - 1) < _ASPECT_TOLERANCE:
        return ()
    name = footage.path.name
    if abs(used / declared - 1) < _ASPECT_TOLERANCE:
        return (
            f"{name}: pixels {declared:.4g} times as wide as high, by the container: "
            "fx and fy differ by that.",
        )
    return (
        f"{name}: pixels {declared:.4g} times as wide as high, by the container, but "
        f"camera.json has fy/fx = {used:.4g}: camera.json used.",
    )
