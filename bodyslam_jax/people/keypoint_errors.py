"""Standard deviations of keypoints, and the frames that have enough of them."""

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import maximum_filter1d

from bodyslam_jax.config import PeopleFit
from bodyslam_jax.people.costs import KEYPOINT_SIGMA
from bodyslam_jax.types import Intrinsics, Keypoints

BOX_DIAGONAL_M = 1.75
"""Diagonal of the box around the keypoints of a standing adult, nose to toe and
arms."""
MIN_DETECTOR_SIGMA_PX = 1.0
"""Least standard deviation of any detector, in images of any size."""


MIN_KEYPOINTS = 6
"""Number of confident keypoints whose information a frame must have for its body to be
fitted. For a person who leaves the image, a detector continues to guess all keypoints,
with little confidence, on the arm or leg that remains (`benchmarks/video.md`)."""
CORRELATION_TIME = 0.15
"""Time for which errors of a keypoint persist, s: frames within it count once."""
ROBUST_SCALE = 4.0
"""Scale of the robust loss on keypoints, in their standard deviations."""


def keypoint_sigma(
    keypoints: Keypoints, intrinsics: Intrinsics, person: int
) -> Float[np.ndarray, "t 25"]:
    """Returns the standard deviation of one person's keypoints relative to the body, m;
    `inf` for missing ones.

    Keypoints outside the image are extrapolated and count as missing.
    """
    uv, confidence = keypoints.uv[person], keypoints.confidence[person]
    size = np.array([intrinsics.width, intrinsics.height])
    inside = np.all((uv > -0.5) & (uv < size - 0.5), axis=-1)
    detected = (confidence > 0) & inside
    if not detected.any():
        return np.full(confidence.shape, np.inf)
    sure = np.quantile(confidence[detected], 0.9)
    relative = np.clip(confidence / sure, 0.1, 1.0)
    return np.where(
        detected & (confidence > 0.02 * sure), KEYPOINT_SIGMA / relative, np.inf
    )


def has_enough(sigma: Float[np.ndarray, "t 25"]) -> Bool[np.ndarray, " t"]:
    """Returns the frames whose keypoints have as much information as `MIN_KEYPOINTS`
    confident ones.

    A keypoint counts by its precision `σ⁻²`, with `sigma` (m) of `keypoint_sigma`,
    relative to its precision at full confidence.
    """
    return np.sum((KEYPOINT_SIGMA / sigma) ** 2, axis=1) >= MIN_KEYPOINTS


def find_present(
    sigma: Float[np.ndarray, "t 25"], fps: float, settings: PeopleFit
) -> Bool[np.ndarray, " t"]:
    """Returns the frames with enough keypoints, and those in short gaps between
    them."""
    enough = has_enough(sigma)
    present = enough.copy()
    valid = np.flatnonzero(enough)
    for a, b in zip(valid[:-1], valid[1:]):
        if b - a - 1 <= settings.max_gap * fps:
            present[a:b] = True
    return present


def pixels_per_metre(
    uv: Float[np.ndarray, "t 25 2"], sigma: Float[np.ndarray, "t 25"], fps: float
) -> Float[np.ndarray, " t"]:
    """Returns the scale of the person in the image, px/m: the largest keypoint box
    within half a second, relative to that of a standing adult."""
    detected = np.isfinite(sigma)[..., None]
    low = np.min(np.where(detected, uv, np.inf), axis=1)
    high = np.max(np.where(detected, uv, -np.inf), axis=1)
    diagonal = np.where(
        detected.any(axis=(1, 2)), np.linalg.norm(high - low, axis=-1), 0.0
    )
    largest = maximum_filter1d(diagonal, 2 * round(fps / 2) + 1)
    valid = diagonal[diagonal > 0]
    # All keypoints may be in one pixel, which must not raise an error.
    overall = np.median(valid) if len(valid) else MIN_DETECTOR_SIGMA_PX
    return np.maximum(largest, 0.3 * overall) / BOX_DIAGONAL_M


def in_pixels(
    sigma: Float[np.ndarray, "t 25"], scale: Float[np.ndarray, " t"]
) -> Float[np.ndarray, "t 25"]:
    """Converts standard deviations to pixels; `scale` is in px/m."""
    return np.hypot(sigma * scale[:, None], MIN_DETECTOR_SIGMA_PX)
