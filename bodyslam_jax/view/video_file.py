"""Video files that browsers play: `.webm` by OpenCV, `.mp4` (H.264) by PyAV.

A thumbnail is a small still image of such a file, for pages that list many.
"""

import concurrent.futures
import contextlib
import errno
import importlib.util
import os
import sys
from collections.abc import Iterable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Literal

import cv2

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io import atomic
from bodyslam_jax.io.video import open_video
from bodyslam_jax.view.style import Image

Codec = Literal["VP8", "VP9", "H264"]
_H264_RATE_FACTOR = "24"
"""Constant rate factor of H.264: smaller is better and larger; 18 to 28 is usual."""
_THUMBNAIL_WIDTH_PX, _THUMBNAIL_QUALITY = 240, 70
"""Width, px, and quality of JPEG, 0 to 100."""


def check_codec(codec: Codec) -> None:
    """Checks that the encoder is installed.

    **Raises:** `InputError`, which says how to install it, if H.264 is not.
    """
    if codec == "H264" and importlib.util.find_spec("av") is None:
        raise InputError(
            "overlay_video mp4: PyAV is not installed, expected the extra `video`; "
            "pip install 'bodyslam-jax[video]'."
        )


def write_video(
    path: Path,
    pictures: Iterable[Image],
    size: tuple[int, int],
    fps: float,
    codec: Codec = "VP8",
) -> int:
    """Writes pictures of one size (width, height: even numbers); returns their number.

    **Raises:** `InputError` if there is no such encoder; `OSError` if the video could
    not be written whole.
    """
    check_codec(codec)
    open_ = _h264 if codec == "H264" else _opencv
    number = 0
    # Encoding and drawing run in parallel: both release Python's lock.
    with (
        open_(path, size, fps, codec) as write,
        concurrent.futures.ThreadPoolExecutor(1) as encoder,
    ):
        pending = None
        for number, picture in enumerate(pictures, start=1):
            if pending is not None:
                pending.result()
            pending = encoder.submit(write, picture)
        if pending is not None:
            pending.result()
    check_length(path, number)
    return number


@contextlib.contextmanager
def _opencv(path: Path, size: tuple[int, int], fps: float, codec: Codec) -> Iterator:
    fourcc = cv2.VideoWriter.fourcc(*{"VP8": "VP80", "VP9": "VP90"}[codec])
    with _quiet():
        writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, fourcc, float(fps), size)
    if not writer.isOpened():
        raise InputError(f"{path}: OpenCV cannot write {codec} here.")
    try:
        yield writer.write
    finally:
        writer.release()


@contextlib.contextmanager
def _h264(path: Path, size: tuple[int, int], fps: float, _: Codec) -> Iterator:
    import av  # pyright: ignore[reportMissingImports]

    options = {"movflags": "+faststart"}
    with av.open(str(path), "w", container_options=options) as container:
        rate = Fraction(fps).limit_denominator(1001)
        stream = container.add_stream("libx264", rate=rate)
        stream.width, stream.height = size
        stream.pix_fmt = "yuv420p"
        stream.options = {"crf": _H264_RATE_FACTOR, "preset": "veryfast"}

        def write(picture: Image) -> None:
            frame = av.VideoFrame.from_ndarray(picture, format="bgr24")
            container.mux(stream.encode(frame))

        yield write
        container.mux(stream.encode(None))


def can_write(path: Path, codec: str) -> bool:
    """Returns True if this OpenCV has the encoder of a four-letter code for such a
    file."""
    with _quiet():
        fourcc = cv2.VideoWriter.fourcc(*codec)
        writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, fourcc, 30.0, (64, 64))
        found = writer.isOpened()
        writer.release()
    return found


def check_length(path: Path, num_frames: int) -> None:
    """Checks the length of a video, as OpenCV does not report a full disk."""
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    found = 0
    while found < num_frames and capture.grab():
        found += 1
    capture.release()
    if found < num_frames:
        raise OSError(
            errno.ENOSPC, f"{found} of {num_frames} frames written; disk full?", path
        )


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Redirects standard error at the file descriptor: the encoder reports success of
    every `.webm` there, which no setting turns off."""
    sys.stderr.flush()
    kept, nothing = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nothing)


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
    height = max(1, round(image.shape[0] * _THUMBNAIL_WIDTH_PX / image.shape[1]))
    small = cv2.resize(
        image, (_THUMBNAIL_WIDTH_PX, height), interpolation=cv2.INTER_AREA
    )
    encoded, data = cv2.imencode(
        ".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _THUMBNAIL_QUALITY]
    )
    if encoded:
        atomic.write_bytes(path, data.tobytes())
    return encoded
