"""GLAMR, which optimises trajectories; its shapes are a network's."""

import numpy as np

from bodyslam_jax.io.bodies.body_format import BodyFormat
from bodyslam_jax.io.bodies.parts import (
    PELVIS_SMPL,
    Rows,
    Video,
    at_size,
    betas_of,
    focals,
    frames_of,
    join,
    numbers_of,
    refocused,
)
from bodyslam_jax.io.formats import Source


class Glamr(BodyFormat):
    """GLAMR: `root_trans_cam` is the pelvis itself, in the camera of `cam_K`; of one
    person, or of each in `person_data`."""

    name = "GLAMR"
    layout = ("smpl_orient_cam", "root_trans_cam", "smpl_pose")

    def recognises(self, source: Source) -> bool:
        data = source.content
        several = isinstance(data, dict) and "person_data" in data
        return several or super().recognises(source)

    def read(self, source: Source, video: Video) -> Rows:
        data = source.content
        people = data["person_data"] if "person_data" in data else {0: data}
        rows = []
        for number, (_, one) in enumerate(
            sorted(people.items(), key=lambda kv: str(kv[0]))
        ):
            root = numbers_of(one, "smpl_orient_cam", (-1, 3))
            n = len(root)
            trans = numbers_of(one, "root_trans_cam", (n, 3)) - PELVIS_SMPL
            if "cam_K" in one:
                K = np.broadcast_to(numbers_of(one, "cam_K", None), (n, 3, 3))
                K = at_size(K, video)
                pelvis = refocused(
                    trans + PELVIS_SMPL, focals(K), K[:, :2, 2], video.camera
                )
                trans = pelvis - PELVIS_SMPL
            poses = np.concatenate(
                [root, numbers_of(one, "smpl_pose", (n, 69))], axis=-1
            )
            visible = np.asarray(one.get("visible", np.ones(n))).astype(bool)
            frame = frames_of(one, "frames", n, video.num_frames)
            rows.append(
                Rows(
                    frame[visible],
                    np.full(int(visible.sum()), number),
                    poses[visible],
                    betas_of(one, "smpl_beta", n)[visible],
                    trans[visible],
                )
            )
        return join(rows)
