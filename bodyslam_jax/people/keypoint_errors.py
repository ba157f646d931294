"""Standard deviations of keypoints, and the frames with enough of them."""

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import maximum_filter1d

from bodyslam_jax.config import PeopleFit
from bodyslam_jax.people.costs import KEYPOINT_SIGMA
from bodyslam_jax.types import Intrinsics, Keypoints

BOX_DIAGONAL = 1.75
"""m: what the keypoints of a standing adult span, nose to toe and arms."""
DETECTOR_FLOOR = 1.0
"""px: least standard deviation of any detector, in images of any size."""


MIN_KEYPOINTS = 6
"""Sure keypoints whose information a frame must have for its body to be fitted. Of a
person who leaves the image a detector goes on to guess all keypoints, with little
confidence, on the arm or leg that is left (`benchmarks/video.md`)."""
CORRELATION_TIME = 0.15
"""Time for which errors of a keypoint stay the same, s: frames within it count once."""
ROBUST_SCALE = 4.0
"""Scale of the robust loss on keypoints, in their standard deviations."""


def keypoint_sigma(
    keypoints: Keypoints, intrinsics: Intrinsics, person: int
) -> Float[np.ndarray, "t 25"]:
    """Standard deviation of one person's keypoints relative to the body, m; `inf` for
    missing ones. Keypoints outside the image are extrapolated and count as missing."""
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
    """Frames whose keypoints have as much information as `MIN_KEYPOINTS` sure ones.

    A keypoint counts by its precision `σ⁻²`, `sigma` (m) being that of
    `keypoint_sigma`, over its precision at full confidence.
    """
    return np.sum((KEYPOINT_SIGMA / sigma) ** 2, axis=1) >= MIN_KEYPOINTS


def find_present(
    sigma: Float[np.ndarray, "t 25"], fps: float, settings: PeopleFit
) -> Bool[np.ndarray, " t"]:
    """Frames with keypoints enough, and short gaps between them."""
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
    """Scale of the person in the image: the largest keypoint box within half a second,
    over that of a standing adult."""
    detected = np.isfinite(sigma)[..., None]
    low = np.min(np.where(detected, uv, np.inf), axis=1)
    high = np.max(np.where(detected, uv, -np.inf), axis=1)
    diagonal = np.where(
        detected.any(axis=(1, 2)), np.linalg.norm(high - low, axis=-1), 0.0
    )
    largest = maximum_filter1d(diagonal, 2 * round(fps / 2) + 1)
    valid = diagonal[diagonal > 0]
    # All keypoints in one pixel: not a person, but no reason to fail.
    overall = np.median(valid) if len(valid) else DETECTOR_FLOOR
    return np.maximum(largest, 0.3 * overall) / BOX_DIAGONAL


def in_pixels(
    sigma: Float[np.ndarray, "t 25"], scale: Float[np.ndarray, " t"]
) -> Float[np.ndarray, "t 25"]:
    """The same in pixels, where a metre is `scale` of them."""
    return np.hypot(sigma * scale[:, None], DETECTOR_FLOOR)
