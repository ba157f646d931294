"""TRAM: a file of a person's track, or its folder `hps` of all tracks."""

import re
from pathlib import Path

import numpy as np

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io.bodies.body_format import BodyFormat, diagonal
from bodyslam_jax.io.bodies.parts import (
    Rows,
    Video,
    as_rotvec,
    betas_of,
    frames_of,
    join,
    middle,
    numbers_of,
    refocused,
)
from bodyslam_jax.io.formats import Source, attributed
from bodyslam_jax.io.safe_pickle import restricted_load
from bodyslam_jax.types import Intrinsics


class Tram(BodyFormat):
    """TRAM: one `hps_track_k.npy` is one person, with full-image translation."""

    name = "TRAM"
    layout = ("pred_rotmat", "pred_trans", "pred_shape")
    folder = "hps_track_*.npy"

    def recognises(self, source: Source) -> bool:
        if source.path.is_dir():
            return any(source.path.glob(f"**/{self.folder}"))
        return super().recognises(source)

    def focal(self, camera: Intrinsics) -> float:
        """Returns the diagonal (`est_focal` of its datasets), where `camera.npy` has no
        `img_focal`."""
        return diagonal(camera)

    def read(self, source: Source, video: Video) -> Rows:
        if source.content is None:
            return self._read_folder(source.path, video)
        data = source.content
        poses = as_rotvec(numbers_of(data, "pred_rotmat", (-1, 24, 3, 3)), 24)
        n = len(poses)
        trans = numbers_of(data, "pred_trans", None).reshape(n, 3)
        if "img_focal" in data:
            focal = np.full(n, float(np.ravel(data["img_focal"])[0]))
            center = np.asarray(
                data.get("img_center", middle(video.camera)), dtype=np.float64
            )
            trans = refocused(trans, focal, center, video.camera)
        else:
            trans = self.refocused(trans, video)
        return Rows(
            frames_of(data, "frame", n, video.num_frames),
            np.zeros(n, dtype=np.int64),
            poses.reshape(n, 72),
            betas_of(data, "pred_shape", n),
            trans,
        )

    def _read_folder(self, folder: Path, video: Video) -> Rows:
        """Reads `hps/` (one file per person), with `camera.npy` beside or above it."""
        tracks = sorted(folder.glob(f"**/{self.folder}"))
        cameras = [p / "camera.npy" for p in (folder, tracks[0].parent, folder.parent)]
        camera_file = next((p for p in cameras if p.is_file()), None)
        camera = restricted_load(camera_file) if camera_file else {}
        if not isinstance(camera, dict):
            raise InputError(
                f"{camera_file}: not a dictionary, expected TRAM's camera."
            )
        shared = {k: camera[k] for k in ("img_focal", "img_center") if k in camera}
        rows = []
        for track in tracks:
            data = restricted_load(track)
            if not isinstance(data, dict):
                raise InputError(f"{track}: not a dictionary of arrays.")
            with attributed(track, "bodies"):
                one = self.read(Source(track, {**data, **shared}), video)
            digits = re.findall(r"\d{1,9}", track.stem)
            if not digits:
                raise InputError(f"{track}: no number of a person in its name.")
            person = np.full(len(one.frame), int(digits[-1]))
            rows.append(Rows(one.frame, person, one.poses, one.betas, one.trans))
        return join(rows)
