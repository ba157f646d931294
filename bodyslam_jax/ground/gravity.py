"""Estimates the direction of gravity from trunks, feet, the map's ground and edges.

Without an accelerometer four cues determine it, each with its own error:

- People keep their trunk upright to within some degrees. Lean across the view is
  observed in the image; lean along the view is mostly inferred and less accurate.
- Floors are level, most ground outdoors is level to about a degree, and some slopes.
  Its plane is estimated twice: from the feet that stand on it, and from the map points
  that lie in one plane below the camera.
- Walls and posts, where visible, are vertical to some tenths of a degree
  (`ground.vertical_edges`).

The two planes are fused by their covariances; then the plane's normal, the trunks' mean
and the vertical of edges are combined. Each can be an outlier: on a hill, where
postures are wrong, or where edges agree that are not vertical. So the error of each is
a mixture of a narrow and a wide normal distribution, and the result is the posterior
mean over all combinations.

`level` aligns the y axis of the world with it.

Angles are small: a direction is given by its *tilt*, x/y and z/y in a frame whose y
axis is nearly up.
"""

import dataclasses
import itertools
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax.config import GRAVITY_SIGMA
from bodyslam_jax.geometry.arrays import SIGMA_OF_MEDIAN
from bodyslam_jax.ground.plane import (
    CAUCHY_SCALE,
    Plane,
    feet_plane,
    fused,
    map_plane,
)
from bodyslam_jax.ground.stances import find_stances
from bodyslam_jax.ground.vertical_edges import Edges, Vertical, find_vertical

_DEGREE = np.pi / 180
_TRUNK_SIGMA_ACROSS_RAD = 2.0 * _DEGREE
"""Standard deviation of a mean trunk from the vertical, across the view, rad."""
_TRUNK_SIGMA_ALONG_RAD = {False: 2.0 * _DEGREE, True: 4.5 * _DEGREE}
"""The same along the view, by whether bodies are fitted to keypoints: ten simulated
sequences gave 1.5 and 3.4 degrees root mean square; one real clip gave 11."""
_COMMON_TRUNK_SHARE = 0.65
"""Share of these standard deviations that all people of a video have in common, as one
detector sees them from one side: averaging over people does not reduce it. Assumed; the
sequences with a known up direction show one or two people."""
_TRUNK_OUTLIER_PROBABILITY = {False: 0.05, True: 0.15}
"""Probability that a person's trunk is an outlier, by whether bodies are fitted to
keypoints."""
_TRUNK_OUTLIER_FACTOR = 2.5
"""Factor on the standard deviation of a trunk that is an outlier."""
_EDGE_OUTLIERS = (0.1, 5.0 * _DEGREE)
"""Probability that edges which agree are not vertical, and the standard deviation of
their direction in that case, rad. Assumed: they were vertical in all 21 clips."""
_LEVEL_SLOPE_SIGMA_RAD, _STEEP_SLOPE_SIGMA_RAD = 0.7 * _DEGREE, 4.0 * _DEGREE
_GROUND_KINDS = (
    (0.5, 0.2 * _DEGREE),
    (0.25, _LEVEL_SLOPE_SIGMA_RAD),
    (0.25, _STEEP_SLOPE_SIGMA_RAD),
)
"""Probability and standard deviation of the slope (rad) of each kind of ground: floors
of buildings, level ground outdoors, sloping ground."""
_RELATIVE_SIZE_SIGMA = 0.05
"""Relative standard deviation of a person's size. An error of size shifts all stances
of the person up or down by that share of the camera's height above them."""
_HELD_HEIGHT_SIGMA_M = 0.01
"""Standard deviation of the height over a plane of people whom the estimate constrains
to it, m."""


@dataclasses.dataclass(frozen=True)
class GravityCues:
    """What determines the up direction besides edges: people, the map and an
    accelerometer, in one world frame."""

    trunks: Float[np.ndarray, "h t 3"]
    """Directions in which trunks point, unit vectors: y axes of the root frames."""
    feet: Float[np.ndarray, "h t 2 3"]
    """Toe joints, m."""
    present: Bool[np.ndarray, "h t"]
    eyes: Float[np.ndarray, "t 3"]
    """Centres of the camera, m."""
    landmarks: Float[np.ndarray, "l 3"]
    """Map points, m; empty if the camera did not move."""
    fps: float
    fitted: Bool[np.ndarray, " h"]
    """True for people whose body was fitted to keypoints, not regressed."""
    measured_up: Float[np.ndarray, " 3"] | None = None
    """Up according to an accelerometer, with `GRAVITY_SIGMA`; `None` without one."""
    standing: Bool[np.ndarray, "h t 2"] | None = None
    """Toes in contact with the ground; without it, `find_stances` decides by speed."""
    on_floor: Bool[np.ndarray, " h"] | None = None
    """People whom an estimate constrains to one plane, so that errors of their size do
    not put them above or below it."""

    def moved(self, motion: Float[np.ndarray, "4 4"]) -> "GravityCues":
        """Returns the cues in another world, to which the rigid `motion` maps
        points."""
        turn = lambda directions: directions @ motion[:3, :3].T
        at = lambda points: turn(points) + motion[:3, 3]
        up = self.measured_up
        return dataclasses.replace(
            self,
            trunks=turn(self.trunks),
            feet=at(self.feet),
            eyes=at(self.eyes),
            landmarks=at(self.landmarks),
            measured_up=None if up is None else turn(up),
        )


@dataclasses.dataclass(frozen=True)
class Upright:
    """The estimated up direction, in the frame in which the cues were given."""

    up: Float[np.ndarray, " 3"]
    """Unit vector."""
    normal: Float[np.ndarray, " 3"]
    """Upwards unit normal of the ground's plane; `up` if no plane was found."""
    sigma: float
    """Standard deviation of `up` along its less certain axis, rad, over all kinds of
    ground by their posterior probabilities; infinite without any cue."""
    trunks: float
    """Angle between `up` and the mean direction of trunks, rad; NaN without people."""
    ground: float
    """Estimated slope of the ground, rad; NaN if no ground plane was found."""
    edges: float = np.nan
    """Angle between `up` and the vertical of edges, rad; NaN without such edges."""
    slope_probability: float = np.nan
    """Posterior probability that the ground slopes; NaN if no ground plane was found,
    or nothing else tells up."""
    sigma_if_sloping: float = np.inf
    """Standard deviation about `up`, as `sigma`, in the case that the ground slopes,
    rad; infinite without any cue."""
    unaided: float = np.nan
    """Angle between the measured up direction and the one estimated without it, rad;
    NaN if none was measured."""
    unaided_sigma: float = np.inf
    """Standard deviation of the up direction estimated without measured gravity,
    defined as `sigma`."""


def find_upright(cues: GravityCues, vertical: Vertical | None = None) -> Upright:
    """Estimates the up direction from all available cues, given in a frame whose y axis
    is roughly up; `vertical` is estimated from edges in the images."""
    present, eyes = cues.present, cues.eyes
    trunk_tilt = _trunks(cues)
    stances = find_stances(cues.feet, present, cues.fps, cues.standing)
    height = _height_of_camera(eyes, stances)
    size = np.full(len(stances), _RELATIVE_SIZE_SIGMA * height)
    if cues.on_floor is not None:
        size = np.where(cues.on_floor, _HELD_HEIGHT_SIGMA_M, size)
    planes = [feet_plane(stances, size, np.median(eyes, axis=0))]
    planes.append(map_plane(cues.landmarks, eyes, stances))
    ground = fused([plane for plane in planes if plane is not None])
    worse = _TRUNK_OUTLIER_PROBABILITY[bool((cues.fitted & present.any(axis=1)).any())]
    if cues.measured_up is not None:
        trunk_tilt, worse = _with_measured(trunk_tilt, cues.measured_up), 0.0
    found = _combined(_tilts(trunk_tilt, worse, vertical), ground)
    tilt, slope = found.tilt, found.slope
    return Upright(
        up=_direction(tilt),
        normal=_direction(tilt if ground is None else tilt - slope),
        sigma=found.sigma,
        slope_probability=found.slope_probability,
        sigma_if_sloping=found.sigma_if_sloping,
        trunks=np.nan
        if trunk_tilt is None
        else float(np.linalg.norm(trunk_tilt[0] - tilt)),
        ground=float(np.arctan(np.linalg.norm(slope))),
        edges=np.nan
        if vertical is None
        else float(np.linalg.norm(vertical.tilt - tilt)),
    )


def _direction(tilt: Float[np.ndarray, " 2"]) -> Float[np.ndarray, " 3"]:
    """Converts a tilt (x/y, z/y) to a unit vector."""
    found = np.array([tilt[0], 1.0, tilt[1]])
    return found / np.linalg.norm(found)


def _with_measured(trunk_tilt, up):
    """Fuses the trunks' tilt with that of an accelerometer; returns the tilt and its
    covariance, rad²."""
    tilt, weight = up[[0, 2]] / up[1], np.eye(2) / GRAVITY_SIGMA**2
    if trunk_tilt is None:
        return tilt, np.linalg.inv(weight)
    trunk = np.linalg.inv(trunk_tilt[1])
    covariance = np.linalg.inv(trunk + weight)
    return covariance @ (trunk @ trunk_tilt[0] + weight @ tilt), covariance


def _trunks(cues: GravityCues) -> tuple[np.ndarray, np.ndarray] | None:
    """Returns the mean direction of people's trunks as a tilt, and its covariance,
    rad²; `None` without upright people."""
    present, fitted = cues.present, cues.fitted
    means, weights = [], []
    views, anybody_fitted = [], False
    own_share = 1 - _COMMON_TRUNK_SHARE**2
    for h in np.flatnonzero(present.any(axis=1)):
        frames = present[h]
        own = cues.trunks[h, frames]
        own = own[own[:, 1] > 0.2]  # people who lie down are left out
        if not len(own):
            continue
        tilt = own[:, [0, 2]] / own[:, 1:2]
        mean = np.median(tilt, axis=0)
        # Postures are correlated in time: about one independent sample a second.
        seconds = max(1.0, len(own) / cues.fps)
        scatter = SIGMA_OF_MEDIAN * np.median(np.abs(tilt - mean), axis=0).max()
        view = (cues.feet[h, frames].mean(axis=1) - cues.eyes[frames])[:, [0, 2]]
        length = np.linalg.norm(view, axis=1, keepdims=True)
        view = view / np.maximum(length, 1e-9)
        along = (view[:, :, None] * view[:, None, :]).mean(axis=0)
        across = np.eye(2) - along
        noise = scatter**2 / seconds
        systematic = own_share * _TRUNK_SIGMA_ALONG_RAD[bool(fitted[h])] ** 2
        weight = along / (systematic + noise)
        weight = weight + across / (own_share * _TRUNK_SIGMA_ACROSS_RAD**2 + noise)
        views.append(along)
        anybody_fitted |= bool(fitted[h])
        means.append(mean)
        weights.append(weight)
    if not means:
        return None
    tilt, covariance = _robust_mean(np.array(means), np.array(weights))
    along = np.mean(views, axis=0)
    common = along * _TRUNK_SIGMA_ALONG_RAD[anybody_fitted] ** 2
    common = common + (np.eye(2) - along) * _TRUNK_SIGMA_ACROSS_RAD**2
    return tilt, covariance + _COMMON_TRUNK_SHARE**2 * common


def _robust_mean(
    means: Float[np.ndarray, "h 2"], weights: Float[np.ndarray, "h 2 2"]
) -> tuple[Float[np.ndarray, " 2"], Float[np.ndarray, "2 2"]]:
    """Returns the information-weighted mean under a Cauchy loss, and its covariance.

    People who sit or bend down are outliers among those who stand. Iterative
    reweighting starts at the median. The covariance is enlarged by the squared Birge
    ratio where inliers disagree.
    """
    mean, covariance = np.median(means, axis=0), np.linalg.inv(weights.sum(axis=0))
    chi2, cauchy = np.zeros(len(means)), np.ones(len(means))
    for _ in range(20):
        apart = means - mean
        chi2 = np.einsum("hi,hij,hj->h", apart, weights, apart)
        cauchy = 1 / (1 + chi2 / CAUCHY_SCALE**2)
        scaled = cauchy[:, None, None] * weights
        covariance = np.linalg.inv(scaled.sum(axis=0))
        mean = covariance @ np.einsum("hij,hj->i", scaled, means)
    freedom = 2 * max(cauchy.sum() - 1, 0.5)
    return mean, covariance * max(1.0, float(cauchy @ chi2) / freedom)


def _height_of_camera(eyes, stances) -> float:
    """Returns the height of the camera over the stances, m; 1.5 m without any."""
    every = np.concatenate([np.zeros((0, 3)), *stances])
    if not len(every):
        return 1.5
    return float(max(abs(np.median(eyes[:, 1]) - np.median(every[:, 1])), 0.3))


def _tilts(
    trunk_tilt: tuple[np.ndarray, np.ndarray] | None,
    worse: float,
    edges: Vertical | None,
) -> list[tuple[float, np.ndarray, np.ndarray]]:
    """Returns the distribution of the tilt of up given trunks and edges: a mixture of
    normal distributions (weight, mean, covariance); empty without either cue."""
    trunks, verticals = [], []
    if trunk_tilt is not None:
        mean, own = trunk_tilt
        trunks = [(1 - worse, mean, own), (worse, mean, _TRUNK_OUTLIER_FACTOR**2 * own)]
    if edges is not None:
        wrong, sigma = _EDGE_OUTLIERS
        wide = edges.covariance + sigma**2 * np.eye(2)
        verticals = [(1 - wrong, edges.tilt, edges.covariance)]
        verticals.append((wrong, edges.tilt, wide))
    if not trunks or not verticals:
        return trunks or verticals
    both = []
    for (p, mean, own), (q, tilt, other) in itertools.product(trunks, verticals):
        likelihood, explained = _agreement(tilt - mean, own + other)
        covariance = own - own @ np.linalg.solve(own + other, own)
        both.append((p * q * likelihood, mean + own @ explained, covariance))
    return both


def _agreement(
    apart: Float[np.ndarray, " 2"], covariance: Float[np.ndarray, "2 2"]
) -> tuple[float, Float[np.ndarray, " 2"]]:
    """Returns the normal likelihood of a difference, up to a constant, and the inverse
    covariance times the difference."""
    explained = np.linalg.solve(covariance, apart)
    likelihood = np.exp(-apart @ explained / 2) / np.sqrt(np.linalg.det(covariance))
    return float(likelihood), explained


class _Posterior(NamedTuple):
    """The posterior of the tilt of up and of the slope of the ground: their means, and
    the standard deviations of up (`Upright`)."""

    tilt: Float[np.ndarray, " 2"]
    slope: Float[np.ndarray, " 2"]
    sigma: float
    slope_probability: float
    sigma_if_sloping: float


def _combined(
    up_tilts: list[tuple[float, np.ndarray, np.ndarray]], ground: Plane | None
) -> _Posterior:
    """Returns the posterior of up given the tilts of trunks and edges (`_tilts`) and
    the plane of the ground.

    Up is a mixture: most ground is level, and up is then known to some tenths of a
    degree; trunks are too inaccurate to recognise ground that slopes, on which up is
    off by most of the slope.
    """
    unknown = np.full(2, np.nan)
    if not up_tilts:
        if ground is None:
            return _Posterior(np.zeros(2), unknown, np.inf, np.nan, np.inf)
        level = ground.covariance + _LEVEL_SLOPE_SIGMA_RAD**2 * np.eye(2)
        steep = ground.covariance + _STEEP_SLOPE_SIGMA_RAD**2 * np.eye(2)
        sigma, worst = _largest(level), _largest(steep)
        return _Posterior(-ground.gradient, np.zeros(2), sigma, np.nan, worst)
    density, tilts, slopes, covariances, is_sloping = [], [], [], [], []
    for p, mean, own in up_tilts:
        if ground is None:
            density.append(p)
            tilts.append(mean)
            slopes.append(unknown)
            covariances.append(own)
            is_sloping.append(True)
            continue
        # Up is `mean + e`, with covariance `own`; the ground's gradient is
        # `slope - up`.
        apart = ground.gradient + mean
        for q, sigma in _GROUND_KINDS:
            total = own + ground.covariance + sigma**2 * np.eye(2)
            likelihood, explained = _agreement(apart, total)
            density.append(p * q * likelihood)
            tilts.append(mean - own @ explained)
            slopes.append(sigma**2 * explained)
            is_sloping.append(sigma == _STEEP_SLOPE_SIGMA_RAD)
            covariances.append(own - own @ np.linalg.solve(total, own))
    # If all likelihoods underflow, the widest combination, the last, is chosen.
    weight = np.array(density)
    weight[-1] += 1e-300
    weight = weight / weight.sum()
    tilt = weight @ np.array(tilts)
    spread = np.array(
        [c + np.outer(t - tilt, t - tilt) for c, t in zip(covariances, tilts)]
    )
    mean = lambda share: _largest(np.tensordot(share / share.sum(), spread, 1))
    sloping = weight * np.array(is_sloping)
    return _Posterior(
        tilt=tilt,
        slope=weight @ np.array(slopes),
        sigma=mean(weight),
        slope_probability=np.nan if ground is None else float(sloping.sum()),
        sigma_if_sloping=mean(sloping),
    )


def _largest(covariance: Float[np.ndarray, "2 2"]) -> float:
    """Returns the largest standard deviation in any direction."""
    return float(np.sqrt(np.linalg.eigvalsh(covariance).max()))


def level(
    T_WC: Float[np.ndarray, "t 4 4"], cues: GravityCues, edges: Edges | None = None
) -> tuple[Float[np.ndarray, "4 4"], Upright]:
    """Returns the rigid motion to a world whose y axis is up, and the estimate of up.

    Cues are evaluated by `find_upright` in a roughly upright world, whose y axis is up
    as measured, if it is, else the mean direction of people's trunks, or, without
    people, the first camera's -y. `up` and `normal` of the returned `Upright` are in
    the given world. Where up is measured, it is estimated a second time without that,
    for comparison.

    Args:
        T_WC: poses of the camera, m.
        cues: people, map and measured up direction, in the same world.
        edges: straight edges in the images, in the same world.
    """
    up = -T_WC[0, :3, 1]
    if cues.measured_up is not None:
        up = cues.measured_up
    elif cues.present.any():
        up = cues.trunks[cues.present].sum(axis=0)
    rough = upright(T_WC, up / np.linalg.norm(up))
    turn = rough[:3, :3]
    vertical = None if edges is None else find_vertical(edges.rotated(turn))
    found = find_upright(cues.moved(rough), vertical)
    whole = upright(rough @ T_WC, found.up) @ rough
    found = dataclasses.replace(
        found, up=turn.T @ found.up, normal=turn.T @ found.normal
    )
    if cues.measured_up is not None:
        without = dataclasses.replace(cues, measured_up=None)
        _, unaided = level(T_WC, without, edges)
        cosine = float(np.clip(unaided.up @ turn[1], -1, 1))
        found = dataclasses.replace(
            found,
            unaided=float(np.arccos(cosine)),
            unaided_sigma=unaided.sigma_if_sloping,
        )
    return whole, found


def measured_up(
    T_WC: Float[np.ndarray, "t 4 4"], gravity: tuple[float, ...]
) -> Float[np.ndarray, " 3"] | None:
    """Returns the up direction in the world, opposite to `gravity` in the first
    camera's axes; `None` if `gravity` is empty, which means not measured."""
    return -T_WC[0, :3, :3] @ np.asarray(gravity, float) if gravity else None


def upright(
    T_WC: Float[np.ndarray, "t 4 4"], up: Float[np.ndarray, " 3"]
) -> Float[np.ndarray, "4 4"]:
    """Returns the rigid motion to a world whose origin is the first camera, with y
    along the unit vector `up` and z horizontal in the camera's viewing direction."""
    y = up
    ahead = T_WC[0, :3, 2] - y * (y @ T_WC[0, :3, 2])
    if np.linalg.norm(ahead) < 1e-3:  # The camera looks straight up or down.
        ahead = T_WC[0, :3, 1] - y * (y @ T_WC[0, :3, 1])
    z = ahead / np.linalg.norm(ahead)
    turn = np.eye(4)
    turn[:3, :3] = np.stack([np.cross(y, z), y, z])
    turn[:3, 3] = -turn[:3, :3] @ T_WC[0, :3, 3]
    return turn
