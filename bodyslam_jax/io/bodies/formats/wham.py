"""WHAM: the bodies in its camera, whose focal length its files do not have."""

import numpy as np

from bodyslam_jax.io.bodies.body_format import BodyFormat, diagonal
from bodyslam_jax.io.bodies.parts import Rows, Video, betas_of, frames_of, numbers_of
from bodyslam_jax.io.formats import Source
from bodyslam_jax.types import Intrinsics


class Wham(BodyFormat):
    """WHAM: `{person: {...}}`; `pose` and `trans` are in the camera, those in a world
    are named `_world`."""

    name = "WHAM"
    layout = ("pose", "trans", "betas", "pose_world")
    by_entry = True

    def focal(self, camera: Intrinsics) -> float:
        """Returns the diagonal, also where a calibration is given: that is for SLAM
        (`compute_cam_intrinsics`, `lib/utils/imutils.py`, called by
        `lib/data/datasets/dataset_custom.py`)."""
        return diagonal(camera)

    def read(self, source: Source, video: Video) -> Rows:
        people = sorted(source.content.items(), key=lambda kv: str(kv[0]))
        frame, person, poses, betas, trans = [], [], [], [], []
        for number, (_, one) in enumerate(people):
            poses.append(numbers_of(one, "pose", (-1, 72)))
            n = len(poses[-1])
            frame.append(frames_of(one, "frame_ids", n, video.num_frames))
            person.append(np.full(n, number))
            betas.append(betas_of(one, "betas", n))
            trans.append(numbers_of(one, "trans", (n, 3)))
        moved = self.refocused(np.concatenate(trans), video)
        return Rows(
            np.concatenate(frame),
            np.concatenate(person),
            np.concatenate(poses),
            np.concatenate(betas),
            moved,
        )
