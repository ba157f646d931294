"""A running source of images: a video file, a camera, a stream.

A thread reads; of what it reads only the newest image is kept, so that whoever is too
slow sees fewer images, never older ones. A file may also be read at the pace of whoever
takes its images: then none is dropped.
"""

import dataclasses
import re
import threading
import time
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io.video import open_video
from bodyslam_jax.types import DEFAULT_FPS

_STREAM = re.compile(r"[a-z][a-z0-9+.-]*://", re.IGNORECASE)
_MAX_FPS = 240.0
"""Largest plausible frame rate, 1/s."""


@dataclasses.dataclass(frozen=True)
class Captured:
    """One image of a source."""

    index: int
    """Number of images before it in the source, including dropped ones."""
    timestamp: float
    """Time since the first image, s; for a file by its rate, else by the clock of this
    machine."""
    image: UInt8[np.ndarray, "y x 3"]
    """BGR"""


class Capture:
    """A source and the thread that reads it, until `close`."""

    def __init__(
        self, source: str, fps: float | None = None, *, every: bool = False
    ) -> None:
        """
        **Arguments:** `source`: a video file, the number of a camera, or the address of
        a stream that OpenCV opens; `fps` in place of the rate that it tells; `every`:
        whether the thread waits until each image of a file was taken, in place of
        reading at the file's own pace.

        **Raises:** `InputError` if it cannot be opened or gives no image, or if `every`
        is asked for of a camera or a stream, which do not wait.
        """
        self.source = source
        self.path = _file(source)
        if every and self.path is None:
            raise InputError(
                f"--every-frame: {source} is no file, and does not wait for anybody."
            )
        self.every = every
        self.reader = self._open()
        told = float(self.reader.get(cv2.CAP_PROP_FPS) or 0.0)
        usual = told if 0 < told <= _MAX_FPS else DEFAULT_FPS
        self.fps = fps or usual
        ok, first = self.reader.read()
        if not ok or first is None:
            self.reader.release()
            raise InputError(f"{source}: opened, but gives no image.")
        self.size = first.shape[1], first.shape[0]
        self.first: np.ndarray | None = first
        told = float(self.reader.get(cv2.CAP_PROP_FRAME_COUNT) or 0.0)
        self.length = int(told) if self.path is not None and told > 0 else None
        """Number of images of a file, as its header tells it."""
        self.skipped = 0
        """Images of a file that `skip` passed over."""
        self.dropped = 0
        """Images that were replaced by newer ones before anybody took them."""
        self.ended = False
        """Whether the source has no more images."""
        self.last_image = time.monotonic()
        """When the last image came, by the clock of this process."""
        self._newest: Captured | None = None
        self._ready = threading.Condition()
        self._closed = False
        self._thread: threading.Thread | None = None

    def skip(self, images: int) -> None:
        """Passes over the first images of a file, before `start`."""
        if not images:
            return
        # Reading is exact, whereas seeking depends on the file's index.
        for _ in range(images - 1):
            self.reader.grab()
        ok, image = self.reader.read()
        self.first = image if ok else None
        self.skipped = images

    def start(self) -> None:
        """Begins to read; the source's time begins now."""
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def newest(self, timeout: float) -> Captured | None:
        """Returns the newest image that was not returned yet; `None` if none comes
        within `timeout` (s), or ever."""
        with self._ready:
            there = lambda: self._newest is not None or self.ended
            self._ready.wait_for(there, timeout)
            found, self._newest = self._newest, None
            self._ready.notify_all()
            return found

    def silent(self) -> float:
        """Returns the time since the last image, s."""
        return time.monotonic() - self.last_image

    def close(self) -> None:
        """Ends the thread; a thread that waits for a camera ends with the process."""
        with self._ready:
            self._closed = True
            self._ready.notify_all()
        if self._thread is not None:
            self._thread.join(timeout=1.0)
            if self._thread.is_alive():
                return
        self.reader.release()

    def _open(self) -> cv2.VideoCapture:
        if self.path is not None:
            return open_video(self.path)
        number = self.source.isdecimal()
        reader = cv2.VideoCapture(int(self.source) if number else self.source)
        if not reader.isOpened():
            what = "camera" if number else "stream"
            raise InputError(
                f"{self.source}: this {what} cannot be opened; expected a video file, "
                "the number of a camera, or the address of a stream."
            )
        return reader

    def _read(self) -> None:
        begun = time.monotonic()
        index, image = self.skipped, self.first
        self.first = None
        while image is not None and not self._closed:
            timestamp = index / self.fps
            if self.every:
                with self._ready:
                    self._ready.wait_for(lambda: self._newest is None or self._closed)
            elif self.path is not None:
                wait = begun + timestamp - time.monotonic()
                if wait > 0:
                    time.sleep(wait)
            else:
                timestamp = time.monotonic() - begun
            self.last_image = time.monotonic()
            with self._ready:
                self.dropped += self._newest is not None
                self._newest = Captured(index, timestamp, image)
                self._ready.notify_all()
            index += 1
            ok, image = self.reader.read()
            if not ok:
                break
        with self._ready:
            self.ended = True
            self._ready.notify_all()


def _file(source: str) -> Path | None:
    """Returns the file of a source; `None` for a camera or a stream.

    **Raises:** `InputError` if it looks like a file and there is none.
    """
    path = Path(source)
    if path.is_file():
        return path
    if source.isdecimal() or _STREAM.match(source) or source.startswith("/dev/"):
        return None
    raise InputError(
        f"{source}: no such file; expected a video file, the number of a camera, or "
        "the address of a stream."
    )
