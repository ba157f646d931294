"""Straight line segments in some images of a video, outside of people."""

import dataclasses

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from bodyslam_jax.io.video import frames as read_frames
from bodyslam_jax.sfm.person_mask import person_masks
from bodyslam_jax.types import Sequence

_PERSON_MARGIN = 0.05
"""Width added to people's masks, relative to their height in the image."""
_MIN_LENGTH_SHARE = 0.05
"""Least length of a segment, as a share of the image's longer side."""
_NUM_IMAGES = 24
"""Number of images that are searched, evenly spread over the clip."""
_NUM_MASK_SAMPLES = 7
"""Number of points of a segment at which the mask of people is looked up."""


@dataclasses.dataclass(frozen=True)
class Segments:
    """`s` straight segments in images."""

    frame: Int[np.ndarray, " s"]
    """Index of the frame."""
    ends: Float[np.ndarray, "s 2 2"]
    """Image positions of both ends, px."""
    searched: Int[np.ndarray, " n"]
    """Indices of the frames that were searched for segments."""


def find_segments(sequence: Sequence, within: Bool[np.ndarray, " t"]) -> Segments:
    """Detects segments that are on no person in some of the frames `within`, by
    OpenCV's LSD (Grompone von Gioi et al., 2010).

    **Raises:** `ValueError` if the sequence has no images or one cannot be read.
    """
    detector = cv2.createLineSegmentDetector()
    shortest = _MIN_LENGTH_SHARE * max(
        sequence.intrinsics.width, sequence.intrinsics.height
    )
    frames = np.flatnonzero(within)
    chosen = np.unique(frames[_spread(len(frames))])
    last = int(max(chosen, default=-1))
    frame, ends = [np.zeros(0, int)], [np.zeros((0, 2, 2))]
    images = read_frames(sequence, gray=True)
    masks = person_masks(sequence, _PERSON_MARGIN)
    for k, (image, mask) in enumerate(zip(images, masks, strict=False)):
        if k > last:
            break
        if k not in chosen:
            continue
        lines = detector.detect(image)[0]
        if lines is None:
            continue
        found = lines.reshape(-1, 2, 2).astype(float)
        found = found[np.linalg.norm(found[:, 1] - found[:, 0], axis=1) > shortest]
        if mask is not None:
            share = np.linspace(0, 1, _NUM_MASK_SAMPLES)[:, None]
            at = found[:, None, 0] + share * (found[:, None, 1] - found[:, None, 0])
            size = np.array(mask.shape[::-1]) - 1
            column, row = np.moveaxis(np.clip(at.round().astype(int), 0, size), -1, 0)
            found = found[~(mask[row, column] > 0).any(axis=1)]
        frame.append(np.full(len(found), k))
        ends.append(found)
    return Segments(np.concatenate(frame), np.concatenate(ends), chosen)


def _spread(num_frames: int) -> Int[np.ndarray, " n"]:
    """Returns the positions of the images that are searched among `num_frames`."""
    places: Float[np.ndarray, " n"] = np.linspace(0, num_frames - 1, _NUM_IMAGES)
    return places.round().astype(int)
