"""The overlay video: bodies and tracked points on the frames, and a top view."""

import concurrent.futures
import contextlib
import errno
import os
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from bodyslam_jax.body import BodyModel
from bodyslam_jax.types import Result, Tracks
from bodyslam_jax.view.people import coarse_body, draw_people, meshes
from bodyslam_jax.view.style import Image, write_text
from bodyslam_jax.view.top_view import Plan, draw_trails, trails


def write_overlay(
    path: Path,
    frames: Iterable[Image] | None,
    result: Result,
    body: BodyModel,
    tracks: Tracks | None = None,
    size: tuple[int, int] | None = None,
    max_width: int = 854,
    codec: Literal["VP8", "VP9"] = "VP8",
) -> None:
    """Writes a `.webm` with one image per frame of the result.

    **Arguments:**

    - `frames`: the video, BGR, one image per frame of the result, of the size of the
        intrinsics; frames that are missing are drawn on black.
    - `tracks`: points to draw; `size`: width and height (px) where there are no frames,
        else twice the principal point.
    - `max_width`: larger frames are drawn smaller, px.
    - `codec`: VP8 by default, which plays in the same browsers as VP9 and is three
        times as fast, as OpenCV cannot set the speed of its VP9 encoder.

    **Raises:** `ValueError` if this OpenCV has no such encoder; `OSError` if the video
    could not be written whole.
    """
    source = iter(frames) if frames is not None else iter(())
    first = next(source, None)
    if first is not None:
        size = (first.shape[1], first.shape[0])
    elif size is None:
        cx, cy = result.intrinsics[2:4]
        size = (round(2 * cx) + 1, round(2 * cy) + 1)
    width = min(size[0], max_width) // 2 * 2
    height = max(2, round(size[1] * width / size[0] / 2) * 2)
    zoom = np.array([width / size[0], height / size[1]])
    t = result.timestamps
    fps = (len(t) - 1) / (t[-1] - t[0]) if len(t) > 1 else 30.0
    fourcc = cv2.VideoWriter.fourcc(*{"VP8": "VP80", "VP9": "VP90"}[codec])
    with _quiet():
        writer = cv2.VideoWriter(
            str(path), cv2.CAP_FFMPEG, fourcc, float(fps), (width, height)
        )
    if not writer.isOpened():
        raise ValueError(f"{path}: OpenCV cannot write {codec} here.")
    drawn = pictures(first, source, result, body, tracks, (width, height), zoom)
    # Encoding and drawing run in parallel: both release Python's lock.
    with concurrent.futures.ThreadPoolExecutor(1) as encoder:
        pending = None
        for picture in drawn:
            if pending is not None:
                pending.result()
            pending = encoder.submit(writer.write, picture)
    writer.release()
    check_length(path, len(t))


def can_write(path: Path, codec: str) -> bool:
    """Whether this OpenCV has the encoder of a four-letter code for such a file."""
    with _quiet():
        fourcc = cv2.VideoWriter.fourcc(*codec)
        writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, fourcc, 30.0, (64, 64))
        found = writer.isOpened()
        writer.release()
    return found


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


def pictures(
    first: Image | None,
    source: Iterator[Image],
    result: Result,
    body: BodyModel,
    tracks: Tracks | None,
    size: tuple[int, int],
    zoom: np.ndarray,
) -> Iterator[Image]:
    coarse = coarse_body(body)
    faces = np.asarray(coarse.faces)
    lines = trails(tracks, len(result.timestamps), zoom)
    plan = Plan(result, size)
    black = np.zeros((size[1], size[0], 3), np.uint8)
    posed = meshes(result, coarse, slice(0, len(result.timestamps)))
    image = first
    for frame, people in enumerate(posed):
        if image is None:
            picture = black.copy()
        elif image.shape[:2] != (size[1], size[0]):
            picture = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        else:
            picture = image.copy()
        picture = draw_people(picture, people, faces, zoom)
        draw_trails(picture, lines[frame])
        plan.draw(picture, frame)
        text = f"frame {frame + 1}/{len(result.timestamps)}"
        text += f"  {result.timestamps[frame]:.2f} s"
        write_text(picture, text, (10, size[1] - 12))
        yield picture
        image = next(source, None)
