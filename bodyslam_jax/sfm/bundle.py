"""A small bundle adjustment in NumPy, for the front end alone.

It minimises reprojection errors in undistorted images under a Cauchy loss, by
Levenberg--Marquardt with the points eliminated (Schur complement). It serves
incremental mapping only; the final estimate is that of the factor graph.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.geometry.arrays import sum_by


@dataclasses.dataclass
class Scene:
    """Cameras and points, up to scale; unlike other states, it is changed in place."""

    R_CW: Float[np.ndarray, "t 3 3"]
    centre: Float[np.ndarray, "t 3"]
    """Camera centres in the world."""
    points: Float[np.ndarray, "l 3"]


@dataclasses.dataclass(frozen=True)
class Views:
    """`m` observations in undistorted images at depth 1."""

    frame: Int[np.ndarray, " m"]
    landmark: Int[np.ndarray, " m"]
    xy: Float[np.ndarray, "m 2"]

    def __getitem__(self, index: np.ndarray) -> "Views":
        return Views(self.frame[index], self.landmark[index], self.xy[index])


def rows_by(index: Int[np.ndarray, " m"], num: int) -> list[Int[np.ndarray, " n"]]:
    """Returns, for each number below `num`, the rows of `index` that have it."""
    order = np.argsort(index, kind="stable")
    ends = np.searchsorted(index[order], np.arange(1, num + 1))
    return np.split(order, ends)[:num]


ERROR_PER_SIGMA = 1.18
"""Median length of a vector of two normal errors, in units of their sigma."""
_MIN_DEPTH = 1e-6
"""Depth, in units of the map, below which a point is behind the camera."""
_INITIAL_DAMPING, _MIN_DAMPING = 1e-8, 1e-13
"""Initial and least damping, relative to the diagonal: the smallest eigenvalue of a
long path is some 1e-10 of that of a single camera."""


def errors(scene: Scene, views: Views) -> Float[np.ndarray, " m"]:
    """Returns reprojection errors at depth 1 (times the focal length: px); `inf` for
    points behind the camera."""
    p_C = _in_camera(scene, views)
    z = p_C[:, 2]
    safe = np.where(z > _MIN_DEPTH, z, 1.0)
    error = np.linalg.norm(p_C[:, :2] / safe[:, None] - views.xy, axis=-1)
    return np.where(z > _MIN_DEPTH, error, np.inf)


def jacobian_of_points(scene: Scene, views: Views) -> Float[np.ndarray, "m 2 3"]:
    """Returns the derivative of each observation by its point; 0 for a point behind the
    camera."""
    p_C = _in_camera(scene, views)
    z = np.where(p_C[:, 2] > _MIN_DEPTH, p_C[:, 2], np.inf)[:, None, None]
    xy = np.where(np.isfinite(z[:, 0]), p_C[:, :2] / z[:, 0], 0.0)
    R = scene.R_CW[views.frame]
    return (R[:, :2] - xy[:, :, None] * R[:, 2:]) / z


def adjust(
    scene: Scene,
    views: Views,
    free: Bool[np.ndarray, " t"],
    *,
    loss: float,
    iterations: int = 10,
    tolerance: float = 1e-4,
) -> float:
    """Moves the points of `views` and the cameras in `free` to fit, in place.

    Args:
        loss: scale of the Cauchy loss, in units of depth-1 coordinates.
        tolerance: relative decrease of the cost below which it stops.

    Returns: the cost, in squared `loss`.
    """
    cameras = np.flatnonzero(free & np.isin(np.arange(len(free)), views.frame))
    points, point_of = np.unique(views.landmark, return_inverse=True)
    camera_of = np.full(len(free), -1)
    camera_of[cameras] = np.arange(len(cameras))
    camera_of = camera_of[views.frame]
    damping, cost = _INITIAL_DAMPING, _cost(scene, views, loss)
    for _ in range(iterations):
        system = _linearise(scene, views, camera_of, point_of, loss, len(cameras))
        better = None
        for _ in range(4):
            step = _solve(system, damping, len(points))
            if step is None:
                damping *= 100
                continue
            trial = _moved(scene, cameras, points, *step)
            new = _cost(trial, views, loss)
            if new < cost:
                better = trial, new
                break
            if new < (1 + tolerance) * cost:
                break  # converged, up to rounding
            damping *= 100
        if better is None:
            break
        trial, new = better
        scene.R_CW, scene.centre, scene.points = trial.R_CW, trial.centre, trial.points
        damping = max(damping / 10, _MIN_DAMPING)
        done = cost - new < tolerance * cost
        cost = new
        if done:
            break
    return cost


def _in_camera(scene: Scene, views: Views) -> np.ndarray:
    offset = scene.points[views.landmark] - scene.centre[views.frame]
    return np.einsum("mij,mj->mi", scene.R_CW[views.frame], offset)


def _cost(scene: Scene, views: Views, loss: float) -> float:
    # A point behind the camera has a large, bounded error: the loss must stay finite.
    error = np.minimum(errors(scene, views), 10.0) / loss
    return float(np.log1p(error**2).sum())


def _linearise(
    scene: Scene,
    views: Views,
    camera_of: np.ndarray,
    point_of: np.ndarray,
    loss: float,
    num_cameras: int,
) -> tuple[np.ndarray, ...]:
    """Returns the normal equations in blocks: cameras, points, and between them."""
    p_C = _in_camera(scene, views)
    front = p_C[:, 2] > _MIN_DEPTH
    z = np.where(front, p_C[:, 2], 1.0)
    xy = p_C[:, :2] / z[:, None]
    r = (xy - views.xy) / loss
    weight = np.where(front, 1 / (1 + (r**2).sum(axis=-1)), 0.0)
    root = np.sqrt(weight)[:, None]
    J_pi = np.zeros((len(z), 2, 3))
    J_pi[:, 0, 0] = J_pi[:, 1, 1] = 1 / z
    J_pi[:, :, 2] = -xy / z[:, None]
    J_pi *= root[..., None] / loss
    r = r * root
    B = J_pi @ scene.R_CW[views.frame]  # with respect to the point
    # R <- exp(w) R turns p_C by w x p_C; the centre moves opposite to the point.
    cross = np.zeros((len(z), 3, 3))
    x, y, d = p_C.T
    cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = d, -y, x
    cross[:, 1, 0], cross[:, 2, 0], cross[:, 2, 1] = -d, y, -x
    A = np.concatenate([J_pi @ cross, -B], axis=-1)
    num_points = int(point_of.max()) + 1
    V = sum_by(point_of, np.einsum("mki,mkj->mij", B, B), num_points)
    b_p = sum_by(point_of, np.einsum("mki,mk->mi", B, r), num_points)
    moving = camera_of >= 0
    A, r_c, camera = A[moving], r[moving], camera_of[moving]
    U = sum_by(camera, np.einsum("mki,mkj->mij", A, A), num_cameras)
    b_c = sum_by(camera, np.einsum("mki,mk->mi", A, r_c), num_cameras)
    W = np.einsum("mki,mkj->mij", A, B[moving])
    order = np.argsort(camera, kind="stable")
    return U, b_c, V, b_p, W[order], camera[order], point_of[moving][order]


def _solve(
    system: tuple[np.ndarray, ...], damping: float, num_points: int
) -> tuple[np.ndarray, np.ndarray] | None:
    """Returns the step of cameras (k, 6) and points (l, 3), or None if singular."""
    U, b_c, V, b_p, W, camera, point = system
    eye3, eye6 = np.eye(3), np.eye(6)
    V = V * (1 + damping * eye3) + 1e-9 * np.trace(V, axis1=1, axis2=2).mean() * eye3
    V_inverse = np.linalg.inv(V)
    k = len(U)
    if k == 0:
        return np.zeros((0, 6)), -np.einsum("lij,lj->li", V_inverse, b_p)
    U = U * (1 + damping * eye6)
    starts = np.searchsorted(camera, np.arange(k + 1))
    shape = (6 * k, 3 * num_points)
    rows = sparse.bsr_matrix((W, point, starts), shape=shape)
    Y = sparse.bsr_matrix((W @ V_inverse[point], point, starts), shape=shape)
    S = -np.asarray((Y @ rows.T).todense())
    blocks = S.reshape(k, 6, k, 6)
    blocks[np.arange(k), :, np.arange(k)] += U
    rhs = b_c.ravel() - Y @ b_p.ravel()
    try:
        step_c = -cho_solve(cho_factor(S), rhs)
    except LinAlgError:
        return None
    back = b_p.ravel() + rows.T @ step_c
    step_p = -np.einsum("lij,lj->li", V_inverse, back.reshape(-1, 3))
    return step_c.reshape(k, 6), step_p


def _moved(
    scene: Scene,
    cameras: np.ndarray,
    points: np.ndarray,
    step_c: np.ndarray,
    step_p: np.ndarray,
) -> Scene:
    R, centre, moved = scene.R_CW.copy(), scene.centre.copy(), scene.points.copy()
    if len(cameras):
        R[cameras] = so3.exp(step_c[:, :3]) @ R[cameras]
        centre[cameras] += step_c[:, 3:]
    moved[points] += step_p
    return Scene(R, centre, moved)
