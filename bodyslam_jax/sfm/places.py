"""Keyframes that are recognised, and the relative pose of two that see one place.

A place has ORB descriptors (Rublee et al., 2011) of corners whose depth the map knows.
Two places that match give the pose of one camera relative to the other by resection,
and, as both know the depths, the ratio of their units, which no resection shows.
"""

import dataclasses

import numpy as np
from jaxtyping import Float, UInt8

from bodyslam_jax.geometry.arrays import SIGMA_OF_MEDIAN
from bodyslam_jax.sfm.features import match
from bodyslam_jax.sfm.multiview import resect

MIN_MATCHES = 20
"""Least number of matches of a place that is recognised to find a lost camera."""
_MIN_INLIERS, _MIN_SHARE = 30, 0.5
"""Least number of points, and share of the matches, that fit one relative pose."""
_MIN_CELLS, _NUM_CELLS = 6, 4
"""Least number of cells, of as many by as many over the image of the matches' place,
that have such points: a picture on two walls fills few."""
_MIN_SIGMA = np.array([0.001] * 3 + [0.003] * 3 + [0.01])
"""Least standard deviations of rotation (rad), of translation over depth, and of the
ratio of units: errors that all points of a place have in common."""


@dataclasses.dataclass(frozen=True)
class Place:
    """The corners of a keyframe whose position is known."""

    descriptors: UInt8[np.ndarray, "n 32"]
    points: Float[np.ndarray, "n 3"]
    """In the frame of its camera, in the map's unit at that time."""

    @property
    def depth(self) -> float:
        """Returns the median depth of the points."""
        return float(np.median(self.points[:, 2]))


@dataclasses.dataclass(frozen=True)
class Sighting:
    """How camera b stood relative to camera a, by points that both see."""

    T: Float[np.ndarray, "4 4"]
    """Pose of camera b in the frame of a, in the mean of their units."""
    log_ratio: float
    """Logarithm of the unit at b in units at a."""
    covariance: Float[np.ndarray, "7 7"]
    """As in `pose_graph.Edge`."""


def sighting(
    a: Place, b: Place, threshold: float, extent: Float[np.ndarray, " 2"]
) -> Sighting | None:
    """Returns the relative pose of two places, or `None` if they are not one.

    Args:
        threshold: error at depth 1 of a point that fits.
        extent: half of the image's size at depth 1.
    """
    pairs = match(a.descriptors, b.descriptors)
    if len(pairs) < _MIN_INLIERS:
        return None
    p_A, p_B = a.points[pairs[:, 0]], b.points[pairs[:, 1]]
    xy = p_B[:, :2] / p_B[:, 2:]
    found = resect(p_A, xy, threshold)
    if found is None:
        return None
    R, centre, good = found
    cell = np.floor((xy[good] / extent + 1) * _NUM_CELLS / 2).astype(int)
    if (
        good.sum() < max(_MIN_INLIERS, _MIN_SHARE * len(pairs))
        or len(np.unique(cell, axis=0)) < _MIN_CELLS
    ):
        return None
    p = (p_A[good] - centre) @ R.T
    ratios = np.log(p[:, 2] / p_B[good, 2])
    ratio = float(np.median(ratios))
    # Standard error of a median of normal errors.
    sigma = 1.2533 * _spread(ratios) / np.sqrt(len(ratios))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R.T, centre * np.exp(-ratio / 2)
    covariance = np.zeros((7, 7))
    covariance[:6, :6] = _covariance(p, xy[good], R)
    covariance[6, 6] = sigma**2
    depth = b.depth
    least = _MIN_SIGMA * np.array([1.0] * 3 + [depth] * 3 + [1.0])
    return Sighting(T, ratio, covariance + np.diag(least**2))


def _covariance(
    p: Float[np.ndarray, "n 3"], xy: Float[np.ndarray, "n 2"], R: np.ndarray
) -> Float[np.ndarray, "6 6"]:
    """Returns the covariance of a resected camera by the errors of its points `p`, in
    its frame, at `xy`."""
    u, v, z = p[:, 0] / p[:, 2], p[:, 1] / p[:, 2], p[:, 2]
    error = np.stack([u, v], axis=1) - xy
    zero, one = np.zeros_like(u), np.ones_like(u)
    D = np.stack([one, zero, -u, zero, one, -v], axis=1).reshape(-1, 2, 3)
    D /= z[:, None, None]
    x, y = p[:, 0], p[:, 1]
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1)
    J = np.concatenate([D @ cross.reshape(-1, 3, 3), -D @ R], axis=2).reshape(-1, 6)
    return _spread(error) ** 2 * np.linalg.inv(J.T @ J)


def _spread(errors: np.ndarray) -> float:
    """Returns a robust standard deviation of errors about their median."""
    return float(
        SIGMA_OF_MEDIAN * np.median(np.abs(errors - np.median(errors, axis=0)))
    )
