"""Writes an OpenSim model of one person, markers, and the set-up of inverse kinematics.

    opensim-cmd run-tool inverse_kinematics.xml

in the folder writes `angles.mot`. The model has this person's segment lengths: joint
centres of the body model at rest. Its axes and angles are OpenSim's, which follow the
International Society of Biomechanics (Wu et al., J. Biomech. 35, 2002, and 38, 2005): x
forward, y up, z to the right; coordinates have the names and signs of Rajagopal et al.
(IEEE Trans. Biomed. Eng. 63, 2016) where that model has them. The first rotation of the
pelvis is about the vertical, so that tilt and list are about the person's own axes
(Baker, Human Movement Science 20, 2001). Knees are hinges, the trunk is one segment.

A segment has two markers beside its joint centres, 0.1 m in front of its joint and to
its right. They determine the orientation about the segment's axis, which joint centres
do not. Masses are not measured: each segment has 1 kg, which does not affect inverse
kinematics, but would affect inverse dynamics.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float

from bodyslam_jax.body import JOINT_NAMES, PARENTS
from bodyslam_jax.body.skeleton import HEAD, NECK
from bodyslam_jax.export.formats.csv import SMPL_TO_ISB
from bodyslam_jax.export.formats.scene import Scene, at_constant_rate
from bodyslam_jax.export.formats.trc import trc_text
from bodyslam_jax.geometry import so3_numpy as so3

_CLUSTER_DISTANCE_M = 0.1
"""Distance of a segment's two additional markers from its joint."""
_CENTRE_WEIGHT, _CLUSTER_WEIGHT, _TRUNK_WEIGHT = 10.0, 1.0, 1.0
"""Weights of markers in inverse kinematics. Limbs follow their joint centres; those of
the trunk have less weight, because it bends and a single segment cannot."""
_X, _Y, _Z = (1, 0, 0), (0, 1, 0), (0, 0, 1)
_MINUS_X, _MINUS_Y, _MINUS_Z = (-1, 0, 0), (0, -1, 0), (0, 0, -1)
_ARM_ROTATIONS = {
    "r": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    "l": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
}
"""Rotations from a segment of the arm, whose zero position hangs down, to SMPL's, whose
arms point to the sides at rest."""

Axis = tuple[int, int, int]
Rotation = Float[np.ndarray, "3 3"]


@dataclasses.dataclass(frozen=True)
class Segment:
    """A rigid body of the model, with the joint that connects it to its parent."""

    name: str
    parent: str
    joint: int
    """SMPL's joint at the segment's origin."""
    turns_with: int
    """SMPL's joint that has the segment's orientation."""
    coordinates: tuple[tuple[str, Axis], ...]
    """Coordinates of its joint: names, and axes in the parent's frame, in the order of
    rotations."""
    centres: tuple[int, ...]
    """SMPL's joints that are markers on the segment."""
    to_smpl: Rotation = dataclasses.field(default_factory=lambda: np.eye(3))
    """Rotation from the segment's axes to those of SMPL's joint (x forward, y up, z
    right)."""


def _of_side(side: str, *axes: tuple[str, Axis]) -> tuple[tuple[str, Axis], ...]:
    """Returns coordinates with the suffix of their side, `r` or `l`."""
    return tuple((f"{name}_{side}", axis) for name, axis in axes)


def _leg(side: str, hip: int, outward: bool) -> list[Segment]:
    x, y = (_MINUS_X, _MINUS_Y) if outward else (_X, _Y)
    knee, ankle, foot = hip + 3, hip + 6, hip + 9
    hips = _of_side(
        side, ("hip_flexion", _Z), ("hip_adduction", x), ("hip_rotation", y)
    )
    ankles = _of_side(side, ("ankle_angle", _Z), ("subtalar_angle", x))
    bend = _of_side(side, ("knee_angle", _MINUS_Z))
    femur, tibia = f"femur_{side}", f"tibia_{side}"
    return [
        Segment(femur, "pelvis", hip, hip, hips, (knee,)),
        Segment(tibia, femur, knee, knee, bend, (ankle,)),
        Segment(f"foot_{side}", tibia, ankle, ankle, ankles, (foot,)),
    ]


def _arm(side: str, shoulder: int, outward: bool) -> list[Segment]:
    x, y = (_MINUS_X, _MINUS_Y) if outward else (_X, _Y)
    elbow, wrist, hand = shoulder + 2, shoulder + 4, shoulder + 6
    shoulders = _of_side(side, ("arm_flex", _Z), ("arm_add", x), ("arm_rot", y))
    elbows = _of_side(side, ("elbow_flex", _Z), ("pro_sup", y))
    wrists = _of_side(side, ("wrist_flex", _Z), ("wrist_dev", x))
    humerus, forearm, down = f"humerus_{side}", f"forearm_{side}", _ARM_ROTATIONS[side]
    return [
        Segment(humerus, "torso", shoulder, shoulder, shoulders, (elbow,), down),
        Segment(forearm, humerus, elbow, elbow, elbows, (wrist,), down),
        Segment(f"hand_{side}", forearm, wrist, wrist, wrists, (hand,), down),
    ]


_PELVIS = (("pelvis_rotation", _Y), ("pelvis_list", _X), ("pelvis_tilt", _Z))
_LUMBAR = (("lumbar_extension", _Z), ("lumbar_bending", _X), ("lumbar_rotation", _Y))
_NECK = (("neck_extension", _Z), ("neck_bending", _X), ("neck_rotation", _Y))
SEGMENTS: tuple[Segment, ...] = (
    Segment("pelvis", "ground", 0, 0, _PELVIS, (0, 1, 2, 3)),
    *_leg("r", 2, outward=False),
    *_leg("l", 1, outward=True),
    Segment("torso", "pelvis", 3, 9, _LUMBAR, (9, 12, 16, 17)),
    Segment("head", "torso", NECK, HEAD, _NECK, (HEAD,)),
    *_arm("r", JOINT_NAMES.index("right_shoulder"), outward=False),
    *_arm("l", JOINT_NAMES.index("left_shoulder"), outward=True),
)
TRANSLATIONS = ("pelvis_tx", "pelvis_ty", "pelvis_tz")
"""Coordinates of the pelvis joint's centre in the run's world, m."""


@dataclasses.dataclass(frozen=True)
class Marker:
    """A point on a segment that inverse kinematics follows."""

    name: str
    segment: Segment
    joint: int
    """SMPL's joint that is the origin of `offset`."""
    offset: Float[np.ndarray, " 3"]
    """Offset from that joint, m, along the axes of SMPL's joint `turns_with` (x
    forward)."""
    weight: float


def markers() -> list[Marker]:
    """Returns the markers of all segments: joint centres, and two additional ones per
    segment."""
    found = []
    for segment in SEGMENTS:
        trunk = segment.name == "torso"
        for joint in segment.centres:
            weight = _TRUNK_WEIGHT if trunk else _CENTRE_WEIGHT
            name = JOINT_NAMES[joint]
            found.append(Marker(name, segment, joint, np.zeros(3), weight))
        anchor = segment.turns_with if trunk else segment.joint
        for name, axis in (("front", _X), ("right", _Z)):
            offset = segment.to_smpl @ (_CLUSTER_DISTANCE_M * np.array(axis, float))
            label = f"{segment.name}_{name}"
            found.append(Marker(label, segment, anchor, offset, _CLUSTER_WEIGHT))
    return found


def write(path: Path, scene: Scene) -> None:
    """Writes the folder of the only person of a scene: `model.osim`, `markers.trc` and
    `inverse_kinematics.xml`."""
    scene = at_constant_rate(scene)
    result, present = scene.result, scene.result.present[0]
    turns = world_orientations(result.poses[0].reshape(-1, 24, 3))
    path.mkdir(parents=True, exist_ok=True)
    points = np.stack(
        [
            result.joints[0][:, m.joint] + turns[:, m.segment.turns_with] @ m.offset
            for m in markers()
        ],
        axis=1,
    )
    names = [marker.name for marker in markers()]
    when = (result.timestamps, result.fps)
    text = trc_text("markers.trc", names, points, present, *when)
    (path / "markers.trc").write_text(text)
    first = int(np.argmax(present))
    start = (turns[first, 0], result.joints[0][first, 0])
    _save(path / "model.osim", model(scene.rest[0], *start))
    frames = np.flatnonzero(present)
    times = result.timestamps[frames[[0, -1]]]
    _save(path / "inverse_kinematics.xml", _set_up(*map(float, times)))


def world_orientations(
    poses: Float[np.ndarray, "t 24 3"],
) -> Float[np.ndarray, "t 24 3 3"]:
    """Returns the orientations of SMPL's joints in the world, with x forward, y up and
    z right as the axes (columns) at rest."""
    local = so3.exp(poses)
    world = np.array(local)
    for joint in range(1, 24):
        world[:, joint] = world[:, PARENTS[joint]] @ local[:, joint]
    return world @ SMPL_TO_ISB.T


def model(
    rest: Float[np.ndarray, "24 3"], turn: Rotation, place: Float[np.ndarray, " 3"]
) -> ElementTree.Element:
    """Returns the model of a person with joints `rest` (m, SMPL's axes) at rest.

    Inverse kinematics starts from the pelvis' orientation `turn` and joint centre
    `place` (m) in the world.
    """
    at_rest = rest @ SMPL_TO_ISB.T
    root = ElementTree.Element("OpenSimDocument", Version="40000")
    top = _add(root, "Model", name="bodyslam")
    _add(top, "gravity", "0 -9.80665 0")
    _add(top, "credits", "bodyslam: segment lengths of one person, masses not measured")
    _add(top, "length_units", "meters")
    _add(top, "force_units", "N")
    _add(top, "Ground", name="ground")
    bodies, joints, points = (
        _add(_add(top, kind, name=kind.lower()), "objects")
        for kind in ("BodySet", "JointSet", "MarkerSet")
    )
    by_name = {segment.name: segment for segment in SEGMENTS}
    start = _start(turn, place)
    for segment in SEGMENTS:
        body = _add(bodies, "Body", name=segment.name)
        _add(body, "mass", "1")
        _add(body, "mass_center", "0 0 0")
        _add(body, "inertia", "0.01 0.01 0.01 0 0 0")
        above = by_name.get(segment.parent)
        offset = np.zeros(3)
        if above is not None:
            between = at_rest[segment.joint] - at_rest[above.joint]
            offset = above.to_smpl.T @ between
        _add_joint(joints, segment, offset, start)
    for marker in markers():
        point = _add(points, "Marker", name=marker.name)
        segment = marker.segment
        _add(point, "socket_parent_frame", f"/bodyset/{segment.name}")
        away = at_rest[marker.joint] - at_rest[segment.joint] + marker.offset
        _add(point, "location", _numbers(segment.to_smpl.T @ away))
        _add(point, "fixed", "true")
    return root


def _start(turn: Rotation, place: Float[np.ndarray, " 3"]) -> dict[str, float]:
    """Returns the values of the pelvis' coordinates:
    `turn = Ry(rotation) Rx(list) Rz(tilt)`."""
    values = {
        "pelvis_rotation": np.arctan2(turn[0, 2], turn[2, 2]),
        "pelvis_list": np.arcsin(np.clip(-turn[1, 2], -1.0, 1.0)),
        "pelvis_tilt": np.arctan2(turn[1, 0], turn[1, 1]),
    }
    values |= dict(zip(TRANSLATIONS, place, strict=True))
    return {name: float(value) for name, value in values.items()}


def _add_joint(
    joints: ElementTree.Element,
    segment: Segment,
    offset: Float[np.ndarray, " 3"],
    start: dict[str, float],
) -> None:
    """Adds the joint of a segment at `offset` (m) in its parent's frame."""
    joint = _add(joints, "CustomJoint", name=f"{segment.name}_joint")
    frame = f"{segment.parent}_to_{segment.name}"
    _add(joint, "socket_parent_frame", frame)
    _add(joint, "socket_child_frame", f"/bodyset/{segment.name}")
    moves = TRANSLATIONS if segment.parent == "ground" else ()
    turns = [name for name, _ in segment.coordinates]
    coordinates = _add(joint, "coordinates")
    for name in (*turns, *moves):
        coordinate = _add(coordinates, "Coordinate", name=name)
        _add(coordinate, "default_value", f"{start.get(name, 0.0):.9g}")
        limit = 1000.0 if name in moves else 2 * np.pi
        _add(coordinate, "range", f"{-limit:.9g} {limit:.9g}")
        _add(coordinate, "clamped", "false")
    place = _add(_add(joint, "frames"), "PhysicalOffsetFrame", name=frame)
    parent = "/ground" if segment.parent == "ground" else f"/bodyset/{segment.parent}"
    _add(place, "socket_parent", parent)
    _add(place, "translation", _numbers(offset))
    _add(place, "orientation", "0 0 0")
    transform = _add(joint, "SpatialTransform")
    axes = [axis for _, axis in segment.coordinates]
    # Rotations that the joint does not have need axes that are not parallel to these.
    unused = [a for a in (_X, _Y, _Z) if not any(np.dot(a, axis) for axis in axes)]
    for k, axis in enumerate([*axes, *unused]):
        name = turns[k] if k < len(turns) else None
        _add_axis(transform, f"rotation{k + 1}", axis, name)
    for k, axis in enumerate((_X, _Y, _Z)):
        name = moves[k] if moves else None
        _add_axis(transform, f"translation{k + 1}", axis, name)


def _add_axis(
    transform: ElementTree.Element, kind: str, axis: Axis, coordinate: str | None
) -> None:
    """Adds an axis that follows a coordinate, or stays at zero."""
    entry = _add(transform, "TransformAxis", name=kind)
    _add(entry, "coordinates", coordinate or "")
    _add(entry, "axis", " ".join(map(str, axis)))
    if coordinate is None:
        _add(_add(entry, "Constant", name="function"), "value", "0")
    else:
        function = _add(entry, "LinearFunction", name="function")
        _add(function, "coefficients", "1 0")


def _set_up(first: float, last: float) -> ElementTree.Element:
    """Returns the set-up of inverse kinematics between two times, s."""
    root = ElementTree.Element("OpenSimDocument", Version="40000")
    tool = _add(root, "InverseKinematicsTool", name="bodyslam")
    _add(tool, "results_directory", ".")
    _add(tool, "model_file", "model.osim")
    _add(tool, "constraint_weight", "Inf")
    _add(tool, "accuracy", "1e-05")
    _add(tool, "time_range", f"{first:.6f} {last:.6f}")
    _add(tool, "output_motion_file", "angles.mot")
    _add(tool, "report_errors", "true")
    _add(tool, "marker_file", "markers.trc")
    tasks = _add(_add(tool, "IKTaskSet"), "objects")
    for marker in markers():
        task = _add(tasks, "IKMarkerTask", name=marker.name)
        _add(task, "apply", "true")
        _add(task, "weight", f"{marker.weight:g}")
    return root


def _add(
    parent: ElementTree.Element, tag: str, text: str | None = None, **attributes: str
) -> ElementTree.Element:
    element = ElementTree.SubElement(parent, tag, attributes)
    element.text = text
    return element


def _numbers(values: Float[np.ndarray, " n"] | Sequence[float]) -> str:
    return " ".join(f"{value:.9g}" for value in values)


def _save(path: Path, root: ElementTree.Element) -> None:
    ElementTree.indent(root)
    ElementTree.ElementTree(root).write(path, encoding="UTF-8", xml_declaration=True)
