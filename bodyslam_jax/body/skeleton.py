"""SMPL's joints, and the joints or vertices that keypoints of 2D detectors correspond
to.

Joint order and kinematic tree are those of Loper et al., SMPL, 2015. Keypoint orders
are those of OpenPose (BODY_25), COCO (17) and Halpe (26). The correspondence of BODY_25
is that of `constants.JOINT_MAP` of SPIN (Kolotouros et al., 2019).

`pose_joints` is the kinematic chain in NumPy, for work that takes less time than its
compilation. A test compares it with `kinematics`, which has the same equations.
"""

import numpy as np
from jaxtyping import Float

JOINT_NAMES: tuple[str, ...] = (
    "pelvis",
    "left_hip",
    "right_hip",
    "spine1",
    "left_knee",
    "right_knee",
    "spine2",
    "left_ankle",
    "right_ankle",
    "spine3",
    "left_foot",
    "right_foot",
    "neck",
    "left_collar",
    "right_collar",
    "head",
    "left_shoulder",
    "right_shoulder",
    "left_elbow",
    "right_elbow",
    "left_wrist",
    "right_wrist",
    "left_hand",
    "right_hand",
)
"""Names of SMPL's joints, in its order."""
PARENTS: tuple[int, ...] = (
    *(-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8),
    *(9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21),
)
"""Parent of each joint; -1 for the root."""
MIRRORED: tuple[int, ...] = (
    *(0, 2, 1, 3, 5, 4, 6, 8, 7, 9, 11, 10),
    *(12, 14, 13, 15, 17, 16, 19, 18, 21, 20, 23, 22),
)
"""For each joint, the one on the other side of the body."""
PELVIS, NECK, HEAD = (JOINT_NAMES.index(name) for name in ("pelvis", "neck", "head"))
HIPS, KNEES, ANKLES, FEET, SHOULDERS, ELBOWS, WRISTS, HANDS = (
    (JOINT_NAMES.index(f"left_{name}"), JOINT_NAMES.index(f"right_{name}"))
    for name in (
        *("hip", "knee", "ankle", "foot"),
        *("shoulder", "elbow", "wrist", "hand"),
    )
)
"""Joints by name, left and right; SMPL's foot joint is at the base of the toes."""
ANKLES_AND_FEET = (ANKLES[0], FEET[0], ANKLES[1], FEET[1])
"""Joints near the ground: left ankle and foot, right ankle and foot."""
LEVELS: tuple[tuple[int, ...], ...] = (
    (1, 2, 3),
    (4, 5, 6),
    (7, 8, 9),
    (10, 11, 12, 13, 14),
    (15, 16, 17),
    (18, 19),
    (20, 21),
    (22, 23),
)
"""Joints by depth in the kinematic tree."""
_NECK, _HEAD = JOINT_NAMES.index("neck"), JOINT_NAMES.index("head")
_HEAD_ABOVE, _HEAD_RADIUS = 0.35, 1.2
"""Middle of the head above its joint, and half its height, in lengths from the joint of
the neck to that of the head: of the vertices of the default body's head."""


def head_ball(
    joints: Float[np.ndarray, "*b 24 3"],
) -> tuple[Float[np.ndarray, "*b 3"], Float[np.ndarray, "*b"]]:
    """Middle and radius of a ball about the head, in the unit of the joints; SMPL's
    last joint of it is at its lower end."""
    up = joints[..., _HEAD, :] - joints[..., _NECK, :]
    radius = np.asarray(_HEAD_RADIUS * np.linalg.norm(up, axis=-1))
    return joints[..., _HEAD, :] + _HEAD_ABOVE * up, radius


def ancestors() -> Float[np.ndarray, "24 24"]:
    """Returns 1 where the row's joint is the column's joint or one of its ancestors."""
    above = np.eye(24)
    for joint in range(1, 24):
        above[:, joint] += above[:, PARENTS[joint]]
    return above


SURFACE_POINTS: tuple[str, ...] = (
    "nose",
    "right_eye",
    "left_eye",
    "right_ear",
    "left_ear",
    "left_big_toe",
    "left_small_toe",
    "left_heel",
    "right_big_toe",
    "right_small_toe",
    "right_heel",
    "head_top",
)
"""Keypoints that are vertices, in the order of `BodyModel.picks`."""
_SIDED_COCO_PARTS = ("eye", "ear", "shoulder", "elbow", "wrist", "hip", "knee", "ankle")
KEYPOINT_NAMES: dict[str, tuple[str, ...]] = {
    "body25": (
        "nose",
        "neck",
        *(f"right_{x}" for x in ("shoulder", "elbow", "wrist")),
        *(f"left_{x}" for x in ("shoulder", "elbow", "wrist")),
        "mid_hip",
        *(f"right_{x}" for x in ("hip", "knee", "ankle")),
        *(f"left_{x}" for x in ("hip", "knee", "ankle")),
        *("right_eye", "left_eye", "right_ear", "left_ear"),
        *(f"left_{x}" for x in ("big_toe", "small_toe", "heel")),
        *(f"right_{x}" for x in ("big_toe", "small_toe", "heel")),
    ),
    "coco17": (
        "nose",
        *(f"{side}_{x}" for x in _SIDED_COCO_PARTS for side in ("left", "right")),
    ),
    "halpe26": (
        "nose",
        *(f"{side}_{x}" for x in _SIDED_COCO_PARTS for side in ("left", "right")),
        *("head_top", "neck", "mid_hip"),
        *(
            f"{side}_{x}"
            for x in ("big_toe", "small_toe", "heel")
            for side in ("left", "right")
        ),
    ),
}
"""Names of the keypoints of each detector's layout, in the layout's order."""


def _other_side(name: str) -> str:
    """Exchanges left and right in a name."""
    side, _, part = name.partition("_")
    other = {"left": "right", "right": "left"}.get(side)
    return name if other is None else f"{other}_{part}"


BODY25: dict[str, int] = {name: k for k, name in enumerate(KEYPOINT_NAMES["body25"])}
"""Index of each keypoint of BODY_25 by its name."""
BODY25_MIRRORED: tuple[int, ...] = tuple(
    BODY25[_other_side(name)] for name in KEYPOINT_NAMES["body25"]
)
"""For each keypoint of BODY_25, the one on the other side of the body."""
COCO17_MIRRORED: tuple[int, ...] = tuple(
    KEYPOINT_NAMES["coco17"].index(_other_side(name))
    for name in KEYPOINT_NAMES["coco17"]
)
"""For each of COCO's keypoints, the one on the other side of the body."""
BODY25_FACE = (BODY25["nose"], BODY25["right_eye"], BODY25["left_eye"])
BODY25_ANKLES = (BODY25["right_ankle"], BODY25["left_ankle"])
BODY25_TOES_AND_HEELS = (
    *(BODY25["left_big_toe"], BODY25["left_heel"]),
    *(BODY25["right_big_toe"], BODY25["right_heel"]),
)
"""Big toe and heel of either foot."""
BODY25_ANKLES_AND_FEET = (*BODY25_ANKLES, *range(BODY25["left_big_toe"], len(BODY25)))
"""Ankles, toes and heels of BODY_25."""
_SPREAD_BY_PART = {
    "nose": 0.026,
    "eye": 0.025,
    "ear": 0.035,
    "shoulder": 0.079,
    "elbow": 0.072,
    "wrist": 0.062,
    "hip": 0.107,
    "knee": 0.087,
    "ankle": 0.089,
    "toe": 0.068,
    "heel": 0.066,
    "neck": 0.079,
    "top": 0.035,
}
"""σ of COCO's and COCO-WholeBody's OKS; neck and head by analogy."""
KEYPOINT_SPREAD: dict[str, tuple[float, ...]] = {
    layout: tuple(_SPREAD_BY_PART[name.rsplit("_", 1)[-1]] for name in names)
    for layout, names in KEYPOINT_NAMES.items()
}
"""Standard deviation of COCO's annotators, relative to the square root of the person's
area in pixels."""
KEYPOINT_JOINT: dict[str, int] = {
    "mid_hip": 0,
    **{name: j for j, name in enumerate(JOINT_NAMES) if "spine" not in name},
}
"""SMPL joint of each keypoint that corresponds to one."""
DETECTOR_BIAS: dict[str, tuple[float, float, float]] = {
    "left_hip": (-0.012, -0.020, 0.018),
    "right_hip": (0.012, -0.020, 0.018),
    "mid_hip": (0.0, -0.035, 0.010),
    "neck": (0.0, -0.063, 0.007),
    "left_shoulder": (-0.017, 0.021, -0.002),
    "right_shoulder": (0.017, 0.021, -0.002),
}
"""Offset of keypoints by detectors trained on COCO from the default body's joint of
that name, m, in the joint's own frame at rest. Measured with anny's regressors of COCO
keypoints on the mean adult. OpenPose's neck and middle hip are midpoints of its
shoulders and of its hips, and thus not SMPL's neck and pelvis. `local_keypoints` adds
`bias` times this."""


def pose_joints(
    R: Float[np.ndarray, "n j 3 3"],
    rest: Float[np.ndarray, "*#n j 3"],
    pelvis: Float[np.ndarray, "n 3"],
) -> tuple[Float[np.ndarray, "n j 3 3"], Float[np.ndarray, "n j 3"]]:
    """Returns rotations and positions (m) of the first `j` joints, in the frame to
    which the root's rotation maps.

    `G_k = G_parent R_k`, `x_k = x_parent + G_parent (J_k - J_parent)`.

    Args:
        R: rotation of each joint in its parent's frame.
        rest: joints at rest J, m; one set, or one per body.
        pelvis: position of joint 0, m.
    """
    G, x = R.copy(), np.empty(R.shape[:3])
    x[:, 0] = pelvis
    for k in range(1, R.shape[1]):
        parent = PARENTS[k]
        bone = rest[..., k, :] - rest[..., parent, :]
        G[:, k] = G[:, parent] @ R[:, k]
        x[:, k] = x[:, parent] + (G[:, parent] @ bone[..., None])[..., 0]
    return G, x
