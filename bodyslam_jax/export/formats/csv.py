"""Writes CSV for biomechanics: joints, angles, speeds and the joints' uncertainties.

Angles are those recommended by the International Society of Biomechanics, where the
body model has the joint (Wu et al., J. Biomech. 35, 2002, and 38, 2005). A segment's
axes are x forward, y up, z to the right at rest, where legs are straight and parallel,
so that zero is SMPL's rest pose, not an anatomical calibration. Hip, knee and ankle are
the Cardan angles of the distal segment in the proximal one about z, then x, then y
(flexion, adduction, internal rotation), with the signs of a right limb on both sides.
The shoulder angle is the elevation of the upper arm from the trunk's axis alone, the
elbow angle that between upper arm and forearm; angles of trunk and pelvis are those of
their segments in the world.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from bodyslam_jax.body.skeleton import JOINT_NAMES, NECK, PELVIS
from bodyslam_jax.export.formats.scene import Scene
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.io.markup import csv_table

SMPL_TO_ISB = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
"""Rotation from SMPL's axes (x left, y up, z forward) to x forward, y up, z right."""
_LEG_JOINTS, _ARM_JOINTS = (
    {name: JOINT_NAMES.index(f"left_{name}") for name in names}
    for names in (("hip", "knee", "ankle"), ("shoulder", "elbow", "wrist"))
)
"""Index of the left joint by name; that of the right one is the next."""


def write(path: Path, scene: Scene) -> None:
    """Writes one row per frame for the only person of a scene; absent frames are
    empty."""
    result = scene.result
    joints, present = result.joints[0], result.present[0]
    columns = {}
    for k, name in enumerate(JOINT_NAMES):
        for axis in range(3):
            columns[f"{name}_{'xyz'[axis]}_m"] = joints[:, k, axis]
        if result.joint_sigma is not None:
            columns[f"{name}_sigma_m"] = result.joint_sigma[0, :, k]
    if result.root_sigma is not None:
        for axis in range(3):
            name = f"{JOINT_NAMES[PELVIS]}_place_{'xyz'[axis]}_sigma_m"
            columns[name] = result.root_sigma[0, :, axis]
    turns = so3.exp(result.poses[0].reshape(len(joints), 24, 3))
    vertical = np.eye(3)[1 if scene.up == "y" else 2]
    columns |= angles(turns, joints, vertical)
    columns |= speeds(joints, present, result.timestamps, vertical)
    rows = [["frame", "time_s", *columns]]
    for k, time in enumerate(result.timestamps):
        values = [x[k] for x in columns.values()]
        shown = [f"{x:.5g}" if present[k] and np.isfinite(x) else "" for x in values]
        rows.append([str(k), f"{time:.6f}", *shown])
    path.write_text(csv_table(rows))


def angles(
    turns: Float[np.ndarray, "t 24 3 3"],
    joints: Float[np.ndarray, "t 24 3"],
    vertical: Float[np.ndarray, " 3"],
) -> dict[str, Float[np.ndarray, " t"]]:
    """Returns joint angles by name, degrees.

    They are computed from SMPL's joint rotations, of which the first is the pelvis' in
    the world, and from joint positions (m) in that world.
    """
    found = {}
    in_isb = SMPL_TO_ISB @ turns @ SMPL_TO_ISB.T
    for name, left in _LEG_JOINTS.items():
        for side, joint, sign in (("left", left, -1.0), ("right", left + 1, 1.0)):
            flexion, adduction, rotation = cardan_zxy(in_isb[:, joint])
            bend = {"knee": "flexion", "ankle": "dorsiflexion"}.get(name, "flexion")
            found[f"{side}_{name}_{bend}_deg"] = -flexion if name == "knee" else flexion
            found[f"{side}_{name}_adduction_deg"] = sign * adduction
            found[f"{side}_{name}_internal_rotation_deg"] = sign * rotation
    trunk = joints[:, NECK] - joints[:, PELVIS]
    for side, shift in (("left", 0), ("right", 1)):
        shoulder, elbow, wrist = (joints[:, k + shift] for k in _ARM_JOINTS.values())
        found[f"{side}_shoulder_elevation_deg"] = between(elbow - shoulder, -trunk)
        found[f"{side}_elbow_flexion_deg"] = between(wrist - elbow, elbow - shoulder)
    along = np.broadcast_to(vertical, trunk.shape)
    found["trunk_lean_deg"] = between(trunk, along)
    found["pelvis_tilt_deg"] = between(turns[:, 0, :, 1], along)
    return found


def cardan_zxy(
    turns: Float[np.ndarray, "t 3 3"],
) -> tuple[Float[np.ndarray, " t"], Float[np.ndarray, " t"], Float[np.ndarray, " t"]]:
    """Returns the angles about z, then x, then y of rotations `Rz Rx Ry`, degrees."""
    about_x = np.arcsin(np.clip(turns[:, 2, 1], -1.0, 1.0))
    about_z = np.arctan2(-turns[:, 0, 1], turns[:, 1, 1])
    about_y = np.arctan2(-turns[:, 2, 0], turns[:, 2, 2])
    return np.degrees(about_z), np.degrees(about_x), np.degrees(about_y)


def between(
    a: Float[np.ndarray, "t 3"], b: Float[np.ndarray, "t 3"]
) -> Float[np.ndarray, " t"]:
    """Returns the angle between vectors, degrees."""
    sine = np.linalg.norm(np.cross(a, b), axis=-1)
    return np.degrees(np.arctan2(sine, (a * b).sum(axis=-1)))


def speeds(
    joints: Float[np.ndarray, "t 24 3"],
    present: np.ndarray,
    times: Float[np.ndarray, " t"],
    vertical: Float[np.ndarray, " 3"],
) -> dict[str, Float[np.ndarray, " t"]]:
    """Returns the horizontal speed of the pelvis, and the speeds of hands and feet in
    the world, m/s.

    They are central differences, NaN where the person is missing in the frame before or
    after.
    """
    sided = ("left_wrist", "right_wrist", "left_foot", "right_foot")
    points = {name: JOINT_NAMES.index(name) for name in ("pelvis", *sided)}
    found = {}
    for name, joint in points.items():
        path = np.where(present[:, None], joints[:, joint], np.nan)
        if name == "pelvis":
            path = path - (path @ vertical)[:, None] * vertical
        speed = np.full(len(path), np.nan)
        if len(path) > 2:
            way = np.linalg.norm(path[2:] - path[:-2], axis=-1)
            speed[1:-1] = way / (times[2:] - times[:-2])
        found[f"{name}_speed_m_s"] = speed
    return found
