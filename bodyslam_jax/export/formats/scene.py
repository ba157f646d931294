"""The scene that every format is written from: a result in the requested world.

It has the pixel observations of the run's landmarks, read from its cached stages, and
`Views`: cameras, images and points in the conventions of photogrammetry, which the
files of COLMAP and nerfstudio share.
"""

import dataclasses
import functools
from pathlib import Path
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from bodyslam_jax import evaluation
from bodyslam_jax.body import PARENTS, BodyModel, rest_joints
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.geometry.camera import project
from bodyslam_jax.io.archive import read_npz
from bodyslam_jax.io.video import extract_frames, frame_name
from bodyslam_jax.types import Result

Up = Literal["y", "z"]
Y_TO_Z = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Rotation from the run's world (y up) to one whose z axis is up: z becomes -y."""
COLORS = ((232, 110, 36), (40, 170, 115), (150, 90, 200), (200, 160, 20))
"""Colours of people, sRGB, as in report and overlay."""
MAP_GREY, GROUND_GREY, GRID_GREY, GROUND_OPACITY = 0.35, 0.6, 0.3, 0.3
"""Greys of map, ground and its grid, 0 to 1, for programs that show exported scenes."""
_MAX_FINE_GRID_M = 100.0
"""Length of the ground up to which its grid has a line per metre."""
_MAX_TIMING_ERROR_FRAMES = 0.25
"""Deviation of timestamps from a constant rate, in frame intervals, up to which the
rate counts as constant."""
_ZOOM_KEY = ".zoom"
_MAX_LOG_ZOOM = 10.0
"""Logarithm of a factor on the focal length that exceeds any lens."""
PIXEL_CENTRE_OFFSET_PX = 0.5
"""Offset from coordinates with integer pixel centres to those with the origin at the
image's corner."""


@dataclasses.dataclass(frozen=True)
class Observations:
    """Inlier observations of a result's landmarks, `m` in all."""

    frame: Int[np.ndarray, " m"]
    landmark: Int[np.ndarray, " m"]
    """Index into `Result.landmarks`."""
    uv: Float[np.ndarray, "m 2"]
    """Pixels in the video's images, px; pixel centres have integer coordinates."""
    zoom: Float[np.ndarray, " t"] | None = None
    """Focal length of each frame relative to `Result.intrinsics`; `None` if the camera
    does not zoom."""


@dataclasses.dataclass(frozen=True)
class Scene:
    """A result, and the further data that writers need."""

    result: Result
    """Result in the world with the axis `up`; contains only the people to be
    written."""
    body: BodyModel
    people: tuple[int, ...]
    """Numbers of the people in the run, in the order of the arrays of `result`."""
    up: Up
    size: tuple[int, int]
    """Width and height of the images, px."""
    observations: Observations | None = None
    video: Path | None = None
    """Video or folder of images whose frames are written beside the files of COLMAP and
    nerfstudio; with `None` only their names are."""

    @property
    def name(self) -> str:
        """Name of the run's input."""
        return str(_input(self.result).get("name", "bodyslam"))

    @functools.cached_property
    def rest(self) -> Float[np.ndarray, "h 24 3"]:
        """Joints of each person's rest pose, m, pelvis at `J_0(β)`."""
        shapes = jnp.asarray(self.result.betas, self.body.dtype)
        return np.asarray(rest_joints(self.body, shapes), np.float64)

    @functools.cached_property
    def offsets(self) -> Float[np.ndarray, "h 24 3"]:
        """Rest joints relative to their parents', m; 0 for the pelvis."""
        offsets = self.rest - self.rest[:, np.array(PARENTS)]
        offsets[:, 0] = 0.0
        return offsets

    @property
    def pelvis(self) -> Float[np.ndarray, "h t 3"]:
        """Pelvis joints, m."""
        return self.rest[:, None, 0] + self.result.trans

    @property
    def focal_factor(self) -> Float[np.ndarray, " t"]:
        """Focal length of each frame relative to the result's intrinsics."""
        zoom = None if self.observations is None else self.observations.zoom
        return np.ones(len(self.result.timestamps)) if zoom is None else zoom

    @property
    def seconds(self) -> Float[np.ndarray, " t"]:
        """Times from the first frame, s."""
        return self.result.timestamps - self.result.timestamps[0]

    @property
    def ground(self) -> Float[np.ndarray, "4 3"] | None:
        """Corners of the ground below people and cameras, m, counter-clockwise seen
        from above, at whole metres; `None` where nobody stands on it."""
        r = self.result
        if not r.present.any():
            return None
        R = Y_TO_Z if self.up == "z" else np.eye(3)
        points = [r.T_WC[r.located, :3, 3], r.joints[r.present].reshape(-1, 3)]
        level = (np.concatenate(points) @ R)[:, [0, 2]]
        x, z = np.floor(level.min(axis=0)) - 1
        far_x, far_z = np.ceil(level.max(axis=0)) + 1
        corners = [[x, 0, far_z], [far_x, 0, far_z], [far_x, 0, z], [x, 0, z]]
        return np.array(corners) @ R.T

    @property
    def grid(self) -> Float[np.ndarray, "n 2 3"]:
        """Segments of a grid on the ground, m, at intervals of 1 m, or 10 m on a large
        ground; empty without a ground."""
        corners = self.ground
        if corners is None:
            return np.zeros((0, 2, 3))
        a, b, c, d = corners
        lines = []
        for start, along, across in ((a, b - a, d - a), (a, d - a, b - a)):
            length = np.linalg.norm(along)
            step = 1.0 if length <= _MAX_FINE_GRID_M else 10.0
            for s in np.arange(0.0, length + 1e-6, step):
                foot = start + s / length * along
                lines.append([foot, foot + across])
        return np.array(lines)

    def with_held_poses(self) -> "Scene":
        """Returns the scene with frames without the person filled: they repeat the last
        pose before them, or the first one."""
        r = self.result
        at = np.stack([held(there) for there in r.present]) if len(r.present) else None
        if at is None:
            return self
        take = lambda x: np.stack([row[k] for row, k in zip(x, at, strict=True)])
        fields = {n: take(getattr(r, n)) for n in ("poses", "trans", "joints")}
        return dataclasses.replace(self, result=dataclasses.replace(r, **fields))

    def vertices(self, h: int) -> Float[np.ndarray, "v 3"]:
        """Returns the vertices of a person's rest pose, m."""
        template, dirs = (
            np.asarray(x, np.float64)
            for x in (self.body.template, self.body.shape_dirs)
        )
        return template + dirs @ self.result.betas[h]


def make_scene(
    result: Result,
    body: BodyModel,
    up: Up = "y",
    person: int | tuple[int, ...] | None = None,
    observations: Observations | None = None,
    video: Path | None = None,
) -> Scene:
    """Returns a scene of the requested people (by default all who are present in any
    frame), in a world with the axis `up` up.

    **Raises:** `InputError` if there is no such person, or if `body` is not the body
    model of the result.
    """
    seen = np.flatnonzero(result.present.any(axis=1))
    chosen = np.atleast_1d(seen if person is None else np.array(person, int))
    if missing := [str(h) for h in chosen if h not in seen]:
        known = ", ".join(map(str, seen)) or "nobody"
        raise InputError(
            f"--person {' '.join(missing)}: not in this run, expected {known}."
        )
    few = of_people(result, chosen)
    evaluation.check_body(few, body)
    if up == "z":
        few = turned(few, body, Y_TO_Z)
    source = _input(result)
    # The centre of an image lies half a pixel before half its size.
    guess = np.round(2 * result.intrinsics[2:4] + 1)
    width, height = source.get("width", guess[0]), source.get("height", guess[1])
    return Scene(
        few,
        body,
        tuple(int(h) for h in chosen),
        up,
        (int(width), int(height)),
        observations,
        video,
    )


def of_people(result: Result, people: Any) -> Result:
    """Returns the result with these people only; `people` is an index of arrays."""
    fields = ["poses", "trans", "betas", "joints", "present"]
    fields += [
        name
        for name in ("joint_sigma", "root_sigma")
        if getattr(result, name) is not None
    ]
    return dataclasses.replace(
        result, **{n: getattr(result, n)[people] for n in fields}
    )


def turned(result: Result, body: BodyModel, R: Float[np.ndarray, "3 3"]) -> Result:
    """Returns the result in a world whose points are `R x`."""
    T_WC = result.T_WC.copy()
    T_WC[:, :3] = R @ T_WC[:, :3]
    pelvis = np.asarray(rest_joints(body, jnp.asarray(result.betas, body.dtype)))
    pelvis = pelvis.astype(np.float64)[:, None, 0]
    poses = result.poses.copy()
    poses[..., :3] = so3.log(R @ so3.exp(poses[..., :3]))
    sigma = result.root_sigma
    # Exact where R exchanges axes; else coordinates are taken to be uncorrelated.
    sigma = None if sigma is None else np.sqrt(sigma**2 @ (R**2).T)
    return dataclasses.replace(
        result,
        root_sigma=sigma,
        T_WC=T_WC,
        landmarks=result.landmarks @ R.T,
        poses=poses,
        trans=(pelvis + result.trans) @ R.T - pelvis,
        joints=result.joints @ R.T,
    )


def at_constant_rate(scene: Scene) -> Scene:
    """Returns the scene resampled to a constant frame rate, for formats without
    timestamps.

    Timestamps that deviate from a constant rate, such as those of a video with gaps,
    are resampled at their median interval: rotations along the shortest path, positions
    linearly. A person is present between two frames if present in both.
    """
    r = scene.result
    t = r.timestamps
    even = t[0] + np.arange(len(t)) / r.fps
    if len(t) < 2 or np.abs(t - even).max() < _MAX_TIMING_ERROR_FRAMES / r.fps:
        return scene
    step = float(np.median(np.diff(t)))
    times = t[0] + step * np.arange(int((t[-1] - t[0]) / step + 1e-6) + 1)
    times = np.minimum(times, t[-1])  # rounding
    after = np.clip(np.searchsorted(t, times), 1, len(t) - 1)
    weight = (times - t[after - 1]) / (t[after] - t[after - 1])

    def linear(x: np.ndarray) -> np.ndarray:
        w = weight.reshape(-1, *[1] * (x.ndim - 1))
        return (1 - w) * x[after - 1] + w * x[after]

    slerp = lambda turns: so3.interpolate_path(t, turns, times)
    T_WC = linear(r.T_WC)
    T_WC[:, :3, :3] = slerp(r.T_WC[:, :3, :3])
    num, h = len(times), len(r.poses)
    poses = np.zeros((h, num, 24, 3))
    for k, j in np.ndindex(h, 24):
        turns = so3.exp(r.poses[k].reshape(-1, 24, 3)[:, j])
        poses[k, :, j] = so3.log(slerp(turns))
    each = lambda x: np.stack([linear(row) for row in x]) if h else x[:, :1]
    there = (r.present[:, after - 1] | (weight == 1)) & (
        r.present[:, after] | (weight == 0)
    )
    found = dataclasses.replace(
        r,
        timestamps=times,
        T_WC=T_WC,
        poses=poses.reshape(h, num, 72),
        trans=each(r.trans).reshape(h, num, 3),
        joints=each(r.joints).reshape(h, num, 24, 3),
        present=there,
        joint_sigma=None,
        root_sigma=None,
    )
    return dataclasses.replace(scene, result=found)


def held(present: Bool[np.ndarray, " t"]) -> Int[np.ndarray, " t"]:
    """Returns, for each frame, the last frame with the person, or the first one if
    there is none before."""
    frames = np.where(present, np.arange(len(present)), -1)
    return np.maximum(np.maximum.accumulate(frames), int(present.argmax()))


def _input(result: Result) -> dict[str, Any]:
    """Returns the summary's entry on the video; empty without a summary."""
    found = result.summary.get("input")
    return found if isinstance(found, dict) else {}


def read_observations(run: Path, result: Result) -> Observations | None:
    """Reads the observations from the stage results in the `.cache` of a run folder.

    Returns `None` if the folder has none that belong to `result`: the result can then
    still be exported, with landmarks that no image refers to.
    """
    found = sorted((run / ".cache").glob("cameras-*.npz"))
    if len(found) != 1 or not len(result.landmarks):
        return None
    t, l = len(result.timestamps), len(result.landmarks)
    try:
        archive = read_npz(found[0])
        if archive.header(".landmarks")[0] != (l, 3):
            return None
        index = {"kind": "whole", "low": 0}
        frame = archive.array(".tracks.frame", ("m",), high=t - 1, **index)
        landmark = archive.array(".tracks.landmark", ("m",), high=l - 1, **index)
        uv = archive.array(".tracks.uv", ("m", 2))
        keep = archive.array(".keep", ("m",), kind="boolean")
        zoom = None
        if _ZOOM_KEY in archive:
            zoom = archive.array(
                _ZOOM_KEY, (t,), low=-_MAX_LOG_ZOOM, high=_MAX_LOG_ZOOM
            )
    except InputError:
        return None
    frame, landmark, uv = frame[keep], landmark[keep], uv[keep]
    if zoom is None:
        return Observations(frame, landmark, uv)
    # The stages work on images whose zoom is undone about the principal point.
    factor, centre = np.exp(zoom), result.intrinsics[2:4]
    uv = centre + (uv - centre) * factor[frame][:, None]
    return Observations(frame, landmark, uv, factor)


@dataclasses.dataclass(frozen=True)
class Views:
    """Located frames, `n` in all, with the intrinsics of each."""

    frames: Int[np.ndarray, " n"]
    """Indices of the result's frames, increasing."""
    names: list[str]
    """Names of their images."""
    T_WC: Float[np.ndarray, "n 4 4"]
    model: str
    """COLMAP's name of the camera model: `PINHOLE` or `OPENCV`."""
    intrinsics: Float[np.ndarray, "c i"]
    """`fx fy cx cy`, with `k1 k2 p1 p2` for `OPENCV`; px from the image's corner. One
    row, or one for each view of a camera that zooms."""

    @property
    def zooms(self) -> bool:
        """Whether each view has intrinsics of its own."""
        return len(self.intrinsics) > 1


def views_of(scene: Scene, images: Path) -> Views:
    """Returns the located frames; their images are written into a folder if there is a
    video.

    **Raises:** `ValueError` if the video is not the one of the result.
    """
    result = scene.result
    frames = np.flatnonzero(result.located)
    if scene.video is None:
        names = [frame_name(int(k)) for k in frames]
    else:
        names = extract_frames(scene.video, result.timestamps, frames, images)
    factor = scene.focal_factor[frames]
    factor = factor if len(factor) and np.ptp(factor) > 0 else factor[:1]
    intrinsics = np.tile(result.intrinsics, (len(factor), 1)).astype(np.float64)
    intrinsics[:, :2] *= factor[:, None]
    intrinsics[:, 2:4] += PIXEL_CENTRE_OFFSET_PX
    model = "PINHOLE" if intrinsics.shape[1] == 4 else "OPENCV"
    return Views(frames, names, result.T_WC[frames], model, intrinsics)


def reprojection_errors(scene: Scene, seen: Observations) -> Float[np.ndarray, " m"]:
    """Returns the distance between each observation and its landmark's projection,
    px."""
    result = scene.result
    T = result.T_WC[seen.frame]
    offset = result.landmarks[seen.landmark] - T[:, :3, 3]
    p_C = np.einsum("mji,mj->mi", T[:, :3, :3], offset)
    intrinsics = np.tile(result.intrinsics, (len(T), 1)).astype(np.float64)
    intrinsics[:, :2] *= scene.focal_factor[seen.frame][:, None]
    uv = np.asarray(project(jnp.asarray(intrinsics), jnp.asarray(p_C)))
    return np.linalg.norm(uv - seen.uv, axis=1)
