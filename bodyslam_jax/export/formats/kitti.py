"""Writes KITTI odometry (Geiger et al., CVPR 2012): one camera-to-world 3x4 matrix per
line."""

from pathlib import Path

import numpy as np

from bodyslam_jax.export.formats.scene import Scene


def write(path: Path, scene: Scene) -> None:
    """Writes the poses of the frames with a located camera, m, one row per frame.

    The format has no timestamps: line k is the k-th located frame.
    """
    poses = scene.result.T_WC[scene.result.located, :3].reshape(-1, 12)
    np.savetxt(path, poses, fmt="%.9f")
