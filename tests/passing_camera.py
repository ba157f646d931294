"""A camera that passes points of a scene, for tests of the live estimate."""

import numpy as np

from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.io.camera.calibration import project_points
from bodyslam_jax.types import Intrinsics

CAMERA = Intrinsics(np.array([525.0, 525.0, 319.5, 239.5]), 640, 480)


def passing(frames: int, rng: np.random.Generator):
    """A camera that passes 300 points, 5 cm a frame: poses and pixels."""
    points = rng.uniform([-6, -2, 3], [9, 2, 8], (300, 3))
    for k in range(frames):
        T = np.eye(4)
        T[:3, :3] = so3.exp(np.array([0.0, 0.002 * k, 0.0]))
        T[:3, 3] = [0.05 * k, 0.01 * np.sin(k / 3), 0.0]
        p_C = (points - T[:3, 3]) @ T[:3, :3]
        uv = project_points(CAMERA, p_C)
        seen = (p_C[:, 2] > 0.5) & (uv > 0).all(1) & (uv < [640, 480]).all(1)
        noise = 0.3 * rng.standard_normal(uv.shape)
        yield T, np.flatnonzero(seen), (uv + noise)[seen]
