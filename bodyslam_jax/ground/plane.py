"""Finds the ground of a map, and its slope from standing feet and from landmarks.

The ground is the level plane below the camera with the most points. Slopes are those of
planes in a frame whose y axis is nearly up, each with its covariance; `fused` combines
them.
"""

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from bodyslam_jax.geometry.arrays import SIGMA_OF_MEDIAN

_MIN_LEVEL_COSINE = np.cos(np.radians(20.0))
"""Cosine of the largest angle between the ground's normal and the assumed up direction,
which is only known from people's trunks."""
_MAX_PLANE_DISTANCE = 0.05
"""Inlier distance from the plane, as a share of the camera's height above it."""
_MAX_SHARE_BELOW = 0.15
"""Largest share of points below the ground: under the plane of a table lie more."""
_MIN_PLANE_POINTS = 30
"""Least number of points of a plane; chosen, its effect was not measured."""
_RANSAC_SAMPLES = 1000
"""Number of planes through three random points that RANSAC evaluates."""
_DEGREE = np.pi / 180
CAUCHY_SCALE = 2.4
"""Scale of the Cauchy loss in standard deviations: 95 % as efficient as least squares
where errors are normal."""
_FEET_SLOPE_SIGMA_RAD, _MAP_SLOPE_SIGMA_RAD = 0.5 * _DEGREE, 0.3 * _DEGREE
"""Standard deviations of the systematic slope errors of the plane through feet and of
the map's plane, rad: more feet or points do not reduce them."""
_MAX_AUTOCORRELATION = 0.9
"""Upper bound of the autocorrelation of stance residuals: few stances determine no
larger one."""
_MIN_HEIGHT_SIGMA_M = 0.02
"""Lower bound of the standard deviation of the height of a standing foot, m."""
_RELATIVE_DEPTH_SIGMA = 0.02
"""Relative standard deviation of the distance between camera and stance: the part that
is independent between stances."""
MAX_HEIGHT_SCATTER_M = 0.04
"""Scatter of stances about the map's plane that estimation errors explain, m."""
_MAX_STANCE_OFFSET = 0.25
"""Distance of the median stance from the map's plane, as a share of the camera's
height, above which people do not stand on that plane."""


def find_ground(
    points: Float[np.ndarray, "l 3"],
    eyes: Float[np.ndarray, "t 3"],
    up: Float[np.ndarray, " 3"],
) -> Float[np.ndarray, " 4"] | None:
    """Returns the ground plane `n x + d = 0`, with n a unit vector upwards, by RANSAC.

    Returns `None` if no plane has enough points. `points` and the camera's centres
    `eyes` are in the same, arbitrary unit; `up` is a unit vector that may err by 20
    degrees.
    """
    level = np.median(eyes @ up)
    below = points[points @ up < level]
    if len(below) < _MIN_PLANE_POINTS:
        return None
    rng = np.random.default_rng(0)
    best, most = None, max(_MIN_PLANE_POINTS, 0.15 * len(points))
    for _ in range(_RANSAC_SAMPLES):
        a, b, c = below[rng.choice(len(below), 3, replace=False)]
        plane = _plane(np.cross(b - a, c - a), a, up)
        height = np.median(eyes @ plane[:3] + plane[3])
        if plane[:3] @ up < _MIN_LEVEL_COSINE or height <= 0:
            continue
        away = below @ plane[:3] + plane[3]
        near = np.abs(away) < _MAX_PLANE_DISTANCE * height
        deeper = np.count_nonzero(away < -2 * _MAX_PLANE_DISTANCE * height)
        if near.sum() > most and deeper < _MAX_SHARE_BELOW * len(points):
            best, most = near, near.sum()
    if best is None:
        return None
    chosen = below[best]
    centre = chosen.mean(axis=0)
    return _plane(np.linalg.svd(chosen - centre, full_matrices=False)[2][2], centre, up)


def _plane(
    normal: Float[np.ndarray, " 3"],
    point: Float[np.ndarray, " 3"],
    up: Float[np.ndarray, " 3"],
) -> Float[np.ndarray, " 4"]:
    """Returns the plane through a point with a normal that is made unit and upward."""
    length = np.linalg.norm(normal)
    normal = normal / max(length, 1e-12) * (1 if normal @ up >= 0 else -1)
    return np.append(normal, -normal @ point)


@dataclasses.dataclass(frozen=True)
class Plane:
    """The slope of a plane `y = gradient · (x, z) + const`, in a frame whose y axis is
    nearly up."""

    gradient: Float[np.ndarray, " 2"]
    """dy/dx and dy/dz."""
    covariance: Float[np.ndarray, "2 2"]
    """Covariance of `gradient`, rad²."""


def feet_plane(
    stances: list[Float[np.ndarray, "_ 3"]],
    person_sigma: float | Float[np.ndarray, " h"],
    eye: Float[np.ndarray, " 3"] | None = None,
) -> Plane | None:
    """Fits a plane to the positions of standing feet (m) by robust least squares.

    Returns `None` with fewer than three stances. One height offset per person, with the
    prior standard deviation `person_sigma` (m), is estimated with the plane, as an
    error of a person's size shifts all feet of that person by the same height. The fit
    is iteratively reweighted with a Cauchy loss, whose scale is estimated from the
    median absolute residual. Residuals of successive stances are correlated where the
    ground is not a plane, as on stairs: the covariance grows with their
    autocorrelation.

    Seen from `eye` (m), an error of distance moves a stance along the line of sight, so
    that it rises as it recedes. Where people hardly move, the plane is therefore biased
    towards that line: the covariance grows by the square of the bias that
    `_RELATIVE_DEPTH_SIGMA` explains.
    """
    people = np.concatenate(
        [np.zeros(0, int), *(np.full(len(s), h) for h, s in enumerate(stances))]
    ).astype(int)
    if len(people) < 3:
        return None
    points = np.concatenate(stances)
    centre = points.mean(axis=0)
    x = points - centre
    design = np.column_stack(
        [x[:, [0, 2]], np.ones(len(x)), people[:, None] == np.arange(len(stances))]
    )
    # A weak prior (slope of 45 degrees, any height) makes the system regular.
    offsets = np.broadcast_to(np.asarray(person_sigma) ** -2.0, len(stances))
    prior = np.diag([1.0, 1.0, 1e-6, *offsets])

    def fit(weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the information matrix and the weighted least-squares solution."""
        scaled = design * weight[:, None]
        information = design.T @ scaled + prior
        return information, np.linalg.solve(information, scaled.T @ x[:, 1])

    information, solution = fit(np.full(len(x), (5 * _MIN_HEIGHT_SIGMA_M) ** -2))
    for _ in range(19):
        residual = x[:, 1] - design @ solution
        spread = SIGMA_OF_MEDIAN * np.median(np.abs(residual))
        sigma = max(_MIN_HEIGHT_SIGMA_M, spread * np.sqrt(len(x) / max(len(x) - 3, 1)))
        cauchy = 1 / (1 + (residual / (CAUCHY_SCALE * sigma)) ** 2)
        information, solution = fit(cauchy / sigma**2)
    covariance = np.linalg.inv(information)[:2, :2]
    covariance = covariance * _variance_factor(x[:, 1] - design @ solution, people)
    covariance = covariance + _FEET_SLOPE_SIGMA_RAD**2 * np.eye(2)
    if eye is not None:
        own = np.concatenate([s - s.mean(axis=0) for s in stances if len(s)])
        lean = _lean(own[:, [0, 2]], points - eye)
        covariance = covariance + np.outer(lean, lean)
    return Plane(solution[:2], covariance)


def _lean(
    places: Float[np.ndarray, "n 2"], sight: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, " 2"]:
    """Returns the gradient of a plane through level stances that errors of their
    distance cause: the bias of least squares with errors in the regressors.

    `places` are horizontal positions about each person's mean, `sight` the vectors from
    the eye to the stances, m.
    """
    error = _RELATIVE_DEPTH_SIGMA * sight
    spread = places.T @ places / len(places) + 1e-6 * np.eye(2)
    return np.linalg.solve(spread, error[:, [0, 2]].T @ error[:, 1] / len(error))


def _variance_factor(
    residual: Float[np.ndarray, " n"], people: Int[np.ndarray, " n"]
) -> float:
    """Returns the factor by which first-order autoregressive errors enlarge the
    variance of a mean; 1 without positive autocorrelation."""
    spread = SIGMA_OF_MEDIAN * np.median(np.abs(residual))
    r = np.clip(residual, -3 * spread, 3 * spread)
    same = people[1:] == people[:-1]
    if same.sum() < 4 or not spread:
        return 1.0
    rho = np.sum(r[1:] * r[:-1] * same) / np.sum((r[1:] ** 2 + r[:-1] ** 2) / 2 * same)
    rho = np.clip(rho, 0.0, _MAX_AUTOCORRELATION)
    return float((1 + rho) / (1 - rho))


def map_plane(
    landmarks: Float[np.ndarray, "l 3"],
    eyes: Float[np.ndarray, "t 3"],
    stances: list[Float[np.ndarray, "_ 3"]],
) -> Plane | None:
    """Returns the ground plane of the map's landmarks (m).

    Returns `None` if there is none, or if people do not stand on it. Stances that
    scatter in height over the plane indicate that it lies across steps: its covariance
    grows by their scatter.
    """
    up = np.array([0.0, 1.0, 0.0])
    plane = find_ground(landmarks, eyes, up) if len(landmarks) else None
    if plane is None:
        return None
    normal, offset = plane[:3], plane[3]
    height = float(np.median(eyes @ normal + offset))
    every = np.concatenate([np.zeros((0, 3)), *stances])
    excess = 0.0
    if len(every):
        away = every @ normal + offset
        if height <= 0 or abs(np.median(away)) > _MAX_STANCE_OFFSET * height:
            return None
        excess = max(_scatter_of_level(away) ** 2 - MAX_HEIGHT_SCATTER_M**2, 0.0)
    away = landmarks @ normal + offset
    near = np.abs(away) < _MAX_PLANE_DISTANCE * height
    flat = landmarks[near][:, [0, 2]]
    flat = flat - flat.mean(axis=0)
    # Errors of neighbouring points are correlated: ten count as one.
    information = flat.T @ flat / 10 / max(float(np.var(away[near])), 1e-12)
    covariance = np.linalg.inv(information + np.eye(2))
    if excess:
        covariance += excess * np.linalg.inv(flat.T @ flat / len(flat) + np.eye(2))
    return Plane(
        -normal[[0, 2]] / normal[1],
        covariance + _MAP_SLOPE_SIGMA_RAD**2 * np.eye(2),
    )


def _scatter_of_level(heights: Float[np.ndarray, " n"]) -> float:
    """Returns the standard deviation of heights about their mode, from the shortest
    interval that contains 40 % of them: for a normal distribution, half of its length
    is 0.524 σ."""
    ordered = np.sort(heights)
    count = max(1, round(0.4 * len(ordered)))
    length = ordered[count - 1 :] - ordered[: len(ordered) - count + 1]
    # 0.524: the normal quantile of 70 %, as above.
    return float(length.min()) / 2 / 0.524


def fused(planes: list[Plane]) -> Plane | None:
    """Averages the planes with information (inverse covariance) as weights; `None` for
    an empty list.

    The covariance is enlarged by the squared Birge ratio where the planes disagree.
    """
    if not planes:
        return None
    weights = [np.linalg.inv(plane.covariance) for plane in planes]
    covariance = np.linalg.inv(sum(weights))
    gradient = covariance @ sum(
        w @ plane.gradient for w, plane in zip(weights, planes, strict=True)
    )
    if len(planes) > 1:
        apart = [plane.gradient - gradient for plane in planes]
        chi2 = sum(d @ w @ d for w, d in zip(weights, apart, strict=True))
        covariance = covariance * max(1.0, chi2 / (2 * (len(planes) - 1)))
    return Plane(gradient, covariance)
