"""Results for other programs: meshes, BVH skeletons, TRC markers."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Float, Int

from bodyslam_jax.body import JOINT_NAMES, PARENTS, BodyModel, rest_joints
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.types import Result


def write_mesh(
    path: Path, vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> None:
    """Writes one mesh, m; the suffix is `.glb`, `.obj`, `.ply` or `.stl`."""
    suffixes = (".glb", ".obj", ".ply", ".stl")
    if path.suffix.lower() not in suffixes:
        raise ValueError(f"{path}: suffix {path.suffix!r}, not one of {suffixes}.")
    trimesh.Trimesh(vertices, faces, process=False).export(path)


def write_bvh(path: Path, result: Result, body: BodyModel, person: int = 0) -> None:
    """Writes a person's motion as BVH: cm, degrees, channels Z X Y, SMPL's 24 joints.

    Offsets are the rest joints of the person's shape; the root is the pelvis joint in
    the result's world. Frames in which the person is absent are filled, not estimated.
    """
    rest = np.asarray(rest_joints(body, jnp.asarray(result.betas[person], body.dtype)))
    rest = 100.0 * rest.astype(np.float64)
    order: list[int] = []
    lines = ["HIERARCHY"]

    def joint(k: int, depth: int) -> None:
        order.append(k)
        indent = "  " * depth
        offset = rest[k] - rest[PARENTS[k]] if k else np.zeros(3)
        lines.append(f"{indent}{'JOINT' if k else 'ROOT'} {JOINT_NAMES[k]}")
        lines.append(f"{indent}{{")
        lines.append(f"{indent}  OFFSET {_numbers(offset)}")
        turns = "Zrotation Xrotation Yrotation"
        moves = "" if k else "Xposition Yposition Zposition "
        lines.append(f"{indent}  CHANNELS {3 if k else 6} {moves}{turns}")
        children = [c for c, parent in enumerate(PARENTS) if parent == k and c]
        for child in children:
            joint(child, depth + 1)
        if not children:
            end = 0.3 * offset
            lines.append(f"{indent}  End Site\n{indent}  {{")
            lines.append(f"{indent}    OFFSET {_numbers(end)}\n{indent}  }}")
        lines.append(f"{indent}}}")

    joint(0, 0)
    num = len(result.timestamps)
    turns = result.poses[person].reshape(num, 24, 3)
    degrees = np.degrees(so3.euler(turns, "ZXY"))[:, order]
    pelvis = 100.0 * result.trans[person] + rest[0]
    table = np.concatenate([pelvis, degrees.reshape(num, 72)], axis=1)
    lines += ["MOTION", f"Frames: {num}", f"Frame Time: {1 / result.fps:.8f}"]
    lines += [_numbers(row) for row in table]
    path.write_text("\n".join(lines) + "\n")


def write_trc(path: Path, result: Result, person: int = 0) -> None:
    """Writes a person's joints as TRC markers (OpenSim), mm; absent frames empty."""
    num, rate = len(result.timestamps), result.fps
    head = ["DataRate", "CameraRate", "NumFrames", "NumMarkers", "Units"]
    head += ["OrigDataRate", "OrigDataStartFrame", "OrigNumFrames"]
    facts = [f"{rate:.4f}"] * 2 + [str(num), "24", "mm", f"{rate:.4f}", "1", str(num)]
    axes = [f"{axis}{k + 1}" for k in range(24) for axis in "XYZ"]
    rows = [
        ["PathFileType", "4", "(X/Y/Z)", path.name],
        head,
        facts,
        ["Frame#", "Time"] + [x for name in JOINT_NAMES for x in (name, "", "")],
        ["", "", *axes],
        [],
    ]
    millimetres = 1000.0 * result.joints[person].reshape(num, 72)
    for k in range(num):
        values = [f"{x:.3f}" for x in millimetres[k]]
        if not result.present[person, k]:
            values = [""] * 72
        rows.append([str(k + 1), f"{result.timestamps[k]:.6f}", *values])
    path.write_text("\n".join("\t".join(row) for row in rows) + "\n")


def _numbers(values: np.ndarray) -> str:
    return " ".join(f"{value:.6f}" for value in values)
