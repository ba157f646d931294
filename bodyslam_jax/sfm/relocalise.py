"""Relocalisation: the camera pose from landmarks mapped earlier, before the drift."""

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from bodyslam_jax.sfm.bundle import Scene
from bodyslam_jax.sfm.multiview import refine_pose

Pose = tuple[np.ndarray, np.ndarray]
"""R_CW (3, 3) and the centre (3,) of a camera."""
_MIN_AGREEING_POINTS = 10
"""Least number of points that agree on a pose."""
_MIN_CHANCE_RATIO = 4.0
"""Least ratio of the points that agree to those that would by chance."""
_ANNEALED_SCALES = (6.0, 3.0, 1.5, 1.0)
"""Successive scales of the loss, in thresholds."""


def near(
    points: Float[np.ndarray, "p 3"],
    xy: Float[np.ndarray, "n 2"],
    pose: Pose,
    radius: float,
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """Returns pairs of rows of `xy` and of projected `points` within `radius` of each
    other in the image at depth 1."""
    R, centre = pose
    p_C = (points - centre) @ R.T
    front = np.flatnonzero(p_C[:, 2] > 1e-6)
    if not len(front):
        return np.zeros(0, int), np.zeros(0, int)
    tree = KDTree(p_C[front, :2] / p_C[front, 2:])
    found = tree.query_ball_point(xy, radius)
    i = np.repeat(np.arange(len(xy)), [len(n) for n in found])
    return i, front[np.concatenate([np.asarray(n, int) for n in found])]


def relocate(
    points: Float[np.ndarray, "k 3"],
    xy: Float[np.ndarray, "k 2"],
    which: Int[np.ndarray, " k"],
    pose: Pose,
    threshold: float,
    share: float,
) -> tuple[Pose | None, float]:
    """Returns the camera pose from `points`, `None` if too few agree, and the drift
    from `pose`: the median shift of the points that agree, at depth 1.

    Most of the pairs may be wrong matches; only correct ones agree on a pose.

    Args:
        which: index of the image point of each row; several rows may share one.
        share: share of wrong pairs that agree by chance.
    """
    least = max(_MIN_AGREEING_POINTS, _MIN_CHANCE_RATIO * share * len(xy))
    agree = lambda projected: len(
        np.unique(which[np.linalg.norm(projected - xy, axis=-1) < threshold])
    )
    before = _project(points, pose)
    R, centre = pose
    # Where the map has hardly drifted, the wide losses are skipped.
    for scale in _ANNEALED_SCALES[2 if agree(before) > least else 0 :]:
        found = refine_pose(R, centre, points, xy, scale * threshold)
        if found is None:
            return None, 0.0
        R, centre, _ = found
    after = _project(points, (R, centre))
    if agree(after) <= least:
        return None, 0.0
    fits = np.linalg.norm(after - xy, axis=-1) < threshold
    away = np.linalg.norm(after - before, axis=-1)[fits]
    return (R, centre), float(np.median(away))


def _project(points: np.ndarray, pose: Pose) -> np.ndarray:
    p_C = (points - pose[1]) @ pose[0].T
    return p_C[:, :2] / np.where(p_C[:, 2] > 1e-6, p_C[:, 2], 1e-6)[:, None]


def with_moved(scene: Scene, frame: int, pose: Pose) -> Scene:
    """Returns all cameras, followed by copies that are moved by the rigid transform
    from camera `frame` to `pose`."""
    R, centre = pose
    turn = R.T @ scene.R_CW[frame]
    R_CW = scene.R_CW @ turn.T
    moved = (scene.centre - scene.centre[frame]) @ turn.T + centre
    return Scene(
        np.concatenate([scene.R_CW, R_CW]),
        np.concatenate([scene.centre, moved]),
        scene.points,
    )
