"""Writes rerun's recording (`.rrd`): bodies, skeletons, camera and map over time.

It needs the extra `rerun`. Bodies are coarse meshes that are posed in every frame,
because rerun does not support skinning.
"""

import importlib
import importlib.util
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from bodyslam_jax.body import JOINT_NAMES, PARENTS, vertices
from bodyslam_jax.diagnostics.reported_status import reported_status
from bodyslam_jax.export.formats.glb import normals
from bodyslam_jax.export.formats.scene import COLORS, Scene

_TIMELINE = "time"
_CELL_SIZE_M = 0.025
"""Size of the cells in which vertices are merged; a quarter of the vertices remains."""
_CHUNK_FRAMES = 64
"""Number of frames whose vertices are computed together."""


def is_installed() -> bool:
    """Returns whether rerun-sdk is installed."""
    return importlib.util.find_spec("rerun") is not None


def _rerun() -> Any:
    """Returns the package, imported by name: type checkers resolve `import rerun` to
    this module."""
    return importlib.import_module("rerun")


def write(path: Path, scene: Scene) -> None:
    """Writes one recording with the timeline `time`, s from the first frame."""
    rerun = _rerun()
    recording = rerun.RecordingStream("bodyslam_jax", recording_id=scene.name)
    recording.save(path)
    axes = rerun.ViewCoordinates
    up = axes.RIGHT_HAND_Z_UP if scene.up == "z" else axes.RIGHT_HAND_Y_UP
    recording.log("world", up, static=True)
    if len(scene.result.landmarks):
        points = rerun.Points3D(scene.result.landmarks, colors=[150, 150, 150])
        recording.log("world/map", points, static=True)
    if len(scene.grid):
        grid = rerun.LineStrips3D(scene.grid, colors=[90, 90, 90])
        recording.log("world/ground", grid, static=True)
    _log_camera(recording, scene)
    for h in range(len(scene.people)):
        _log_person(recording, scene, h)
    recording.flush()
    recording.disconnect()


def _log_camera(recording: Any, scene: Scene) -> None:
    rerun = _rerun()
    result, (fx, fy, cx, cy) = scene.result, scene.result.intrinsics[:4]
    factor = scene.focal_factor
    zooms = bool(np.ptp(factor) > 0)
    for k in np.flatnonzero(result.located):
        recording.set_time(_TIMELINE, duration=float(scene.seconds[k]))
        T = result.T_WC[k]
        pose = rerun.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3])
        recording.log("world/camera", pose)
        if zooms or k == np.argmax(result.located):
            K = [[fx * factor[k], 0, cx], [0, fy * factor[k], cy], [0, 0, 1]]
            lens = rerun.Pinhole(
                image_from_camera=K,
                resolution=list(scene.size),
                camera_xyz=rerun.ViewCoordinates.RDF,
            )
            recording.log("world/camera/image", lens)
    path = rerun.LineStrips3D([result.T_WC[result.located, :3, 3]])
    recording.log("world/camera_path", path, static=True)


def _log_person(recording: Any, scene: Scene, h: int) -> None:
    rerun = _rerun()
    result = scene.result
    number = scene.people[h]
    status = reported_status(scene.result.summary, number)
    color = COLORS[number % len(COLORS)]
    if status.words:  # the paler, the less is measured
        white = 0.4 if status.measurable else 0.75
        color = tuple(round((1 - white) * c + white * 255) for c in color)
    base = f"world/person_{number}"
    kept, faces = _coarse(scene)
    bones = [(k, PARENTS[k]) for k in range(1, 24)]
    present = result.present[h]
    # Logged once: later frames replace the moving parts only.
    surface = rerun.Mesh3D.from_fields(triangle_indices=faces, albedo_factor=color)
    marks = rerun.Points3D.from_fields(
        colors=color, labels=list(JOINT_NAMES), show_labels=False
    )
    recording.log(f"{base}/body", surface, static=True)
    recording.log(f"{base}/joints", marks, static=True)
    if status.words:
        text = rerun.TextDocument("\n".join([status.words, *status.reasons]))
        recording.log(f"{base}/status", text, static=True)
    for k, skin in enumerate(_skins(scene, kept, h)):
        recording.set_time(_TIMELINE, duration=float(scene.seconds[k]))
        if not present[k]:
            if k and present[k - 1]:
                recording.log(base, rerun.Clear(recursive=True))
            continue
        joints = result.joints[h, k]
        recording.log(f"{base}/joints", rerun.Points3D.from_fields(positions=joints))
        lines = [joints[list(bone)] for bone in bones]
        recording.log(f"{base}/bones", rerun.LineStrips3D(lines, colors=color))
        moved = rerun.Mesh3D.from_fields(
            vertex_positions=skin, vertex_normals=normals(skin, faces)
        )
        recording.log(f"{base}/body", moved)


def _coarse(
    scene: Scene,
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, "f 3"]]:
    """Returns one vertex of those in each cell of a grid over the rest pose, and the
    faces that remain between them."""
    cells = np.floor(np.asarray(scene.body.template) / _CELL_SIZE_M).astype(np.int64)
    _, kept, cluster = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    faces = cluster.reshape(-1)[np.asarray(scene.body.faces)]
    a, b, c = faces.T
    return kept, faces[(a != b) & (b != c) & (c != a)]


def _skins(
    scene: Scene, kept: Int[np.ndarray, " k"], h: int
) -> Iterator[Float[np.ndarray, "k 3"]]:
    """Yields the kept vertices of a person in each frame, m."""
    result, body = scene.result, scene.body
    num = len(result.timestamps)
    cast = lambda x: jnp.asarray(x, body.dtype)
    for start in range(0, num, _CHUNK_FRAMES):
        # The last chunk is padded, so that there is one compilation.
        at = np.minimum(np.arange(start, start + _CHUNK_FRAMES), num - 1)
        found = vertices(
            body,
            cast(result.poses[h, at]),
            cast(result.betas[h]),
            cast(result.trans[h, at]),
        )
        yield from np.asarray(found)[: num - start, kept]
