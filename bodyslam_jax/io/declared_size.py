"""Sizes of images that a file declares, compared with that of the video."""

from pathlib import Path
from typing import Any

import numpy as np

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io.frame_index import InvalidContent, Warn

Size = tuple[float, float]
"""Width and height, px."""

ASPECT_TOLERANCE = 0.015
"""Largest relative difference of two aspect ratios that rounding to even sizes may
cause."""
_MAX_SIDE_PX = 1e6
"""Largest side of an image, px."""
_MIN_OUTSIDE_SHARE = 0.1
"""Least share of the points outside the declared size with which the points do not
belong to that size."""


def size_in(path: Path, data: Any) -> Size | None:
    """Returns the size that the header of a file of keypoints names, or None.

    COCO has it with each image; others as `width` and `height`, or as two numbers under
    one name: `image_size` and `resolution` with the width first, `img_shape` and
    `ori_shape`, as MMPose and NumPy have it, with the height first.

    **Raises:** `InputError` if images of one file differ in size.
    """
    if not isinstance(data, dict):
        return None
    images = data.get("images")
    found = {
        size
        for image in (images if isinstance(images, list) else [])
        if isinstance(image, dict) and (size := _pair(image)) is not None
    }
    if len(found) > 1:
        (a, b), (c, d) = sorted(found)[:2]
        raise InputError(f"{path}: images of {a:g}x{b:g} px and of {c:g}x{d:g} px.")
    if found:
        return found.pop()
    for part in (data, *(data.get(k) for k in ("meta_info", "dataset_meta", "info"))):
        if isinstance(part, dict) and (size := _pair(part)) is not None:
            return size
    return None


def _pair(data: dict[str, Any]) -> Size | None:
    for width, height in (("width", "height"), ("image_width", "image_height")):
        if width in data and height in data:
            return _size(data[width], data[height])
    for key in ("image_size", "img_size", "resolution"):
        if (two := _two(data.get(key))) is not None:
            return _size(*two)
    for key in ("img_shape", "ori_shape", "image_shape"):
        if (two := _two(data.get(key))) is not None:
            return _size(*two[::-1])
    return None


def _two(value: Any) -> tuple[Any, Any] | None:
    if not isinstance(value, list | tuple | np.ndarray) or len(value) not in (2, 3):
        return None
    return value[0], value[1]


def _size(width: Any, height: Any) -> Size | None:
    try:
        size = float(width), float(height)
    except (TypeError, ValueError, OverflowError):
        return None
    return size if all(2 <= n <= _MAX_SIDE_PX for n in size) else None


def factor_to(
    declared: Size,
    size: tuple[int, int],
    points: np.ndarray,
    what: str,
    warn: Warn,
) -> float:
    """Returns the factor, for `scaled`, from pixels of images of size `declared` to
    pixels of the video of `size` (width, height).

    Args:
        points: some of the points (n, 2; px), to check that they fit images of the
            declared size.
        what: the points are, for messages.

    **Raises:** `InvalidContent` if the images are of another aspect, or turned.
    """
    (w, h), (width, height) = declared, size
    if (w, h) == (width, height):
        return 1.0
    names = f"images of {w:g}x{h:g} px, but the video has {width}x{height} px"
    aspect = (w / h) / (width / height)
    if abs(np.log(aspect)) > ASPECT_TOLERANCE:
        turned = abs(np.log((h / w) / (width / height))) < ASPECT_TOLERANCE
        why = "of the video before it was turned upright" if turned else "cropped"
        raise InvalidContent(f"{what} of {names}: {why}, or of another video?")
    factor = float(np.sqrt(width / w * height / h))
    outside = (points > np.asarray(declared)).any(axis=-1)
    if factor > 1 and len(points) and outside.mean() > _MIN_OUTSIDE_SHARE:
        warn(
            f"{what} of {names}, though {100 * outside.mean():.0f} % of them are "
            "beyond that size: taken as pixels of the video."
        )
        return 1.0
    warn(f"{what} of {names}: multiplied by {factor:.4g}.")
    return factor


def scaled(uv: np.ndarray, factor: float) -> np.ndarray:
    """Returns pixels in images resized by `factor`, which keeps the images' corners,
    not the centres of pixels."""
    return (uv + 0.5) * factor - 0.5
