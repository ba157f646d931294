"""Relative pose, rotation and resection of calibrated views."""

import cv2
import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.geometry.arrays import SIGMA_OF_MEDIAN
from bodyslam_jax.geometry.triangulation import unit_rays

_NOISE_PER_MEDIAN_OF_TWO = 0.8493
"""Standard deviation of normal errors over the median length of a vector of two: 1 /
sqrt(2 ln 2)."""
_VARIANCE_OF_LOG_RATIO = 1.9
"""Variance of the logarithm of the ratio of these two estimates from n pairs, times n:
1.36 + 0.52 by the asymptotic variances of the two medians."""
_LEAST_LOG_RATIO = 5.0
"""Least logarithm of that ratio, in standard deviations, that tells translation: by
chance in 3e-7 of the pairs of views, of which some hundreds are tried."""
_LEAST_NOISE = 0.1
"""Least noise of a track, in thresholds: that of Lucas--Kanade under good light."""
_CAUCHY_SCALE = 2.385
"""Scale of the Cauchy loss over the noise, for an efficiency of 95 % under normal
errors (Zhang, Image and Vision Computing 1997)."""
_NUM_TURN_STEPS = 12


def essential_matrix(
    xy_a: Float[np.ndarray, "n 2"],
    xy_b: Float[np.ndarray, "n 2"],
    threshold: float,
    *,
    chance: float = 1e-3,
    most: int = 500,
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Returns the essential matrix by five-point RANSAC (MAGSAC), and which pairs are
    inliers (n, 1).

    Args:
        chance: probability of no sample without outliers.
        most: number of samples at most.
    """
    how = (cv2.USAC_MAGSAC, 1 - chance, threshold, most)
    E, inlier = cv2.findEssentialMat(xy_a, xy_b, np.eye(3), *how)
    return E, inlier


def relative_pose(
    xy_a: Float[np.ndarray, "n 2"], xy_b: Float[np.ndarray, "n 2"], threshold: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Returns the rotation R_BA (3, 3), the direction of A's centre in B (3,) and the
    inliers (n,), or `None`.

    It is five-point RANSAC, and the decomposition with most points in front.
    """
    E, inlier = essential_matrix(xy_a, xy_b, threshold, chance=1e-4, most=2000)
    if E is None or E.shape != (3, 3) or inlier is None:
        return None
    _, R, t, good, _ = cv2.recoverPose(
        E, xy_a, xy_b, np.eye(3), distanceThresh=1e4, mask=inlier.copy()
    )
    return R, t[:, 0], good.ravel() > 0


def planar_poses(
    xy_a: Float[np.ndarray, "n 2"],
    xy_b: Float[np.ndarray, "n 2"],
    threshold: float,
    share: float,
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Returns poses as `relative_pose` does, if a plane explains a share of the points.

    The homography of a plane decomposes into two poses with all points in front, such
    as a translation along the plane, and a rotation with a translation across it
    (Faugeras & Lustman, IJPRAI 1988). Two views cannot distinguish them, a third can.
    """
    H, inlier = cv2.findHomography(xy_a, xy_b, cv2.USAC_MAGSAC, threshold)
    if H is None or inlier is None or inlier.mean() < share:
        return []
    good = inlier.ravel() > 0
    seen = np.column_stack([xy_a, np.ones(len(xy_a))])
    found = []
    for R, t, normal in zip(*cv2.decomposeHomographyMat(H, np.eye(3))[1:], strict=True):
        in_front = seen[good] @ normal[:, 0] > 0
        length = float(np.linalg.norm(t))
        if in_front.mean() > 0.5 and length > 0:
            found.append((R, t[:, 0] / length, good))
    return found


def fit_rotation(
    ray_a: Float[np.ndarray, "n 3"], ray_b: Float[np.ndarray, "n 3"], scale: float
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, " n"]]:
    """Estimates the robust rotation R with `ray_b = R ray_a`; returns it with the
    residual angles (rad).

    Args:
        scale: scale of the Cauchy loss, rad.
    """
    R, away = np.eye(3), np.zeros(len(ray_a))
    for _ in range(10):
        weight = 1 / (1 + (away / scale) ** 2)
        U, _, Vt = np.linalg.svd((ray_b * weight[:, None]).T @ ray_a)
        R = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
        away = np.linalg.norm(ray_b - ray_a @ R.T, axis=-1)
    return R, away


def sampson(
    E: Float[np.ndarray, "3 3"],
    xy_a: Float[np.ndarray, "n 2"],
    xy_b: Float[np.ndarray, "n 2"],
) -> Float[np.ndarray, " n"]:
    """Returns the first-order distance of each pair from the epipolar constraint, at
    depth 1, as an error of each of the two points."""
    one = np.ones((len(xy_a), 1))
    a, b = np.concatenate([xy_a, one], axis=-1), np.concatenate([xy_b, one], axis=-1)
    at_b, at_a = a @ E.T, b @ E
    value = np.einsum("ni,ni->n", b, at_b)
    norm = np.sqrt((at_b[:, :2] ** 2).sum(axis=-1) + (at_a[:, :2] ** 2).sum(axis=-1))
    return np.abs(value) / np.maximum(norm, 1e-12)


def turn_with_focal(
    xy_a: Float[np.ndarray, "n 2"],
    xy_b: Float[np.ndarray, "n 2"],
    threshold: float,
    sigma: float,
) -> tuple[float, Float[np.ndarray, " n"]]:
    """Fits a rotation between two views whose focal length is uncertain.

    **Arguments:** `sigma`: relative standard deviation of the focal length.

    **Returns:** the focal length, relative to the assumed one, and the residuals at
    depth 1. Of a camera that turns these are the lengths of two errors with the noise
    of a track.
    """
    R, _ = fit_rotation(unit_rays(xy_a), unit_rays(xy_b), threshold)
    log_f, away = 0.0, np.zeros(len(xy_a))
    for _ in range(_NUM_TURN_STEPS):
        f = np.exp(log_f)
        ray = np.column_stack([xy_a / f, np.ones(len(xy_a))])
        p = ray @ R.T
        z = np.maximum(p[:, 2], 1e-3)
        q = f * p[:, :2] / z[:, None]
        by_p = np.zeros((len(p), 2, 3))
        by_p[:, 0, 0] = by_p[:, 1, 1] = f / z
        by_p[:, :, 2] = -q / z[:, None]
        by_a = by_p @ R[:, :2] / f
        J = np.zeros((len(p), 2, 4))
        J[..., :3] = np.cross(p[:, None], by_p)
        J[..., 3] = q - np.einsum("nij,nj->ni", by_a, xy_a)
        # Both points have noise; that of the first is seen through the rotation.
        spread = np.linalg.cholesky(np.eye(2) + by_a @ np.swapaxes(by_a, 1, 2))
        r = np.linalg.solve(spread, (q - xy_b)[..., None])[..., 0]
        J = np.linalg.solve(spread, J)
        away = np.linalg.norm(r, axis=-1)
        noise = _NOISE_PER_MEDIAN_OF_TWO * float(np.median(away))
        noise = max(noise, _LEAST_NOISE * threshold)
        weight = 1 / (1 + (away / (_CAUCHY_SCALE * noise)) ** 2)
        H = np.einsum("n,nki,nkj->ij", weight, J, J) + 1e-12 * np.eye(4)
        g = np.einsum("n,nki,nk->i", weight, J, r)
        prior = (noise / max(sigma, 1e-6)) ** 2
        H[3, 3] += prior
        g[3] += prior * log_f
        step = -np.linalg.solve(H, g)
        R = so3.exp(step[:3]) @ R
        log_f += float(np.clip(step[3], -0.2, 0.2))
    return float(np.exp(log_f)), away


def translation_is_told(
    turned: Float[np.ndarray, " n"],
    epipolar: Float[np.ndarray, " n"],
    threshold: float,
) -> bool:
    """Returns true if two views show more than a rotation.

    The noise that a rotation needs is compared with the noise across epipolar lines,
    which depths do not explain: a robust F-test, as what the translation adds is one
    depth of each point.

    **Arguments:** residuals of all pairs by `turn_with_focal` and by `sampson`.
    """
    noise = max(SIGMA_OF_MEDIAN * float(np.median(epipolar)), _LEAST_NOISE * threshold)
    needed = _NOISE_PER_MEDIAN_OF_TWO * float(np.median(turned))
    spread = (_VARIANCE_OF_LOG_RATIO / len(turned)) ** 0.5
    return bool(needed > noise * np.exp(_LEAST_LOG_RATIO * spread))


def resect(
    points: Float[np.ndarray, "n 3"],
    xy: Float[np.ndarray, "n 2"],
    threshold: float,
    guess: tuple[np.ndarray, np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray, Bool[np.ndarray, " n"]] | None:
    """Returns the camera (R_CW, centre) that sees `points` at `xy`, and which of them
    fit, or `None`.

    It starts from `guess` if that explains most of the points, else from RANSAC.
    """
    if len(points) < 6:
        return None
    if guess is not None:
        R, centre = guess
        good = _fits(R, centre, points, xy, 10 * threshold)
        if good.sum() >= max(10, 0.6 * len(points)):
            found = refine_pose(R, centre, points, xy, threshold)
            if found is not None and found[2].sum() >= max(10, 0.6 * len(points)):
                return found
    try:
        ok, rotvec, t, inlier = cv2.solvePnPRansac(
            points,
            xy,
            np.eye(3),
            None,
            iterationsCount=500,
            reprojectionError=2 * threshold,
            confidence=0.9999,
            flags=cv2.SOLVEPNP_SQPNP,
        )
    except cv2.error:  # SQPnP fails for a sample whose points coincide.
        return None
    if not ok or inlier is None or len(inlier) < 6:
        return None
    R = so3.exp(rotvec[:, 0])
    return refine_pose(R, -R.T @ t[:, 0], points, xy, threshold)


def _fits(
    R: np.ndarray,
    centre: np.ndarray,
    points: np.ndarray,
    xy: np.ndarray,
    threshold: float,
) -> np.ndarray:
    p_C = (points - centre) @ R.T
    front = p_C[:, 2] > 1e-6
    z = np.where(front, p_C[:, 2], 1.0)
    return front & (np.linalg.norm(p_C[:, :2] / z[:, None] - xy, axis=-1) < threshold)


def refine_pose(
    R: np.ndarray,
    centre: np.ndarray,
    points: np.ndarray,
    xy: np.ndarray,
    threshold: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Refines a pose by reweighted Gauss--Newton; `None` if it diverges."""
    start_z = np.median((points - centre) @ R[2])
    for _ in range(10):
        p_C = (points - centre) @ R.T
        front = p_C[:, 2] > 1e-6
        if front.sum() < 6:
            return None
        x, y, z = p_C[front].T
        r = p_C[front, :2] / z[:, None] - xy[front]
        root = 1 / np.sqrt(1 + (r**2).sum(axis=-1) / threshold**2)
        J = np.zeros((len(z), 2, 6))
        u, v = x / z, y / z
        J[:, 0, :3] = np.stack([-u * v, 1 + u * u, -v], axis=-1)
        J[:, 1, :3] = np.stack([-1 - v * v, u * v, u], axis=-1)
        J[:, 0, 3:] = -(R[0] - u[:, None] * R[2]) / z[:, None]
        J[:, 1, 3:] = -(R[1] - v[:, None] * R[2]) / z[:, None]
        A = (J * root[:, None, None]).reshape(-1, 6)
        b = (r * root[:, None]).ravel()
        H = A.T @ A
        H += 1e-9 * np.diag(np.diag(H)) + 1e-12 * np.eye(6)
        step = -np.linalg.solve(H, A.T @ b)
        R = so3.exp(step[:3]) @ R
        centre = centre + step[3:]
        if np.linalg.norm(step[3:]) > 100 * abs(start_z) + 1e-9:
            return None
        if np.abs(step[:3]).max() < 1e-8:
            break
    return R, centre, _fits(R, centre, points, xy, 3 * threshold)


def epipolar_distance(
    R: Float[np.ndarray, "3 3"],
    t: Float[np.ndarray, " 3"],
    xy_a: Float[np.ndarray, "n 2"],
    xy_b: Float[np.ndarray, "n 2"],
) -> Float[np.ndarray, " n"]:
    """Returns `sampson` of the relative pose R_BA and t."""
    x, y, z = t
    return sampson(np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ R, xy_a, xy_b)
