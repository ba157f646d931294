"""Compiles all programs of a running estimate on a synthetic scene, before the
video."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from bodyslam_jax import solver
from bodyslam_jax.body import BodyModel, local_keypoints
from bodyslam_jax.config import Config
from bodyslam_jax.graph import CHUNK
from bodyslam_jax.io.camera.calibration import project_points
from bodyslam_jax.online.estimate import joints_of, placed
from bodyslam_jax.online.window import Window
from bodyslam_jax.online.window_content import FRAMES, Measured
from bodyslam_jax.people.filter import PersonFilter
from bodyslam_jax.pipeline.to_metric import sole_height
from bodyslam_jax.types import Intrinsics

_NUM_POINTS = 120
_CAMERA_SPEED = 0.03
"""Speed of the camera, map units a frame."""


def compile_all(
    intrinsics: Intrinsics,
    body: BodyModel,
    config: Config,
    *,
    fps: float,
    step: float,
    places: int,
) -> None:
    """Runs every program of an estimate: a window that moves on, and the filter of a
    person.

    **Arguments:** `fps` of the video; `step` between frames of the window, s; `places`
    for people in it.
    """
    frames, points = _invented(intrinsics, body, step)
    scratch = Window(intrinsics, body, config, 1 / step, places)
    scratch.advance(frames[: FRAMES - CHUNK])
    scratch.advance(frames[FRAMES - CHUNK :])
    solver.marginals(scratch.problem, scratch.state)
    scratch.restart()
    scratch.fixed = True
    scratch.advance(frames[: 2 * CHUNK])
    one = PersonFilter(intrinsics, body, fps, config.people_fit)
    one.update(0.0, points, np.zeros(10))
    one.update(1 / fps, points, np.zeros(10))
    one.predicted(2 / fps)
    found = one.body()
    placed(0, np.eye(4), found.T_CH, found.body_pose, np.zeros(10), body, None)
    sole_height(body, np.zeros(10))
    joints_of(body, np.zeros((FRAMES, 23, 3)), np.zeros(10))


def _invented(
    intrinsics: Intrinsics, body: BodyModel, step: float
) -> tuple[list[Measured], Float[np.ndarray, "25 3"]]:
    """Returns frames of a synthetic scene: a camera that passes points and a standing
    person, with enough frames for the window to move on once; and the person's
    keypoints in the last frame."""
    rng = np.random.default_rng(0)
    middle = (intrinsics.width / 2, intrinsics.height / 2)
    uv = rng.uniform(0.1, 1.9, (_NUM_POINTS, 2)) * middle
    depth = rng.uniform(2.0, 6.0, _NUM_POINTS)
    rays = (uv - intrinsics.params[2:4]) / intrinsics.params[:2]
    places = np.column_stack([rays, np.ones(_NUM_POINTS)]) * depth[:, None]
    dtype = body.joint_template.dtype
    zero = jnp.zeros((23, 3), dtype), jnp.zeros(10, dtype)
    standing = np.asarray(local_keypoints(body, *zero, "body25"), float)
    standing = standing * [1.0, -1.0, -1.0] + [0.0, 0.0, 5.0]
    frames, points = [], np.ones((25, 3))
    for k in range(FRAMES):
        T_WC = np.eye(4)
        T_WC[0, 3] = _CAMERA_SPEED * k
        seen = project_points(intrinsics, places - T_WC[:3, 3])
        points[:, :2] = project_points(intrinsics, standing - T_WC[:3, 3])
        ids = np.arange(_NUM_POINTS) + 1000 * (k // 20)
        measured = seen + 0.3 * rng.standard_normal(seen.shape)
        one = k * step, T_WC, True, ids, measured, {0: points.copy()}
        frames.append(Measured(*one))
    return frames, points
