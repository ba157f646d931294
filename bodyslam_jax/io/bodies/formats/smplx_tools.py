"""GVHMR and PromptHMR: SMPL-X bodies in the camera, whose β are left out."""

import numpy as np

from bodyslam_jax.io.bodies.body_format import BodyFormat, diagonal
from bodyslam_jax.io.bodies.parts import (
    PELVIS_SMPL,
    PELVIS_SMPLX,
    Rows,
    Video,
    as_rotvec,
    at_size,
    focals,
    frames_of,
    join,
    middle,
    numbers_of,
    refocused,
)
from bodyslam_jax.io.formats import Source
from bodyslam_jax.io.frame_index import InvalidContent
from bodyslam_jax.types import Intrinsics


class Gvhmr(BodyFormat):
    """GVHMR: in the camera of `K_fullimg`, a row per frame."""

    name = "GVHMR"
    layout = ("smpl_params_incam",)

    def focal(self, camera: Intrinsics) -> float:
        """Returns the diagonal (`estimate_focal_length`, `hmr4d/utils/geo/hmr_cam.py`),
        where the file has no `K_fullimg`."""
        return diagonal(camera)

    def read(self, source: Source, video: Video) -> Rows:
        data = source.content
        body = data["smpl_params_incam"]
        root = numbers_of(body, "global_orient", (-1, 3))
        n = len(root)
        trans = numbers_of(body, "transl", (n, 3)) + PELVIS_SMPLX - PELVIS_SMPL
        if "K_fullimg" in data:
            K = np.broadcast_to(numbers_of(data, "K_fullimg", None), (n, 3, 3))
            K = at_size(K, video)
            trans = refocused(trans, focals(K), K[:, :2, 2], video.camera)
        else:
            trans = self.refocused(trans, video)
        poses = np.concatenate(
            [root, numbers_of(body, "body_pose", (n, 63)), np.zeros((n, 6))], -1
        )
        frame = frames_of(data, "frame", n, video.num_frames)
        return Rows(frame, np.zeros(n, np.int64), poses, np.zeros((n, 10)), trans)


class PromptHmr(BodyFormat):
    """PromptHMR: per person, in the camera of `img_focal` and `img_center`."""

    name = "PromptHMR"
    layout = ("people",)

    def read(self, source: Source, video: Video) -> Rows:
        data = source.content
        world = data.get("camera_world", data.get("camera", {}))
        rows = []
        for number, (_, one) in enumerate(
            sorted(data["people"].items(), key=lambda kv: str(kv[0]))
        ):
            body = one["smplx_cam"]
            if "pose" in body:
                pose = numbers_of(body, "pose", None)
            else:
                pose = as_rotvec(numbers_of(body, "rotmat", None), None)
            n = len(pose)
            pose = pose.reshape(n, -1)[:, :66]
            if pose.shape[1] != 66:
                raise InvalidContent(
                    f"`pose` of {pose.shape[1]} numbers, not 66 or more"
                )
            trans = numbers_of(body, "trans", (n, 3)) + PELVIS_SMPLX - PELVIS_SMPL
            if "img_focal" in world:
                focal = np.full(n, float(np.ravel(world["img_focal"])[0]))
                center = np.asarray(
                    world.get("img_center", middle(video.camera)), np.float64
                )
                trans = refocused(trans, focal, center, video.camera)
            rows.append(
                Rows(
                    frames_of(one, "frames", n, video.num_frames),
                    np.full(n, number),
                    np.concatenate([pose, np.zeros((n, 6))], axis=-1),
                    np.zeros((n, 10)),
                    trans,
                )
            )
        return join(rows)
