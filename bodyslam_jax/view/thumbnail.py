"""A small still image of a video, for pages that list many."""

from pathlib import Path

import cv2

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io import atomic
from bodyslam_jax.io.video import open_video

_WIDTH_PX, _JPEG_QUALITY = 240, 70
"""px; of JPEG, 0 to 100"""


def write_thumbnail(video: Path, path: Path) -> bool:
    """Writes the middle frame as JPEG; returns False if the video has none.

    A file that is newer than the video is kept.
    """
    if path.exists() and path.stat().st_mtime >= video.stat().st_mtime:
        return True
    try:
        capture = open_video(video)
    except InputError:
        return False
    try:
        count = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        capture.set(cv2.CAP_PROP_POS_FRAMES, max(0, count // 2))
        found, image = capture.read()
    finally:
        capture.release()
    if not found:
        return False
    height = max(1, round(image.shape[0] * _WIDTH_PX / image.shape[1]))
    small = cv2.resize(image, (_WIDTH_PX, height), interpolation=cv2.INTER_AREA)
    encoded, data = cv2.imencode(
        ".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    )
    if encoded:
        atomic.write_bytes(path, data.tobytes())
    return encoded
