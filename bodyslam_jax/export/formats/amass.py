"""AMASS (Mahmood et al., ICCV 2019): one person's pose parameters as SMPL-H `.npz`.

SMPL-H's poses are SMPL's first 22 joints and 30 of the hands, which are left at rest;
the turns of SMPL's two hand joints move no other joint. The rate stands under both
names that AMASS has for it.
"""

from pathlib import Path

import numpy as np

from bodyslam_jax.export.formats.scene import Scene, at_constant_rate

_BODY, _SMPLH = 66, 156
"""Numbers of a pose: of SMPL-H's body, and with hands."""
_NUM_BETAS, _NUM_DMPLS = 16, 8


def write(path: Path, scene: Scene) -> None:
    """Writes the only person of a scene, one row a frame of the video.

    Frames without the person repeat the last pose; `present` marks them. `betas` are
    those of the body model of the run, which `body_model` names: only with that model
    do they mean the person's shape.
    """
    scene = at_constant_rate(scene).with_held_poses()
    result = scene.result
    num = len(result.timestamps)
    poses = np.zeros((num, _SMPLH))
    poses[:, :_BODY] = result.poses[0, :, :_BODY]
    rate = np.array(result.fps)
    # Through a file: `savez` would add a suffix to the name of a temporary file.
    with path.open("wb") as file:
        np.savez_compressed(
            file,
            poses=poses,
            trans=result.trans[0],
            betas=np.pad(result.betas[0], (0, _NUM_BETAS - 10)),
            dmpls=np.zeros((num, _NUM_DMPLS)),
            gender=np.array("neutral"),
            mocap_framerate=rate,
            mocap_frame_rate=rate,
            present=result.present[0],
            body_model=np.array(scene.body.name),
        )
