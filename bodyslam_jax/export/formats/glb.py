"""Writes GLB (glTF 2.0, Khronos, 2021): skinned animated bodies, camera, map and
ground.

The specification prescribes y up, and metres. A body's skin is SMPL's linear blend
skinning of the shaped rest mesh; pose blend shapes, which the default body lacks, are
left out. Each vertex follows its four strongest joints, the number that every viewer
supports.

The container of glTF 2.0 packs arrays into one binary buffer, the `.glb` file.
"""

import json
import logging
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from bodyslam_jax.body import JOINT_NAMES, PARENTS
from bodyslam_jax.export.formats.scene import (
    COLORS,
    GRID_GREY,
    GROUND_GREY,
    GROUND_OPACITY,
    MAP_GREY,
    Scene,
)
from bodyslam_jax.geometry import so3_numpy as so3

log = logging.getLogger(__name__)
OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0])
"""Rotation between OpenCV's camera axes (y down, z forward) and glTF's (y up, z
back)."""
_MAX_INFLUENCES = 4
_POINTS_MODE, _LINES_MODE = 0, 1
"""Primitive modes; triangles are the default."""
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
"""Types of accessors by their number of components."""
_COMPONENTS = {"uint8": 5121, "uint16": 5123, "uint32": 5125, "float32": 5126}
"""Codes of the types of components (glTF 2.0, accessors)."""
VERTICES, INDICES = 34962, 34963
"""Targets of buffer views that hold vertex attributes and indices."""
_MAGIC, _VERSION, _JSON, _BIN = 0x46546C67, 2, 0x4E4F534A, 0x004E4942


def write(path: Path, scene: Scene) -> None:
    """Writes one scene with one animation, whose time is that of the video.

    In frames without a person the body is scaled to a point, the only way of core glTF
    to hide it. The camera moves in the frames in which it is located.
    """
    scene = scene.with_held_poses()
    document = _Document()
    for h in range(len(scene.people)):
        _add_person(document, scene, h)
    _add_camera(document, scene)
    if len(scene.result.landmarks):
        points = {"POSITION": document.positions(scene.result.landmarks)}
        document.add_mesh("map", points, 3 * (MAP_GREY,), mode=_POINTS_MODE)
    _add_ground(document, scene)
    document.write(path, scene.name)


class _Document:
    """Lists of a glTF document, whose entries refer to each other by index."""

    def __init__(self) -> None:
        self.buffer = Buffer()
        self.nodes: list[dict[str, Any]] = []
        self.roots: list[int] = []
        self.meshes: list[dict[str, Any]] = []
        self.skins: list[dict[str, Any]] = []
        self.cameras: list[dict[str, Any]] = []
        self.materials: list[dict[str, Any]] = []
        self.samplers: list[dict[str, Any]] = []
        self.channels: list[dict[str, Any]] = []

    def positions(self, points: Float[np.ndarray, "n 3"]) -> int:
        """Appends points (m) as vertex positions, and returns the index of their
        accessor."""
        return self.buffer.add(points.astype(np.float32), VERTICES, bounds=True)

    def add_node(self, node: dict[str, Any], root: bool = False) -> int:
        """Appends a node, and returns its index."""
        self.nodes.append(node)
        if root:
            self.roots.append(len(self.nodes) - 1)
        return len(self.nodes) - 1

    def add_mesh(
        self,
        name: str,
        attributes: dict[str, int],
        color: tuple[float, ...],
        *,
        mode: int | None = None,
        faces: Int[np.ndarray, "f 3"] | None = None,
        skin: int | None = None,
    ) -> None:
        """Adds a mesh with a node of its own at the origin; `color` is linear RGB, or
        RGBA."""
        material: dict[str, Any] = {
            "name": name,
            "pbrMetallicRoughness": {
                "baseColorFactor": [*color, 1.0][:4],
                "metallicFactor": 0.0,
                "roughnessFactor": 0.9,
            },
            "doubleSided": True,
        }
        if len(color) == 4:
            material["alphaMode"] = "BLEND"
        self.materials.append(material)
        part: dict[str, Any] = {
            "attributes": attributes,
            "material": len(self.materials) - 1,
        }
        if mode is not None:
            part["mode"] = mode
        if faces is not None:
            index = faces.astype(np.uint32).reshape(-1)
            part["indices"] = self.buffer.add(index, INDICES)
        self.meshes.append({"name": name, "primitives": [part]})
        node: dict[str, Any] = {"name": name, "mesh": len(self.meshes) - 1}
        if skin is not None:
            node["skin"] = skin
        self.add_node(node, root=True)

    def animate(
        self, node: int, what: str, times: int, values: np.ndarray, steps: bool = False
    ) -> None:
        """Animates a property of a node: `translation`, `rotation` or `scale`."""
        self.samplers.append(
            {
                "input": times,
                "output": self.buffer.add(values.astype(np.float32)),
                "interpolation": "STEP" if steps else "LINEAR",
            }
        )
        target = {"node": node, "path": what}
        self.channels.append({"sampler": len(self.samplers) - 1, "target": target})

    def write(self, path: Path, name: str) -> None:
        """Writes the document as `.glb`."""
        animation = {
            "name": name,
            "samplers": self.samplers,
            "channels": self.channels,
        }
        lists = {
            "nodes": self.nodes,
            "meshes": self.meshes,
            "skins": self.skins,
            "cameras": self.cameras,
            "materials": self.materials,
            "animations": [animation] if self.channels else [],
        }
        document = {
            "asset": {"version": "2.0", "generator": "bodyslam_jax"},
            "scene": 0,
            "scenes": [{"name": name, "nodes": self.roots}],
            **{key: value for key, value in lists.items() if value},
        }
        self.buffer.write(path, document)


def _add_person(document: _Document, scene: Scene, h: int) -> None:
    result, name = scene.result, f"person_{scene.people[h]}"
    rest = scene.rest[h]
    first = len(document.nodes)
    for k in range(24):
        children = [first + c for c in range(24) if PARENTS[c] == k]
        offset = scene.offsets[h, k] if k else rest[0]
        node: dict[str, Any] = {
            "name": JOINT_NAMES[k],
            "translation": offset.tolist(),
        }
        if children:
            node["children"] = children
        document.add_node(node)
    group = document.add_node({"name": name, "children": [first]}, root=True)
    inverse_bind = np.tile(np.eye(4), (24, 1, 1))
    inverse_bind[:, 3, :3] = -rest  # column-major
    matrices = inverse_bind.reshape(24, 16).astype(np.float32)
    document.skins.append(
        {
            "name": name,
            "joints": list(range(first, first + 24)),
            "inverseBindMatrices": document.buffer.add(matrices),
            "skeleton": group,
        }
    )
    skin = scene.vertices(h)
    faces = np.asarray(scene.body.faces)
    joint, weight = strongest(scene, _MAX_INFLUENCES)
    attributes = {
        "POSITION": document.positions(skin),
        "NORMAL": document.buffer.add(normals(skin, faces), VERTICES),
        "JOINTS_0": document.buffer.add(joint.astype(np.uint8), VERTICES),
        "WEIGHTS_0": document.buffer.add(weight.astype(np.float32), VERTICES),
    }
    document.add_mesh(
        f"{name}_body",
        attributes,
        color_of(scene.people[h]),
        faces=faces,
        skin=len(document.skins) - 1,
    )
    times = document.buffer.add(scene.seconds.astype(np.float32), bounds=True)
    document.animate(first, "translation", times, scene.pelvis[h])
    turns = result.poses[h].reshape(-1, 24, 3)
    for k in range(24):
        document.animate(first + k, "rotation", times, quaternions(turns[:, k]))
    if not result.present[h].all():
        size = np.repeat(result.present[h][:, None], 3, axis=1)
        document.animate(group, "scale", times, size, steps=True)


def _add_camera(document: _Document, scene: Scene) -> None:
    """Adds a camera with the video's field of view and a centred principal point, the
    only one that core glTF supports."""
    result, (width, height) = scene.result, scene.size
    at = np.flatnonzero(result.located)
    if not len(at):
        return
    fx, fy = result.intrinsics[:2].tolist()
    if np.ptp(scene.focal_factor) > 0:
        log.warning("glb: holds no zoom; the camera has its mean field of view.")
    zoom = float(scene.focal_factor[at].mean())
    document.cameras.append(
        {
            "name": "camera",
            "type": "perspective",
            "perspective": {
                "yfov": 2 * math.atan(height / (2 * zoom * fy)),
                "aspectRatio": width * fy / (height * fx),
                "znear": 0.01,
            },
        }
    )
    turns = so3.log(result.T_WC[at, :3, :3] @ OPENGL_FROM_OPENCV)
    places, turns = result.T_WC[at, :3, 3], quaternions(turns)
    node = document.add_node(
        {
            "name": "camera",
            "camera": 0,
            "translation": places[0].tolist(),
            "rotation": turns[0].tolist(),
        },
        root=True,
    )
    times = document.buffer.add(scene.seconds[at].astype(np.float32), bounds=True)
    document.animate(node, "translation", times, places)
    document.animate(node, "rotation", times, turns)


def _add_ground(document: _Document, scene: Scene) -> None:
    corners = scene.ground
    if corners is None:
        return
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    surface = {"POSITION": document.positions(corners)}
    document.add_mesh(
        "ground", surface, (*3 * (GROUND_GREY,), GROUND_OPACITY), faces=faces
    )
    lines = {"POSITION": document.positions(scene.grid.reshape(-1, 3))}
    document.add_mesh("ground_grid", lines, 3 * (GRID_GREY,), mode=_LINES_MODE)


def color_of(person: int) -> tuple[float, ...]:
    """Returns a person's colour in report and overlay, as linear RGB from 0 to 1."""
    color = np.array(COLORS[person % len(COLORS)]) / 255
    return tuple(float(x) for x in color**2.2)


def quaternions(turns: Float[np.ndarray, "t 3"]) -> Float[np.ndarray, "t 4"]:
    """Returns the unit quaternions xyzw of axis-angle vectors (rad), each in the
    hemisphere of the previous one, so that interpolation takes the short way."""
    q = so3.quaternion(turns)
    flips = np.cumprod(np.where((q[1:] * q[:-1]).sum(axis=1) < 0, -1.0, 1.0))
    q[1:] *= flips[:, None]
    return q


def strongest(
    scene: Scene, most: int
) -> tuple[Int[np.ndarray, "v k"], Float[np.ndarray, "v k"]]:
    """Returns the joints that move each vertex most, and their weights, which sum to
    1."""
    joint = np.asarray(scene.body.skin_joint)
    weight = np.asarray(scene.body.skin_weight, np.float64)
    order = np.argsort(-weight, axis=1, kind="stable")[:, :most]
    joint, weight = (np.take_along_axis(x, order, axis=1) for x in (joint, weight))
    weight = np.maximum(weight, 0.0)
    missing = [(0, 0), (0, max(0, most - weight.shape[1]))]
    joint, weight = np.pad(joint, missing), np.pad(weight, missing)
    joint = np.where(weight > 0, joint, 0)  # padding refers to joint 0
    return joint, weight / weight.sum(axis=1, keepdims=True)


def normals(
    points: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> np.ndarray:
    """Returns the unit normals of vertices, (v, 3) float32: area-weighted means of the
    faces'."""
    a, b, c = (points[faces[:, k]] for k in range(3))
    total = np.zeros_like(points)
    for corner in range(3):
        np.add.at(total, faces[:, corner], np.cross(b - a, c - a))
    length = np.linalg.norm(total, axis=1, keepdims=True)
    up = np.array([0.0, 1.0, 0.0])
    return np.where(length > 0, total / np.maximum(length, 1e-30), up).astype("f4")


class Buffer:
    """Arrays that are appended one after another, each with its accessor."""

    def __init__(self) -> None:
        self._data = bytearray()
        self._views: list[dict[str, Any]] = []
        self._accessors: list[dict[str, Any]] = []

    def add(
        self,
        array: np.ndarray,
        target: int | None = None,
        *,
        bounds: bool = False,
        normalized: bool = False,
    ) -> int:
        """Appends an array (n,) or (n, components), and returns its accessor's index.

        Args:
            target: `VERTICES`, `INDICES`, or `None` for other data.
            bounds: writes the smallest and largest values, which the specification
                requires for positions and times.
            normalized: integers represent 0 to 1.
        """
        array = np.ascontiguousarray(array)
        width = 1 if array.ndim == 1 else array.shape[1]
        self._data += b"\0" * (-len(self._data) % 4)
        view: dict[str, Any] = {
            "buffer": 0,
            "byteOffset": len(self._data),
            "byteLength": array.nbytes,
        }
        if target is not None:
            view["target"] = target
        accessor: dict[str, Any] = {
            "bufferView": len(self._views),
            "componentType": _COMPONENTS[str(array.dtype)],
            "count": len(array),
            "type": _TYPES[width],
        }
        if normalized:
            accessor["normalized"] = True
        if bounds:
            rows = array.reshape(len(array), width)
            accessor["min"] = rows.min(axis=0).tolist()
            accessor["max"] = rows.max(axis=0).tolist()
        self._data += array.tobytes()
        self._views.append(view)
        self._accessors.append(accessor)
        return len(self._accessors) - 1

    def write(self, path: Path, document: dict[str, Any]) -> None:
        """Writes the document, completed by this buffer, as `.glb`."""
        data = bytes(self._data) + b"\0" * (-len(self._data) % 4)
        document = {
            **document,
            "accessors": self._accessors,
            "bufferViews": self._views,
            "buffers": [{"byteLength": len(data)}],
        }
        text = json.dumps(document, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        # The file's head has 12 bytes, that of each part 8.
        length = 12 + 8 + len(text) + 8 + len(data)
        with path.open("wb") as file:
            file.write(struct.pack("<III", _MAGIC, _VERSION, length))
            file.write(struct.pack("<II", len(text), _JSON) + text)
            file.write(struct.pack("<II", len(data), _BIN) + data)
