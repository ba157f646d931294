"""Writes BVH: one person's motion on SMPL's skeleton, with Mixamo's joint names.

Retargeting tools (Rokoko, Auto-Rig Pro, MotionBuilder) recognise these names and the
T-pose: arms along x, legs down, facing z. Lengths are cm, as in Mixamo's own files.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from bodyslam_jax.body import PARENTS, BodyModel
from bodyslam_jax.export.formats.scene import Scene, at_constant_rate, make_scene
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.types import Result

MIXAMO_NAMES: tuple[str, ...] = (
    *("Hips", "LeftUpLeg", "RightUpLeg", "Spine", "LeftLeg", "RightLeg", "Spine1"),
    *("LeftFoot", "RightFoot", "Spine2", "LeftToeBase", "RightToeBase", "Neck"),
    *("LeftShoulder", "RightShoulder", "Head", "LeftArm", "RightArm"),
    *("LeftForeArm", "RightForeArm", "LeftHand", "RightHand"),
    *("LeftHandMiddle1", "RightHandMiddle1"),
)
"""Mixamo's names in the order of SMPL's joints."""


def write_bvh(
    path: Path,
    result: Result,
    body: BodyModel,
    person: int = 0,
    names: Sequence[str] = MIXAMO_NAMES,
) -> None:
    """Writes a person's motion as BVH: cm, degrees, channels Z X Y, 24 joints.

    `names` are the joints', in SMPL's order. Offsets are the rest joints of the
    person's shape; the root is the pelvis joint in the result's world. Frames without
    the person repeat the last pose.
    """
    write(path, make_scene(result, body, person=person), names)


def write(path: Path, scene: Scene, names: Sequence[str] = MIXAMO_NAMES) -> None:
    """Writes the only person of a scene by `write_bvh`."""
    scene = at_constant_rate(scene).with_held_poses()
    result = scene.result
    offsets, rest = 100 * scene.offsets[0], 100 * scene.rest[0]
    order: list[int] = []
    lines = ["HIERARCHY"]

    def joint(k: int, depth: int) -> None:
        order.append(k)
        indent = "  " * depth
        lines.append(f"{indent}{'JOINT' if k else 'ROOT'} {names[k]}")
        lines.append(f"{indent}{{")
        lines.append(f"{indent}  OFFSET {_numbers(offsets[k])}")
        turns = "Zrotation Xrotation Yrotation"
        moves = "" if k else "Xposition Yposition Zposition "
        lines.append(f"{indent}  CHANNELS {3 if k else 6} {moves}{turns}")
        children = [c for c, parent in enumerate(PARENTS) if parent == k and c]
        for child in children:
            joint(child, depth + 1)
        if not children:
            # Length of the drawn end of a chain: nothing is measured there.
            end = 0.3 * (rest[k] - rest[PARENTS[k]])
            lines.append(f"{indent}  End Site\n{indent}  {{")
            lines.append(f"{indent}    OFFSET {_numbers(end)}\n{indent}  }}")
        lines.append(f"{indent}}}")

    joint(0, 0)
    num = len(result.timestamps)
    turns = result.poses[0].reshape(num, 24, 3)
    degrees = np.degrees(so3.euler(turns, "ZXY"))[:, order]
    # Jumps by 360 degrees are removed, because programs would interpolate them.
    degrees = np.unwrap(degrees, axis=0, period=360.0)
    table = np.concatenate([100 * scene.pelvis[0], degrees.reshape(num, 72)], axis=1)
    lines += ["MOTION", f"Frames: {num}", f"Frame Time: {1 / result.fps:.8f}"]
    lines += [_numbers(row) for row in table]
    path.write_text("\n".join(lines) + "\n")


def _numbers(values: Float[np.ndarray, " n"]) -> str:
    return " ".join(f"{value:.6f}" for value in values)
