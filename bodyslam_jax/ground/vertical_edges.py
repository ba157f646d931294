"""Estimates the vertical from straight edges in images: walls, door frames, posts.

A segment in an image and the camera's centre span a plane with unit normal n. If the
edge is vertical, n is orthogonal to the vertical v. The residual of a segment is the
angle in the image between it and the image of the vertical through its middle, whose
ray is m: `r = n·v / |m × v|`.

Among the segments within some degrees of a rough vertical, some are images of vertical
edges, with errors from the lean of walls and posts and the noise of the detector; the
directions of the others are uniform. The mixture of both is fitted by expectation
maximisation. There is a result only if it explains the segments much better than
uniform directions do.

A physical edge appears in many images, with the same lean in all of them. So segments
of one image at different azimuths count as independent, and all images together count
as much as one of them, times the number of views that do not overlap: more images of
the same scene do not make the vertical more certain.
"""

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from bodyslam_jax.geometry.camera import unproject

_DEGREE = np.pi / 180
_MAX_EDGE_ANGLE_RAD = 15 * _DEGREE
"""Largest angle in the image between a segment and the rough vertical, and largest
angle between the result and the rough vertical, rad."""
_MIN_RAY_SINE = 0.5
"""Least sine of the angle between the ray of a segment and the vertical."""
_AZIMUTH_SECTOR_RAD = 3 * _DEGREE
"""Width of the azimuth sectors, rad; segments of one image in the same sector count as
one edge."""
_VIEW_ANGLE_RAD = 60 * _DEGREE
"""Change of heading after which two views of the camera do not overlap, rad."""
_END_SIGMA_PX = 0.25
"""Standard deviation of the end points of a segment, across it, px."""
_LEAN_SIGMA_RANGE_RAD = (0.3 * _DEGREE, 2.0 * _DEGREE)
"""Bounds of the standard deviation of the lean of vertical edges in a fit, rad."""
_MAX_LEAN_SIGMA_RAD = 1.4 * _DEGREE
"""Standard deviation of the lean above which edges are not walls and posts but, for
instance, trees, and the error of the fit exceeds its covariance, rad."""
_COMMON_ERROR_SIGMA_RAD = 0.2 * _DEGREE
"""Standard deviation of the error in the image that all edges of a clip have in common,
from a rolling shutter or unmodelled distortion, rad."""
_MIN_GAIN, _MIN_EDGES = 8.0, 4.0
"""Least gain in log-likelihood over uniform directions, and least number of independent
edges, of a result."""
_TILT_PRIOR_SIGMA_RAD = 20 * _DEGREE
"""Standard deviation of the prior of the tilt, which makes the system regular, rad."""
_EM_ITERATIONS = 20
"""Number of iterations of expectation maximisation."""


@dataclasses.dataclass(frozen=True)
class Edges:
    """Straight segments of images as planes in a world: `s` segments of `n` images."""

    frame: Int[np.ndarray, " s"]
    """Index of the image."""
    normal: Float[np.ndarray, "s 3"]
    """Unit normal of the plane through the camera's centre and the segment."""
    ray: Float[np.ndarray, "s 3"]
    """Unit vector to the middle of the segment."""
    length: Float[np.ndarray, " s"]
    """Length of the segment in the image, px."""
    axis: Float[np.ndarray, "n 3"]
    """Optical axes of all images that were searched for segments, unit vectors."""

    def rotated(self, rotation: Float[np.ndarray, "3 3"]) -> "Edges":
        """Returns the edges in other axes, to which `rotation` maps directions."""
        turn = lambda directions: directions @ rotation.T
        return dataclasses.replace(
            self, normal=turn(self.normal), ray=turn(self.ray), axis=turn(self.axis)
        )


@dataclasses.dataclass(frozen=True)
class Vertical:
    """The vertical estimated from edges, in a world whose y axis is nearly up."""

    tilt: Float[np.ndarray, " 2"]
    """x and z of the vertical over its y."""
    covariance: Float[np.ndarray, "2 2"]
    """Covariance of `tilt`, rad²."""
    lean: float
    """Standard deviation of edges about the vertical, without detector noise, rad."""
    number: float
    """Number of independent edges that agree with the vertical."""
    gain: float
    """Gain in log-likelihood over uniform directions."""
    is_vertical: Float[np.ndarray, " s"]
    """Probability that each segment is the image of a vertical edge."""


def make_edges(
    frame: Int[np.ndarray, " s"],
    ends: Float[np.ndarray, "s 2 2"],
    wanted: Int[np.ndarray, " n"],
    R_WC: Float[np.ndarray, "t 3 3"],
    intrinsics: Float[np.ndarray, " i"],
) -> Edges:
    """Converts segments in images to `Edges` in the world of the cameras.

    Args:
        frame: index of the image of each segment.
        ends: end points of each segment, px.
        wanted: indices of all images that were searched for segments.
        R_WC: orientations of the camera.
        intrinsics: see `geometry.camera`, px.
    """
    rays = np.asarray(unproject(np.asarray(intrinsics, float), ends))
    rays = np.einsum("sij,skj->ski", R_WC[frame], rays)
    unit = lambda x: x / np.linalg.norm(x, axis=-1, keepdims=True)
    rays = unit(rays)
    return Edges(
        frame,
        unit(np.cross(rays[:, 0], rays[:, 1])),
        unit(rays.sum(axis=1)),
        np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1),
        R_WC[wanted][:, :, 2],
    )


def find_vertical(edges: Edges) -> Vertical | None:
    """Returns the vertical within 15 degrees of the y axis; `None` if no set of edges
    stands out against uniform directions."""
    tilt, found = np.zeros(2), None
    for _ in range(2):  # The second fit is centred on the first, with all its edges.
        found = _fit(edges, tilt)
        if found is None or np.linalg.norm(found.tilt) > np.tan(_MAX_EDGE_ANGLE_RAD):
            return None
        tilt = found.tilt
    assert found is not None
    is_clear = found.gain > _MIN_GAIN and found.number > _MIN_EDGES
    return found if is_clear and found.lean < _MAX_LEAN_SIGMA_RAD else None


def _fit(edges: Edges, centre: Float[np.ndarray, " 2"]) -> Vertical | None:
    """Fits the mixture to the segments near a tilt; `None` with fewer than three."""
    r, _, across = _residual(edges.normal, edges.ray, centre)
    near = (across > _MIN_RAY_SINE) & (np.abs(r) < np.sin(_MAX_EDGE_ANGLE_RAD))
    if near.sum() < 3:
        return None
    normal, ray = edges.normal[near], edges.ray[near]
    noise = np.sqrt(2) * _END_SIGMA_PX / edges.length[near]
    weight = _weights(edges, near)
    random = 1 / (2 * _MAX_EDGE_ANGLE_RAD)
    prior = np.eye(2) / _TILT_PRIOR_SIGMA_RAD**2

    def density(r: np.ndarray, lean: float) -> np.ndarray:
        variance = lean**2 + noise**2
        return np.exp(-(r**2) / (2 * variance)) / np.sqrt(2 * np.pi * variance)

    lean, share = 1.0 * _DEGREE, 0.3
    side = np.arange(-10, 11) * _DEGREE
    grid = centre + np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    r, slope, _ = _residual(normal, ray, centre)
    apart = r + (grid - centre) @ slope.T
    gain = np.log(share * density(apart, lean) / random + 1 - share) @ weight
    tilt = grid[np.argmax(gain)]
    for _ in range(_EM_ITERATIONS):
        r, slope, _ = _residual(normal, ray, tilt)
        inlier = share * density(r, lean)
        is_vertical = inlier / (inlier + (1 - share) * random)
        counts = weight * is_vertical
        share = float(np.clip(counts.sum() / weight.sum(), 0.02, 0.98))
        variance = lean**2 + noise**2
        scaled = slope * (counts / variance)[:, None]
        step = np.linalg.solve(slope.T @ scaled + prior, scaled.T @ r)
        tilt = tilt - step
        # The scatter in excess of the detector's noise, by Fisher scoring.
        r = r - slope @ step
        fisher = counts / variance**2
        excess = fisher @ (r**2 - noise**2) / max(float(fisher.sum()), 1e-12)
        lean = float(
            np.sqrt(
                np.clip(
                    excess, _LEAN_SIGMA_RANGE_RAD[0] ** 2, _LEAN_SIGMA_RANGE_RAD[1] ** 2
                )
            )
        )
    r, slope, _ = _residual(normal, ray, tilt)
    inlier = share * density(r, lean)
    is_vertical = np.zeros(len(near))
    is_vertical[near] = inlier / (inlier + (1 - share) * random)
    counts = weight * is_vertical[near]
    by_all = counts / (lean**2 + noise**2)
    covariance = np.linalg.inv(slope.T @ (slope * by_all[:, None]) + prior)
    # The common error, as an angle of every edge in the image.
    mean = slope.T @ (slope * counts[:, None]) / max(float(counts.sum()), 1e-12)
    common = np.linalg.inv(mean / _COMMON_ERROR_SIGMA_RAD**2 + prior)
    gain = float(weight @ np.log(inlier / random + 1 - share))
    covariance = covariance + common
    number = float(counts.sum())
    return Vertical(tilt, covariance, lean, number, gain, is_vertical)


def _residual(normal, ray, tilt):
    """Returns the residuals of segments for a tilt of the vertical, their derivatives
    with respect to the tilt, and the sine of the angle between ray and vertical."""
    v = np.array([tilt[0], 1.0, tilt[1]])
    across = np.maximum(np.linalg.norm(np.cross(ray, v), axis=1), 1e-9)
    return normal @ v / across, normal[:, [0, 2]] / across[:, None], across


def _weights(edges: Edges, near: np.ndarray) -> Float[np.ndarray, " k"]:
    """Returns the number of independent edges that each segment represents."""
    azimuth = np.arctan2(edges.ray[near, 0], edges.ray[near, 2])
    sector = np.floor(azimuth / _AZIMUTH_SECTOR_RAD).astype(int)
    place = np.stack([edges.frame[near], sector])
    group = np.unique(place, axis=1, return_inverse=True)[1].reshape(-1)
    length = edges.length[near]
    share = length / np.bincount(group, length)[group]
    heading = np.arctan2(edges.axis[:, 0], edges.axis[:, 2])
    turned = np.angle(np.exp(1j * (heading - heading[0])))
    views = 1 + np.ptp(turned) / _VIEW_ANGLE_RAD
    return share * views / len(edges.axis)
