"""Detects calibrations that do not fit the images, by the mistakes that people make.

A focal length of some px, or a principal point in a corner, is in other units; a
principal point whose coordinates are exchanged, or that is the middle of another image,
is one of a file that was written wrongly or is of other images.
"""

import dataclasses

import numpy as np

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io.frame_index import Warn
from bodyslam_jax.types import Intrinsics

_MIN_FOCAL_RATIO = 0.2
"""Least focal length relative to the longer side of the image: a view of 136 degrees.
The widest lenses that keep lines straight have 0.25 (9 mm on 36 mm of film), fisheye
lenses about 0.3."""
_MAX_FOCAL_RATIO = 60.0
"""Largest focal length relative to the longer side: a view of one degree, as through a
telescope."""
_FILM_WIDTH_MM = 36.0
"""Longer side of the film to which focal lengths of lenses refer, mm."""
_MAX_NORMALISED_FOCAL = 10.0
"""Largest focal length in units of the image: 360 mm of film."""
_MAX_CENTRE_OFFSET, _MAX_EXCHANGED_RATIO = 0.03, 0.25
"""Largest distance of the principal point from the middle of the image, relative to its
longer side, that is usual; largest ratio by which that distance decreases where
exchanged coordinates are put back."""
_MIN_CROP_OFFSET = 0.1
"""Distance of the principal point from the middle from which there is a warning."""
_RATIO_TOLERANCE, _MIN_RESIZE = 0.02, 0.15
"""Largest relative difference of the two ratios of a resized image; least relative
change of its size."""
_COMMON_SIZES_PX = (
    *((640, 480), (1024, 768), (1280, 960), (1440, 1080), (1600, 1200), (1920, 1440)),
    *((4032, 3024), (640, 360), (854, 480), (960, 540), (1280, 720), (1920, 1080)),
    *((2704, 1520), (2560, 1440), (3840, 2160), (4096, 2160)),
)
"""Sizes of common cameras' images, px."""


def recognised(source: str, camera: Intrinsics, warn: Warn) -> Intrinsics:
    """Returns the camera, with exchanged coordinates of its principal point put back.

    Args:
        source: the file or option that it comes from, for messages.

    **Raises:** `InputError` if its numbers are in other units or of other images.
    """
    _check_focal(source, camera)
    width, height = camera.width, camera.height
    centre = np.asarray(camera.params[2:4], float)
    if (np.abs(centre) <= 1).all():
        middle = f"({(width - 1) / 2:g}, {(height - 1) / 2:g})"
        raise InputError(
            f"{source}: principal point {_point(centre)} px is the corner of an image "
            f"of {width}x{height} px: is it in units of the image, or relative to the "
            f"middle? Expected px, about {middle}."
        )
    middle = np.array([width - 1, height - 1]) / 2
    longer = max(width, height)
    away = float(np.linalg.norm(centre - middle)) / longer
    if away < _MAX_CENTRE_OFFSET:
        return camera
    put_back = float(np.linalg.norm(centre[::-1] - middle)) / longer
    if put_back < min(_MAX_CENTRE_OFFSET, _MAX_EXCHANGED_RATIO * away):
        return _put_back(source, camera, warn)
    _check_image(source, camera)
    if away > _MIN_CROP_OFFSET:
        warn(
            f"{source}: principal point {_point(centre)} px, "
            f"{away * longer:.0f} px from the middle of the image of {width}x{height} "
            "px: right for a video that was cropped, or a lens that is shifted; "
            "otherwise it is of another image."
        )
    return camera


def _check_focal(source: str, camera: Intrinsics) -> None:
    """Refuses focal lengths that are in units of the image, in mm, or none."""
    fx, fy, cx, cy = (float(x) for x in camera.params[:4])
    width, height = camera.width, camera.height
    longer = max(width, height)
    focal = (fx * fy) ** 0.5
    if focal > _MAX_FOCAL_RATIO * longer:
        raise InputError(
            f"{source}: focal length {focal:.4g} px for an image of {width}x{height} "
            f"px would be a view of {np.degrees(longer / focal):.2g} degrees; expected "
            "px of this image."
        )
    if focal >= _MIN_FOCAL_RATIO * longer:
        return
    view = 2 * np.degrees(np.arctan(longer / 2 / focal))
    found = (
        f"{source}: focal length {fx:.4g} px for an image of {width}x{height} px would "
        f"be a view of {view:.0f} degrees"
    )
    if max(fx, fy) < _MAX_NORMALISED_FOCAL and (abs(cx) <= 1 and abs(cy) <= 1):
        raise InputError(
            f"{found}: are these in units of the image (normalised)? Expected px, "
            f"which would be {fx * width:.0f} {fy * height:.0f} "
            f"{cx * width - 0.5:g} {cy * height - 0.5:g}."
        )
    raise InputError(
        f"{found}: is it in mm, or of another image? Expected px; {focal:.3g} mm on "
        f"film of {_FILM_WIDTH_MM:g} mm are {focal / _FILM_WIDTH_MM * longer:.0f} px, "
        "of a smaller sensor more."
    )


def _put_back(source: str, camera: Intrinsics, warn: Warn) -> Intrinsics:
    fx, fy, cx, cy = (float(x) for x in camera.params[:4])
    # A calibration of an image that was turned has all axes exchanged, a file with
    # exchanged coordinates of the centre has not.
    if abs(np.log(fx / fy)) > _RATIO_TOLERANCE:
        raise InputError(
            f"{source}: principal point {_point([cx, cy])} px is the middle of an "
            f"image of {camera.height}x{camera.width} px, not of this one of "
            f"{camera.width}x{camera.height} px: cx and cy are exchanged, or all of it "
            f"is of the image before it was turned; as fx and fy ({fx:.5g}, {fy:.5g}) "
            "differ it matters which. Expected parameters of the image as it is shown."
        )
    warn(
        f"{source}: principal point {_point([cx, cy])} px is the middle of the image "
        f"of {camera.width}x{camera.height} px with cx and cy exchanged: "
        f"{_point([cy, cx])} is used."
    )
    params = np.array(camera.params, float)
    params[2:4] = params[[3, 2]]
    return dataclasses.replace(camera, params=params)


def _check_image(source: str, camera: Intrinsics) -> None:
    """Refuses a principal point that is the middle of another image."""
    width, height = camera.width, camera.height
    of = 2 * np.asarray(camera.params[2:4], float) + 1
    ratio = of / [width, height]
    resized = (
        abs(np.log(ratio[0] / ratio[1])) < _RATIO_TOLERANCE if (of > 0).all() else 0
    )
    outside = (of < 0).any() or (of > 2 * np.array([width, height])).any()
    usual = [
        size
        for a, b in _COMMON_SIZES_PX
        for size in ((a, b), (b, a))
        if np.allclose(of, size, rtol=_RATIO_TOLERANCE)
    ]
    other = resized and abs(np.log(ratio[0])) > _MIN_RESIZE
    if not other and not (outside and usual):
        return
    size = usual[0] if usual else tuple(of.round().astype(int).tolist())
    more = ""
    if other:
        focal = camera.params[:2] / np.sqrt(np.prod(ratio))
        more = f": {focal[0]:.0f} {focal[1]:.0f} px, if that was resized to it"
    raise InputError(
        f"{source}: principal point {_point(camera.params[2:4])} px is the middle of "
        f"an image of {size[0]}x{size[1]} px, not of this one of {width}x{height} px; "
        f"expected the calibration of these images{more}."
    )


def _point(centre) -> str:
    return f"({float(centre[0]):.6g}, {float(centre[1]):.6g})"
