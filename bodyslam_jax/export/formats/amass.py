"""Writes AMASS (Mahmood et al., ICCV 2019): one person's pose parameters as SMPL-H
`.npz`.

SMPL-H's poses consist of SMPL's first 22 joints and 30 joints of the hands, which are
left at rest; rotations of SMPL's two hand joints move no other joint. The rate is
written under both names that AMASS uses.
"""

from pathlib import Path

import numpy as np

from bodyslam_jax.export.formats.scene import Scene, at_constant_rate

_NUM_BODY_PARAMETERS, _NUM_SMPLH_PARAMETERS = 66, 156
"""Numbers of pose parameters: of SMPL-H's body, and including hands."""
_NUM_BETAS, _NUM_DMPLS = 16, 8
"""Numbers of shape and soft-tissue coefficients in AMASS's files."""


def write(path: Path, scene: Scene) -> None:
    """Writes the only person of a scene, one row per frame of the video.

    Frames without the person repeat the last pose; `present` marks the others. `betas`
    are those of the body model of the run, which `body_model` names; they represent the
    person's shape with that model only.
    """
    scene = at_constant_rate(scene).with_held_poses()
    result = scene.result
    num = len(result.timestamps)
    poses = np.zeros((num, _NUM_SMPLH_PARAMETERS))
    poses[:, :_NUM_BODY_PARAMETERS] = result.poses[0, :, :_NUM_BODY_PARAMETERS]
    rate = np.array(result.fps)
    # An open file, because `savez` would add a suffix to a temporary file's name.
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
