"""SLAHMR's results -> rows for the frames of a video.

SLAHMR writes `NAME_ITERATION_world_results.npz` for each phase, and beside it, or one
folder up, `track_info.json`: the part of the video, and when each person is visible.
"""

import dataclasses
from pathlib import Path

import numpy as np

from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.io.bodies.body_format import BodyFormat
from bodyslam_jax.io.bodies.parts import (
    PELVIS_SMPL,
    Rows,
    Video,
    at_size,
    numbers_of,
    refocused,
)
from bodyslam_jax.io.budget import current
from bodyslam_jax.io.declared import Fields
from bodyslam_jax.io.files import read_json_fields
from bodyslam_jax.io.formats import Source
from bodyslam_jax.io.frame_index import InvalidContent

_INFO_FILE = "SLAHMR's track_info.json"


class Slahmr(BodyFormat):
    """SLAHMR: SMPL-H in a world, seen by cameras whose translation lacks the scale."""

    name = "SLAHMR"
    layout = ("trans", "root_orient", "pose_body")

    def recognises(self, source: Source) -> bool:
        """Returns True if the arrays have SLAHMR's names and axes."""
        return super().recognises(source) and np.ndim(source.content["trans"]) == 3

    def read(self, source: Source, video: Video) -> Rows:
        data = source.content
        if "cam_R" not in data or "cam_t" not in data:
            raise InvalidContent(
                "SLAHMR's initialisation, without cameras; give *_world_results.npz"
            )
        trans = numbers_of(data, "trans", (-1, -1, 3))
        p, t = trans.shape[:2]
        info = _info_beside(source.path)
        if info is None and video.num_frames not in (None, t):
            raise InvalidContent(
                f"{t} frames, but the video has {video.num_frames}; SLAHMR's "
                "track_info.json, expected beside the file, tells which"
            )
        scale = float(np.ravel(data.get("world_scale", 1.0))[0])
        R = np.broadcast_to(numbers_of(data, "cam_R", None), (p, t, 3, 3))
        shift = scale * np.broadcast_to(numbers_of(data, "cam_t", None), (p, t, 3))
        root = numbers_of(data, "root_orient", (p, t, 3))
        body = numbers_of(data, "pose_body", None).reshape(p, t, 63)
        betas = np.broadcast_to(
            numbers_of(data, "betas", None)[..., :10].reshape(p, -1, 10), (p, t, 10)
        )
        # A world transform moves the pelvis, not the model's origin.
        pelvis = np.einsum("ptij,ptj->pti", R, trans + PELVIS_SMPL) + shift
        turned = _composed(R.reshape(-1, 3, 3), root.reshape(-1, 3))
        moved = pelvis - PELVIS_SMPL
        if "intrins" in data:
            fx, _, cx, cy = np.ravel(numbers_of(data, "intrins", None))[:4]
            K = at_size(
                np.array([[[fx, 0.0, cx], [0.0, fx, cy], [0.0, 0.0, 1.0]]]), video
            )
            focal = np.full(p * t, K[0, 0, 0])
            moved = refocused(moved.reshape(-1, 3), focal, K[0, :2, 2], video.camera)
        visible = np.ones((p, t), dtype=bool)
        if "track_mask" in data:
            visible = np.broadcast_to(
                np.asarray(data["track_mask"]).astype(bool), (p, t)
            )
        poses = np.concatenate([turned.reshape(p, t, 3), body, np.zeros((p, t, 6))], -1)
        if info is not None:
            visible = visible & info.visible(p, t)
        person, frame = np.nonzero(visible)
        if info is not None:
            frame = frame + info.first
        moved = moved.reshape(p, t, 3)
        parts = (poses[visible], betas[visible], moved[visible])
        return Rows(frame, person, *parts, shapes_regressed=False)


def _info_beside(path: Path) -> "_Info | None":
    """Returns the content of the results' `track_info.json`, if there is one."""
    for folder in (path.parent, path.parent.parent):
        file = folder / "track_info.json"
        if file.is_file():
            return _Info.of(read_json_fields(file, _INFO_FILE))
    return None


@dataclasses.dataclass(frozen=True)
class _Info:
    """The frames of the video that the results are of."""

    first: int
    """Index of the first one."""
    masks: dict[int, np.ndarray]
    """By index of a person: whether they are visible in each frame from `first` on."""

    @classmethod
    def of(cls, data: Fields) -> "_Info":
        meta, frames = data.fields("meta"), current().frames
        interval = {"kind": "whole", "low": 0, "high": frames}
        start, end = meta.array("seq_interval", (2,), **interval)
        before = int(meta.array("data_interval", (2,), **interval)[0])
        tracks, masks = data.fields("tracks"), {}
        for name in tracks.names():
            track = tracks.fields(name)
            visible = track.array("vis_mask", (None,), kind="boolean")
            masks[track.whole("index")] = visible[start:end]
        return cls(before + int(start), masks)

    def visible(self, people: int, frames: int) -> np.ndarray:
        """Returns whether each person is visible in each frame, (people, frames)."""
        found = np.ones((people, frames), dtype=bool)
        for index, mask in self.masks.items():
            if index < people:
                found[index, : len(mask)] = mask[:frames]
        return found


def _composed(R: np.ndarray, rotvec: np.ndarray) -> np.ndarray:
    """Returns the axis-angle of `R exp(rotvec)`; NaN where either is not finite."""
    both = np.hstack([R.reshape(-1, 9), rotvec])
    finite = np.asarray(np.isfinite(both).all(axis=1))[:, None]
    safe = np.where(finite[..., None], R, np.eye(3)), np.where(finite, rotvec, 0.0)
    return np.where(finite, so3.compose(so3.log(safe[0]), safe[1]), np.nan)
