"""Image files -> pixels, by OpenCV, after a look at their headers."""

import io
import warnings
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io import budget
from bodyslam_jax.io.files import open_binary, read_bytes, reading

_FORMATS = ("JPEG", "MPO", "PNG", "BMP", "TIFF", "WEBP", "GIF", "PPM", "JPEG2000")
"""Formats, by Pillow's names, of which both Pillow and OpenCV know the header."""

_PNG = b"\x89PNG\r\n\x1a\n"


def read_image(path: Path, flag: int = cv2.IMREAD_COLOR) -> np.ndarray:
    """Returns the pixels of an image, BGR or as OpenCV's `flag` says.

    **Raises:** `InputError`, naming the file, if it is no image, is damaged, or has
    more pixels by its header than the budget allows; those are never decoded.
    """
    # Through memory: `imread` cannot open every path and warns on standard error.
    data = read_bytes(path, "an image")
    _check_header(path, data)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flag) if data else None
    except cv2.error:
        image = None
    if image is None:
        raise InputError(f"{path}: not an image that OpenCV can read.")
    return image


def exif_focal_35mm(path: Path) -> float | None:
    """Returns the focal length in a photo's EXIF data, mm for film of 35 mm, or
    `None`."""
    try:
        with open_binary(path, "an image") as file, reading(path, "an image"):
            with _header(file) as opened:
                # EXIF's own tags, and FocalLengthIn35mmFilm (Exif 2.2).
                found = float(opened.getexif().get_ifd(0x8769).get(0xA405) or 0)
    except InputError:  # what no one needs must not stop a run
        return None
    # Lenses that exist; others are errors of the file.
    return found if 5 <= found <= 500 else None


def _check_header(path: Path, data: bytes) -> None:
    """Refuses what is no image, and one of absurd size."""
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with _header(io.BytesIO(data)) as opened:
                size = opened.size
    except Image.DecompressionBombError:
        raise InputError(
            f"{path}: an image of absurd size by its header, expected at most "
            f"{budget.MAX_PIXELS / 1e6:.0f} million pixels."
        ) from None
    except Exception:
        raise InputError(f"{path}: not an image that OpenCV can read.") from None
    budget.check_pixels(path, *size)
    if data.startswith(_PNG) and not _is_whole_png(data):
        raise InputError(f"{path}: a PNG image that is cut short or damaged.")


def _is_whole_png(data: bytes) -> bool:
    """Returns True if the chunks of a PNG lie within it: OpenCV would allocate what one
    claims to have, up to 2 GB."""
    at = len(_PNG)
    # A box has a head of 8 bytes.
    while at + 8 <= len(data):
        at += 12 + int.from_bytes(data[at : at + 4], "big")
        if data[at - 8 : at - 4] == b"IEND":
            return True
    return at <= len(data)


def _header(file: Any) -> Any:
    """Returns the image, of which Pillow has read no more than the header."""
    from PIL import Image

    Image.init()
    return Image.open(file, formats=[name for name in _FORMATS if name in Image.OPEN])
