"""The estimate after a frame in the metric world, and the transform to that world."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from bodyslam_jax.body import BodyModel, local_joints
from bodyslam_jax.body.skeleton import FEET
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.graph import CHUNK
from bodyslam_jax.ground.gravity import upright
from bodyslam_jax.online.window import Solved
from bodyslam_jax.pipeline.to_metric import sole_height

_FLOOR_GAIN = 0.3
"""Weight of a window's floor in the running estimate of the floor."""
_MIN_CONTACT_PROBABILITY = 0.5
"""Least probability of contact of a foot that determines the floor."""


@dataclasses.dataclass(frozen=True)
class PersonEstimate:
    """One person in one frame, in the metric world."""

    person: int
    """Number of the person: the same as long as the person is recognised, and in the
    order of the result."""
    T_WH: Float[np.ndarray, "4 4"]
    """Pose of the root; the translation is the pelvis joint, m."""
    poses: Float[np.ndarray, " 72"]
    """SMPL's joint rotations, axis-angle, rad; the first is the root's in W."""
    betas: Float[np.ndarray, " 10"]
    joints: Float[np.ndarray, "24 3"]
    """m"""
    contacts: Float[np.ndarray, " 4"] | None
    """Probability that left toe, left heel, right toe, right heel are in contact with
    the ground, in the last frame that the window has solved; `None` if none has the
    person."""


@dataclasses.dataclass(frozen=True)
class Estimate:
    """The estimate that is available right after a frame. W has y up, z forward from
    the first camera, and the floor at 0 once feet have been in contact with it."""

    frame: int
    """Number of frames before this one that were used."""
    timestamp: float
    """s"""
    T_WC: Float[np.ndarray, "4 4"]
    """Camera to world; in metres once the scale is known, before in units of the map.
    Where the camera is lost, the last known one."""
    located: bool
    people: tuple[PersonEstimate, ...]
    scale: float
    """m per map unit; NaN as long as it is unknown, 1 where `status` is `fixed`."""
    scale_sigma: float
    """Standard deviation of `scale`, m per map unit; NaN as long as it is unknown.
    Where `status` is `fixed`, the relative one of people's sizes."""
    status: str
    """`starting`: no map yet; `tracking`; `fixed`: the camera stands still or only
    turns, and the scale is determined by people's sizes alone; `lost`: the camera
    cannot be located in the map; `late`: the frame was not used, as its time is not
    after that of the last one."""
    notes: tuple[str, ...]
    """Warnings about the estimate, one line each."""
    latency: float
    """Time from the call of `update` to its end, s."""


@dataclasses.dataclass
class World:
    """The similarity transform from a map's world to the metric one. It changes with
    each solved window, so that estimates may jump."""

    turn: Float[np.ndarray, "3 3"] = dataclasses.field(
        default_factory=lambda: np.diag([-1.0, -1.0, 1.0])
    )
    """Rotation from the map to the world."""
    scale: float = 1.0
    origin: Float[np.ndarray, " 3"] = dataclasses.field(
        default_factory=lambda: np.zeros(3)
    )
    """Position of the map's origin in the world, m."""
    trunks: Float[np.ndarray, " 3"] = dataclasses.field(
        default_factory=lambda: np.zeros(3)
    )
    """Sum of the directions of trunks in frames that have left the window, in the
    map."""
    inside: dict[int, Float[np.ndarray, " 3"]] = dataclasses.field(default_factory=dict)
    """Sum of the directions of trunks in each frame of the last window, by its
    number."""
    height: float | None = None
    """Height of the first camera over the floor, m."""

    def next_map(self) -> None:
        """Continues this world in a new map whose first camera has the same pose in it;
        the unit of the map, and with it the scale, is another one."""
        sums = np.array(list(self.inside.values())).reshape(-1, 3)
        self.trunks, self.inside = self.trunks + sums.sum(axis=0), {}

    def camera(self, T_WC: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
        """Returns the pose of a camera of the map in the metric world."""
        found = np.eye(4)
        found[:3, :3] = self.turn @ T_WC[:3, :3]
        found[:3, 3] = self.scale * self.turn @ T_WC[:3, 3] + self.origin
        return found

    def learn(self, solved: Solved, body: BodyModel) -> None:
        """Updates scale, gravity and floor from a window."""
        known = np.isfinite(solved.scale_sigma)
        self.scale = solved.scale if known else 1.0
        ups = solved.roots[..., :3, 1]
        trunks = np.einsum("tij,htj->hti", solved.T_WC[:, :3, :3], ups)
        there = solved.present & solved.located
        sums = np.where(there[..., None], trunks, 0.0).sum(axis=0)
        first = solved.first + CHUNK
        gone = [x for k, x in self.inside.items() if k < first]
        self.trunks = self.trunks + np.array(gone).reshape(-1, 3).sum(axis=0)
        self.inside = dict(enumerate(sums[CHUNK:], start=first))
        total = self.trunks + sums[CHUNK:].sum(axis=0)
        if np.linalg.norm(total) > 1e-9:
            self.turn = upright(np.eye(4)[None], total / np.linalg.norm(total))[:3, :3]
        if known:
            self._find_floor(solved, body, there)

    def _find_floor(self, solved: Solved, body: BodyModel, there: np.ndarray) -> None:
        stands = solved.contacts.reshape(*there.shape, 2, 2).max(axis=-1)
        stands = (stands > _MIN_CONTACT_PROBABILITY) & there[..., None]
        if not stands.any():
            return
        T_WC = np.stack([self.camera(T) for T in solved.T_WC])
        T_WC[:, :3, 3] -= self.origin
        heights = []
        for h in range(len(there)):
            rows = np.flatnonzero(stands[h].any(axis=-1))
            if not len(rows):
                continue
            p_H = joints_of(body, solved.poses[h], solved.shapes[h])[rows][
                :, list(FEET)
            ]
            T_WH = T_WC[rows] @ solved.roots[h, rows]
            up = np.einsum("ti,tfi->tf", T_WH[:, 1, :3], p_H) + T_WH[:, None, 1, 3]
            sole = sole_height(body, solved.shapes[h])
            heights.append((up - sole)[stands[h, rows]])
        floor = -float(np.median(np.concatenate(heights)))
        share = _FLOOR_GAIN if self.height is not None else 1.0
        before = self.height if self.height is not None else floor
        self.height = before + share * (floor - before)
        self.origin = np.array([0.0, self.height, 0.0])


@eqx.filter_jit
def _joints(body: BodyModel, poses: object, shapes: object) -> object:
    return local_joints(body, poses, shapes)


def joints_of(
    body: BodyModel, poses: Float[np.ndarray, "t 23 3"], shape: Float[np.ndarray, " 10"]
) -> Float[np.ndarray, "t 24 3"]:
    """Returns joints relative to the pelvis in the root frame, m; compiled for two
    lengths."""
    frames = len(poses)
    size = 1 if frames == 1 else _COMPILED_FRAMES
    longer = np.zeros((size, 23, 3))
    longer[:frames] = poses
    shapes = np.broadcast_to(shape, (size, 10))
    dtype = body.joint_template.dtype
    given = jnp.asarray(longer, dtype), jnp.asarray(shapes, dtype)
    return np.asarray(_joints(body, *given), float)[:frames]


_COMPILED_FRAMES = 60


def placed(
    person: int,
    T_WC: Float[np.ndarray, "4 4"],
    T_CH: Float[np.ndarray, "4 4"],
    body_pose: Float[np.ndarray, "23 3"],
    shape: Float[np.ndarray, " 10"],
    body: BodyModel,
    contacts: Float[np.ndarray, " 4"] | None,
) -> PersonEstimate:
    """Returns the estimate of a person, given in the camera frame, in the world."""
    T_WH = T_WC @ T_CH
    local = joints_of(body, body_pose[None], shape)[0]
    poses = np.concatenate([so3.log(T_WH[:3, :3]), body_pose.reshape(69)])
    joints = local @ T_WH[:3, :3].T + T_WH[:3, 3]
    return PersonEstimate(person, T_WH, poses, shape, joints, contacts)
