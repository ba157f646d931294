"""The likelihood of keypoints under each known order, from distances in the image.

Points that are neighbours on a body are at most as far apart in the image as their bone
is long. Under each layout, distances between neighbours have a heavy-tailed density as
wide as the bone is long; a point that the layout does not name is anywhere about the
body. Posture, view and orientation in the image do not matter, nor does the number of
detected points. For real and simulated people the right order has 1.3 nats per point or
more, a random one 0 ± 0.4 and at most 1.0; two known orders differ by 0.6 or more.
"""

import dataclasses
from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax.io.keypoints.layouts import HEAD_TOP, NUM_PARTS, SPINE

_MIN_PRESENT_CONFIDENCE = 0.05
_MIN_CONFIDENCE = 0.3
_MIN_POINTS = 6
"""Least number of keypoints of a detection that is evaluated."""
_MIN_DETECTIONS = 5
_MIN_WHOLE_BODY_POINTS = 12
"""Number of keypoints from which detections fit their layout well: they are not of a
half hidden body."""
_MIN_LOG_LIKELIHOOD = 1.1
"""Least log-likelihood of a layout that is chosen, nats per keypoint."""
_MIN_LOG_LIKELIHOOD_GAIN = 0.3
"""Least gain in log-likelihood of a layout other than the usual one, nats per
keypoint."""
_MIN_AGREEMENT = 0.8
"""Least share of the detections for which it must be better."""
_IMPLAUSIBLE_LOG_LIKELIHOOD, _POOR_LOG_LIKELIHOOD = 0.1, 0.7
"""Log-likelihoods (nats per keypoint) below which keypoints are not those of a body in
the usual layout (random points have up to 0.4), and below which they fit it poorly."""
_MIN_POSTURE_CHANGE = 0.02
"""Least change of posture of a moving person, relative to the person's size."""
_RMS_DISTANCES_M = (0.15, 0.25, 0.35, 0.5, 0.7)
"""Candidates for the RMS distance of the detected points from their mean, m; a half
hidden body has less."""
_BACKGROUND_WIDTH_M = 0.6
"""Width of the density of points without neighbours, m."""

_BONES = (  # parts of the right side, of the left side, m
    ((2, 3), (5, 6), 0.28),
    ((3, 4), (6, 7), 0.25),
    ((9, 10), (12, 13), 0.40),
    ((10, 11), (13, 14), 0.40),
    ((2, 9), (5, 12), 0.50),
    ((15, 17), (16, 18), 0.09),
    ((0, 15), (0, 16), 0.05),
    ((0, 17), (0, 18), 0.11),
    ((1, 2), (1, 5), 0.17),
    ((8, 9), (8, 12), 0.10),
    ((17, 2), (18, 5), 0.25),
    ((11, 24), (14, 21), 0.07),
    ((11, 22), (14, 19), 0.17),
    ((11, 23), (14, 20), 0.16),
    ((22, 23), (19, 20), 0.08),
    ((24, 22), (21, 19), 0.22),
    ((24, 23), (21, 20), 0.20),
)
_OTHER_NEIGHBOURS = (
    ((2, 5), 0.33),
    ((9, 12), 0.20),
    ((15, 16), 0.06),
    ((17, 18), 0.14),
    ((0, 1), 0.22),
    ((1, 8), 0.50),
    ((HEAD_TOP, 0), 0.15),
    ((HEAD_TOP, 1), 0.28),
    ((SPINE, 8), 0.20),
    ((SPINE, 1), 0.30),
)
_NEIGHBOURS = [(a, m) for r, l, m in _BONES for a in (r, l)] + list(_OTHER_NEIGHBOURS)


@dataclasses.dataclass(frozen=True)
class Choice:
    """The layout that keypoints are in."""

    layout: str
    changed: bool
    """True if it is not the usual layout of that number of keypoints."""
    plausible: bool
    """True if the keypoints are those of a body in any of the layouts."""
    poor_fit: bool
    """True if the keypoints are plausible, but fit the layout poorly."""
    nats: dict[str, float]
    """Log-likelihood of each layout, nats per point."""


def choose_layout(
    points: Float[np.ndarray, "n j 3"], layouts: Mapping[str, list[int]]
) -> Choice:
    """Returns the layout of `n` detections among `layouts`, the first being the usual
    one.

    Another is chosen only if it is plausible, much better, better for nearly all
    detections, and postures change.
    """
    first = next(iter(layouts))
    present = points[..., 2] > _MIN_PRESENT_CONFIDENCE
    enough = present.sum(axis=1) >= _MIN_POINTS
    points, present = points[enough], present[enough]
    if not len(points):
        return Choice(first, False, True, False, {})
    nats = {name: likelihood(points, present, la) for name, la in layouts.items()}
    mean = {name: float(value.mean()) for name, value in nats.items()}
    best = max(mean, key=lambda name: mean[name])
    better = nats[best] > nats[first]
    if (
        best != first
        and mean[best] >= _MIN_LOG_LIKELIHOOD
        and mean[best] - mean[first] >= _MIN_LOG_LIKELIHOOD_GAIN
        and better.mean() >= _MIN_AGREEMENT
        and _changes(points, present)
    ):
        return Choice(best, True, True, False, mean)
    many = present.sum(axis=1) >= _MIN_WHOLE_BODY_POINTS
    least = float(nats[first][many].mean()) if many.sum() >= _MIN_DETECTIONS else np.inf
    poor = least < _POOR_LOG_LIKELIHOOD and _changes(points[many], present[many])
    implausible = (
        poor
        and least < _IMPLAUSIBLE_LOG_LIKELIHOOD
        and max(mean.values()) < _MIN_LOG_LIKELIHOOD
    )
    return Choice(first, False, not implausible, poor and not implausible, mean)


def likelihood(
    points: Float[np.ndarray, "n j 3"],
    present: Bool[np.ndarray, "n j"],
    layout: list[int],
) -> Float[np.ndarray, " n"]:
    """Returns the log-likelihood of each of `n` detections under a layout, nats per
    detected point, in units in which the RMS distance from the mean is 0.5."""
    uv = _normalised(points, present)
    num = len(points)
    position, has_part = (
        np.zeros((num, NUM_PARTS, 2)),
        np.zeros((num, NUM_PARTS), dtype=bool),
    )
    for k, part in enumerate(layout):
        if part >= 0:
            position[:, part], has_part[:, part] = uv[:, k], present[:, k]
    pairs = [
        (a, b, length, ((position[:, a] - position[:, b]) ** 2).sum(axis=-1))
        for (a, b), length in _NEIGHBOURS
    ]
    found = np.full(num, -np.inf)
    for size in _RMS_DISTANCES_M:
        total, count = np.zeros((num, NUM_PARTS)), np.zeros((num, NUM_PARTS))
        for a, b, length, square in pairs:
            both = has_part[:, a] & has_part[:, b]
            value = both * _density(square * size**2, 0.8 * length)
            for part in (a, b):
                total[:, part] += value
                count[:, part] += both
        alone = _density((uv**2).sum(axis=-1) * size**2, _BACKGROUND_WIDTH_M)
        sums = np.zeros(num)
        for k, part in enumerate(layout):
            if part >= 0:
                near = total[:, part] / np.maximum(count[:, part], 1)
                value = np.where(count[:, part] > 0, near, alone[:, k])
            else:
                value = alone[:, k]
            sums += present[:, k] * value
        mean = sums / np.maximum(present.sum(axis=1), 1)
        found = np.maximum(found, mean + 2 * np.log(size / 0.5))
    return found


def _density(square: np.ndarray, width: float) -> np.ndarray:
    """Returns the log density, up to 1/2π, of Student's t with two degrees of freedom
    in the plane."""
    return -2 * np.log(width) - 2 * np.log1p(square / (2 * width**2))


def _normalised(points: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Returns positions relative to the mean of the detected points, scaled to an RMS
    of 1."""
    count = np.maximum(present.sum(axis=1), 1)[:, None]
    uv = (
        points[..., :2]
        - ((points[..., :2] * present[..., None]).sum(axis=1) / count)[:, None]
    )
    square = ((uv**2).sum(axis=-1) * present).sum(axis=1, keepdims=True) / count
    return uv / np.sqrt(np.maximum(square, 1e-12))[..., None]


def _changes(points: np.ndarray, present: np.ndarray) -> bool:
    """Returns True if postures differ, as those of a moving person do."""
    often = present.mean(axis=0) > 0.5
    if not often.any():
        return True
    uv = np.where(present[..., None], _normalised(points, present), np.nan)[:, often]
    away = uv - np.nanmedian(uv, axis=0)
    return bool(np.nanmedian(np.linalg.norm(away, axis=-1)) > _MIN_POSTURE_CHANGE)
