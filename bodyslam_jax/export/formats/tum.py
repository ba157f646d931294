"""Writes TUM (Sturm et al., IROS 2012): `timestamp tx ty tz qx qy qz qw`, camera to
world."""

from pathlib import Path

from bodyslam_jax.export.formats.scene import Scene
from bodyslam_jax.io import write_tum


def write(path: Path, scene: Scene) -> None:
    """Writes the poses of the frames with a located camera, m and s."""
    result = scene.result
    located = result.located
    write_tum(path, result.timestamps[located], result.T_WC[located])
