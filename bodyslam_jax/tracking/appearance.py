"""Describes appearance for re-identification: colours of the clothes on trunk and
thighs.

Each part is described by the cumulative histograms of L*, a* and b*. Their mean
absolute difference is the Wasserstein-1 distance of the colour distributions, so that a
small change of light is a small distance, and descriptors may be averaged over time.
"""

import cv2
import numpy as np
from jaxtyping import Float, UInt8

_NUM_BINS = 32
_CHANNEL_RANGES = ((0.0, 256.0), (64.0, 192.0), (64.0, 192.0))
"""Ranges of L*, a* and b* in OpenCV's 8 bits; clothes are rarely more colourful."""
_GRID_SAMPLES = 10
"""Number of samples along each side of the trunk."""
_MIN_SAMPLES = 25
"""Number of samples within the image that a part must have."""
DESCRIPTOR_SIZE = 2 * 3 * _NUM_BINS
"""Number of components of a person's descriptor."""
_LIGHTNESS_WEIGHT = 0.5
"""Weight of L*, which light and shade change most."""


def describe(
    image: UInt8[np.ndarray, "y x 3"], points: Float[np.ndarray, "17 3"], least: float
) -> Float[np.ndarray, " d"]:
    """Returns the cumulative histograms of a person's trunk and thighs; NaN for a part
    with too few samples within the image.

    Args:
        image: BGR.
        points: COCO keypoints, u px, v px, score.
        least: score from which keypoints are used.
    """
    found = np.full((2, 3, _NUM_BINS), np.nan)
    for index, at in enumerate((_trunk(points, least), _thighs(points, least))):
        column, row = np.round(at).astype(int).T
        inside = (column >= 0) & (row >= 0)
        inside &= (column < image.shape[1]) & (row < image.shape[0])
        if inside.sum() < _MIN_SAMPLES:
            continue
        colours = image[row[inside], column[inside]][None]
        lab = cv2.cvtColor(colours, cv2.COLOR_BGR2LAB)[0].astype(float)
        for channel, (low, high) in enumerate(_CHANNEL_RANGES):
            place = np.clip(
                (lab[:, channel] - low) / (high - low) * _NUM_BINS, 0, _NUM_BINS
            )
            edges = np.arange(1, _NUM_BINS + 1)
            found[index, channel] = (place[:, None] < edges).mean(0)
    return found.ravel()


def difference(a: Float[np.ndarray, " d"], b: Float[np.ndarray, " d"]) -> float:
    """Returns the distance of two descriptors, in 8-bit steps of CIELAB; NaN without a
    common part."""
    extent = np.array([high - low for low, high in _CHANNEL_RANGES])
    weight = np.array([_LIGHTNESS_WEIGHT, 1.0, 1.0])
    apart = np.abs(a - b).reshape(2, 3, _NUM_BINS).mean(-1) * extent * weight
    parts = np.linalg.norm(apart, axis=1)
    finite = np.isfinite(parts)
    return float(parts[finite].mean()) if finite.any() else float("nan")


def mean_look(
    looks: Float[np.ndarray, "n d"],
) -> Float[np.ndarray, " d"]:
    """Returns the mean of `n` descriptors of a person, ignoring NaN; NaN where all
    are."""
    finite = np.isfinite(looks)
    total = np.where(finite, looks, 0.0).sum(0)
    count = finite.sum(0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _trunk(points: np.ndarray, least: float) -> Float[np.ndarray, "m 2"]:
    """Returns positions between shoulders and hips, away from the edges, px."""
    if not (points[[5, 6, 11, 12], 2] > least).all():
        return np.zeros((0, 2))
    left, right = points[[5, 11], None, :2], points[[6, 12], None, :2]
    along = np.linspace(0.2, 0.8, _GRID_SAMPLES)[:, None]
    top, bottom = (
        left[0] + along * (right - left)[0],
        left[1] + along * (right - left)[1],
    )
    down = np.linspace(0.15, 0.9, _GRID_SAMPLES)[:, None, None]
    return (top + down * (bottom - top)).reshape(-1, 2)


def _thighs(points: np.ndarray, least: float) -> Float[np.ndarray, "m 2"]:
    """Returns positions along both thighs, px, as wide as a third of one."""
    found = [np.zeros((0, 2))]
    for hip, knee in zip(points[11:13], points[13:15], strict=True):
        if min(hip[2], knee[2]) <= least:
            continue
        bone = knee[:2] - hip[:2]
        across = 0.08 * np.array([-bone[1], bone[0]])
        along = np.linspace(0.2, 0.9, _GRID_SAMPLES)[:, None, None] * bone
        aside = np.linspace(-1, 1, 4)[None, :, None] * across
        found.append((hip[:2] + along + aside).reshape(-1, 2))
    return np.concatenate(found)
