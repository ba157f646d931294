"""Small images and colours of the map, which the 3D view takes from the video."""

import dataclasses
from collections.abc import Iterable, Iterator

import cv2
import numpy as np
from jaxtyping import Int, UInt8

from bodyslam_jax.types import Tracks
from bodyslam_jax.view.style import Image

_MAX_IMAGES = 400
_MAX_IMAGE_BYTES = 3_600_000
"""Size of all small images, bytes, so that the page of 1,000 frames has less than 8
MB."""
_IMAGE_WIDTH_PX = 320
"""Width of a small image, px."""
_JPEG_QUALITY = 55
"""Quality of JPEG, 0 to 100."""


@dataclasses.dataclass(frozen=True)
class VideoSamples:
    """Samples of a video whose map has `l` landmarks."""

    frame: Int[np.ndarray, " k"]
    """Frames with a small image, increasing."""
    images: tuple[bytes, ...]
    """JPEG, one for each of `frame`."""
    colors: UInt8[np.ndarray, "l 3"]
    """Colours of the landmarks, RGB: the mean over the pixels that show them; grey
    where none does."""


class VideoSampler:
    """Collects samples of the images that pass through `watch`."""

    def __init__(
        self,
        num_frames: int,
        tracks: Tracks | None,
        num_landmarks: int,
        whole_frame: int | None = None,
    ):
        """`tracks` are observations of the map's landmarks, in pixels of the images;
        `whole_frame` is the frame whose image is kept as it is."""
        self.whole: Image | None = None
        """The image of `whole_frame`, once it has passed."""
        self._whole_frame = whole_frame
        self._step = max(1, -(-num_frames // _MAX_IMAGES))
        self._images: dict[int, bytes] = {}
        self._tracks = tracks
        if tracks is not None:
            self._order = np.argsort(tracks.frame, kind="stable")
            edges = np.arange(num_frames + 1)
            self._starts = np.searchsorted(tracks.frame[self._order], edges)
        self._sum = np.zeros((num_landmarks, 3))
        self._count = np.zeros(num_landmarks)

    def watch(self, images: Iterable[Image]) -> Iterator[Image]:
        """Yields the images (BGR, one per frame) unchanged; each is sampled as it
        passes."""
        for frame, image in enumerate(images):
            if frame == self._whole_frame:
                self.whole = image.copy()
            if frame % self._step == 0:
                self._images[frame] = _small(image)
            if self._tracks is not None and frame + 1 < len(self._starts):
                self._add_colors(frame, image, self._tracks)
            yield image

    def samples(self) -> VideoSamples:
        """Returns the samples of the images that passed so far."""
        kept = list(self._images)
        total = sum(map(len, self._images.values()))
        if total > _MAX_IMAGE_BYTES:
            number = int(len(kept) * _MAX_IMAGE_BYTES / total)
            chosen = np.linspace(0, len(kept) - 1, number).round().astype(int)
            kept = [kept[k] for k in chosen]
        mean = self._sum / np.maximum(self._count, 1)[:, None]
        mean[self._count == 0] = 128
        return VideoSamples(
            np.array(kept, int),
            tuple(self._images[frame] for frame in kept),
            np.round(mean[:, ::-1]).astype(np.uint8),
        )

    def _add_colors(self, frame: int, image: Image, tracks: Tracks) -> None:
        rows = self._order[self._starts[frame] : self._starts[frame + 1]]
        corner = [image.shape[1] - 1, image.shape[0] - 1]
        u, v = np.clip(np.round(tracks.uv[rows]), 0, corner).astype(int).T
        np.add.at(self._sum, tracks.landmark[rows], image[v, u])
        np.add.at(self._count, tracks.landmark[rows], 1)


def _small(image: Image) -> bytes:
    height, width = image.shape[:2]
    scale = min(1.0, _IMAGE_WIDTH_PX / max(width, height))
    size = (max(1, round(scale * width)), max(1, round(scale * height)))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    options = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    return cv2.imencode(".jpg", small, options)[1].tobytes()
