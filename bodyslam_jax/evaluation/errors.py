"""Computes all errors of an estimate, as a pure function of associated trajectories.

Errors of trajectories do not show that a person slides, floats or crouches. Gravity,
feet, knees and acceleration, by which `bodyslam_jax.diagnostics` judges a result, are
reported beside them, for the estimate and for the truth.
"""

from collections.abc import Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from bodyslam_jax.body.skeleton import (
    ANKLES,
    ANKLES_AND_FEET,
    FEET,
    HIPS,
    KNEES,
    NECK,
    PELVIS,
)
from bodyslam_jax.evaluation import metrics
from bodyslam_jax.evaluation.alignment import Alignment, align, is_point
from bodyslam_jax.evaluation.metrics import norm, only

NOBODY = -1
STATIC_CAMERA_RMS_M = 0.01
"""RMS distance of a camera from its mean position below which it counts as static."""
STRAIGHT_PATH_RMS_M = 0.1
"""RMS distance from a line below which a person's path does not determine the rotation
about it in alignment A1, on which J-ATE then depends."""
_HIPS, _KNEES, _ANKLES, _FEET = map(np.array, (HIPS, KNEES, ANKLES, FEET))
_ANKLES_AND_FEET = np.array(ANKLES_AND_FEET)
_MIN_TRUNK_COSINE = float(np.cos(np.radians(35.0)))
"""Cosine of the angle between people's mean trunk and the up axis from which that axis
is known: cos 35°."""
UP = np.array([0.0, 1.0, 0.0])
"""Up in a result."""
FIGURES = (
    "knee",
    "straighter_knee",
    "feet_low",
    "feet_high",
    "foot_speed",
    "joint_acceleration",
)
"""Names of `posture_figures`; those of the truth have the suffix `_of_truth`."""


class Trajectories(eqx.Module):
    """A camera and `h` people over `t` frames in one world frame.

    Two of them can be compared if frame `k` is the same moment and person `i` the same
    person in both; `associate` makes such a pair from two results.
    """

    T_WC: Float[Array, "*b t 4 4"]
    """Camera to world, m."""
    camera_valid: Bool[Array, "*b t"]
    """Frames in which the camera is known."""
    joints: Float[Array, "*b h t 24 3"]
    """Joints, m, world frame."""
    present: Bool[Array, "*b h t"]
    """Frames in which the person is known."""
    feet: Float[Array, "*b h t f 3"]
    """Points of the feet for `foot_sliding`, m, world frame."""
    fps: Float[Array, "*b"]
    """Frame rate, 1/s."""


class Pair(eqx.Module):
    """A person of the truth and the person of the estimate assigned to them."""

    truth: int
    """Index in the truth."""
    estimate: int
    """Index in the estimate; `NOBODY` if none is assigned."""
    frames: int
    """Frames in which both are known."""
    of_frames: int
    """Frames in which the truth is known."""


class Scope(eqx.Module):
    """Extent of a comparison: the frames and people of the truth that are compared."""

    cameras: int
    """Frames in which both cameras are known."""
    of_cameras: int
    """Frames in which the true camera is known."""
    people: tuple[Pair, ...]
    """A pair for each person of the truth."""
    others: int
    """Number of people of the estimate who are assigned to nobody of the truth."""
    straight: tuple[bool, ...] = ()
    """For each of `people`: whether the true pelvis stays within `STRAIGHT_PATH_RMS_M`
    of a line in the frames compared."""


class Evaluation(eqx.Module):
    """Errors by name in m, rad, s: `found["c_ate_se3"]` is a mean, `..._rmse` its RMSE.

    It is a mapping: `keys`, `items`, `in` and `len` work. An error is NaN if the truth
    or the estimate lacks what it needs, or if a value in a compared frame is not
    finite.
    """

    values: dict[str, Float[Array, "*b"]]
    """Errors of the camera, and the errors of people averaged over people."""
    people: dict[str, Float[Array, "*b h"]]
    """Errors of each assigned person, in the truth's order."""
    feet: str = eqx.field(static=True, default="the points given")
    """The points that `foot_sliding` is computed from, as text."""
    scope: Scope | None = None
    """Extent of the comparison; `None` for `Trajectories`, which are compared
    entirely."""

    def __getitem__(self, name: str) -> Float[Array, "*b"]:
        return self.values[name]

    def __contains__(self, name: object) -> bool:
        return name in self.values

    def __iter__(self) -> Iterator[str]:
        return iter(self.values)

    def __len__(self) -> int:
        return len(self.values)

    def keys(self):
        """Returns the names of the errors."""
        return self.values.keys()

    def items(self):
        """Returns pairs of name and error."""
        return self.values.items()


def evaluate_trajectories(estimate: Trajectories, truth: Trajectories) -> Evaluation:
    """Computes every error of module `metrics`; can be jitted, vmapped and
    differentiated.

    The prefix `c_` denotes the camera, `h_` the human centre, `j_` the joints. `_se3`
    and `_sim3` are alignment A1 (camera and person aligned independently), `_a2`,
    `_a3`, `_a4` the other three in SE(3). `scale` is that of the camera's Sim(3)
    alignment (paper: "scale error", best 1), `scale_error` is `|1 - scale|`. A true
    camera that stays within `STATIC_CAMERA_RMS_M` determines neither scale nor
    rotation: `scale`, `_sim3` and `_a2` are NaN. `scale` and `_sim3` are also NaN if
    the estimated camera does not move at all.

    `gravity_error` and the figures of plausibility assume that y is up in the
    estimate, as in a `Result`.

    Args:
        estimate: with the same frames and people as `truth`.
        truth: true trajectories.
    """
    camera_valid = estimate.camera_valid & truth.camera_valid
    values = _camera_errors(estimate, truth, camera_valid)
    true_up, has_up = up_axis(truth.joints, truth.present)
    tilt = gravity_error(estimate.T_WC, truth.T_WC, camera_valid, true_up)
    values["gravity_error"] = jnp.where(has_up, tilt, jnp.nan)
    people: dict[str, Array] = {}
    if truth.present.shape[0]:
        per_person = jax.vmap(_person_errors, (0,) * 6 + (None,) * 4)
        people = per_person(
            estimate.joints,
            truth.joints,
            estimate.feet,
            truth.feet,
            estimate.present,
            truth.present,
            estimate,
            truth,
            camera_valid,
            true_up,
        )
        counts = estimate.present & truth.present
        broken = jnp.zeros(len(counts), bool)
        for side in (estimate, truth):
            broken |= _is_broken(side.T_WC, camera_valid)
            broken |= jax.vmap(_is_broken)(side.joints, counts)
        # This includes C-ATE under A3 and A4, which the camera alone would determine.
        absent = ~jnp.any(estimate.present | truth.present, 1)
        people = {k: jnp.where(absent, jnp.nan, x) for k, x in people.items()}
        mean = lambda value: _mean_over_people(value, broken)
        values |= {name: mean(value) for name, value in people.items()}
    return Evaluation(values, people)


def _is_broken(x: Float[Array, "t ..."], valid: Bool[Array, " t"]) -> Bool[Array, ""]:
    """Returns whether a value in a valid frame is not finite."""
    return jnp.any(valid & ~jnp.all(jnp.isfinite(x), tuple(range(1, x.ndim))))


def _mean_over_people(
    value: Float[Array, " h"], broken: Bool[Array, " h"]
) -> Float[Array, ""]:
    """Returns the mean over the people for whom the error exists.

    It is NaN if an input of any person is not finite (`broken`).
    """
    exists = ~jnp.isnan(value) | broken
    return metrics.Errors(value, exists).mean()


def _moves(T_WC: Float[Array, "t 4 4"], valid: Bool[Array, " t"]) -> Bool[Array, ""]:
    """Returns whether the RMS distance of the camera centres from their mean exceeds
    `STATIC_CAMERA_RMS_M`."""
    (centre,) = metrics.only(valid, T_WC[:, :3, 3])
    count = jnp.maximum(jnp.sum(valid), 1).astype(centre.dtype)
    (apart,) = metrics.only(valid, centre - jnp.sum(centre, 0) / count)
    return jnp.sum(apart**2) / count > STATIC_CAMERA_RMS_M**2


def _stands(T_WC: Float[Array, "t 4 4"], valid: Bool[Array, " t"]) -> Bool[Array, ""]:
    """Returns whether all camera centres coincide up to rounding errors.

    The tolerance is relative to the centres' mean, so the unit of length is irrelevant.
    """
    (centre,) = metrics.only(valid, T_WC[:, :3, 3])
    count = jnp.maximum(jnp.sum(valid), 1).astype(centre.dtype)
    mean = jnp.sum(centre, 0) / count
    (apart,) = metrics.only(valid, centre - mean)
    return is_point(jnp.sum(apart**2) / count, mean)


def _both(name: str, errors: metrics.Errors) -> dict[str, Array]:
    return {name: errors.mean(), f"{name}_rmse": errors.rmse()}


def _camera_errors(
    estimate: Trajectories, truth: Trajectories, valid: Bool[Array, " t"]
) -> dict[str, Array]:
    weights = valid.astype(truth.T_WC.dtype)
    centres, true_centres = estimate.T_WC[:, :3, 3], truth.T_WC[:, :3, 3]
    values: dict[str, Array] = {}
    scale = jnp.ones((), weights.dtype)
    for group, with_scale in (("se3", False), ("sim3", True)):
        found, _ = align(
            "A1",
            truth.T_WC,
            estimate.T_WC,
            weights,
            true_centres,
            centres,
            weights,
            with_scale,
        )
        error = metrics.trajectory_error(centres, true_centres, valid, found)
        values |= _both(f"c_ate_{group}", error)
        scale = found.scale
    values["ate_s"] = values["c_ate_se3"]
    has_scale = _moves(truth.T_WC, valid) & ~_stands(estimate.T_WC, valid)
    for name in ("c_ate_sim3", "c_ate_sim3_rmse"):
        values[name] = jnp.where(has_scale, values[name], jnp.nan)
    values["scale"] = jnp.where(has_scale, scale, jnp.nan)
    values["scale_error"] = jnp.where(has_scale, jnp.abs(1 - scale), jnp.nan)
    moved, turned = metrics.relative_pose_errors(estimate.T_WC, truth.T_WC, valid)
    return values | _both("rpe_translation", moved) | _both("rpe_rotation", turned)


def _person_errors(
    joints: Float[Array, "t 24 3"],
    true_joints: Float[Array, "t 24 3"],
    feet: Float[Array, "t f 3"],
    true_feet: Float[Array, "t f 3"],
    present: Bool[Array, " t"],
    true_present: Bool[Array, " t"],
    estimate: Trajectories,
    truth: Trajectories,
    camera_valid: Bool[Array, " t"],
    true_up: Float[Array, " 3"],
) -> dict[str, Array]:
    valid = present & true_present
    dtype = true_joints.dtype
    centre, true_centre = joints[:, PELVIS], true_joints[:, PELVIS]
    values: dict[str, Array] = {}
    choices: tuple[tuple[str, Alignment, bool], ...] = (
        ("se3", "A1", False),
        ("sim3", "A1", True),
        ("a2", "A2", False),
        ("a3", "A3", False),
        ("a4", "A4", False),
    )
    for name, alignment, with_scale in choices:
        camera, human = align(
            alignment,
            truth.T_WC,
            estimate.T_WC,
            camera_valid.astype(dtype),
            true_centre,
            centre,
            valid.astype(dtype),
            with_scale,
        )
        usable = valid if alignment == "A1" else valid & jnp.any(camera_valid)
        if alignment == "A2":
            usable = valid & _moves(truth.T_WC, camera_valid)
        if alignment in ("A3", "A4"):
            values |= _both(
                f"c_ate_{name}",
                metrics.trajectory_error(
                    estimate.T_WC[:, :3, 3], truth.T_WC[:, :3, 3], camera_valid, camera
                ),
            )
        values |= _both(
            f"h_ate_{name}",
            metrics.trajectory_error(centre, true_centre, usable, human),
        )
        values |= _both(
            f"j_ate_{name}",
            metrics.joint_trajectory_error(joints, true_joints, usable, human),
        )
    chunkings: dict[str, metrics.Chunking] = {"": "wham", "_tram": "tram"}
    for suffix, chunking in chunkings.items():
        first = metrics.world_mpjpe(joints, true_joints, valid, "first", chunking)
        every = metrics.world_mpjpe(joints, true_joints, valid, "all", chunking)
        values |= _both(f"w_mpjpe{suffix}", first) | _both(f"wa_mpjpe{suffix}", every)
    values |= _both("rte", metrics.root_trajectory_error(centre, true_centre, valid))
    in_view = valid & camera_valid
    in_camera, true_in_camera = (
        metrics.camera_frame(*metrics.only(in_view, points, T_WC))
        for points, T_WC in ((joints, estimate.T_WC), (true_joints, truth.T_WC))
    )
    values |= _both("mpjpe", metrics.mpjpe(in_camera, true_in_camera, in_view))
    values |= _both("pa_mpjpe", metrics.pa_mpjpe(joints, true_joints, valid))
    values |= _both(
        "acceleration_error",
        metrics.acceleration_error(
            metrics.hip_centred(in_camera),
            metrics.hip_centred(true_in_camera),
            in_view,
            estimate.fps,
        ),
    )
    values |= _both("jitter", metrics.jitter(joints, valid, estimate.fps))
    values |= _both("jitter_of_truth", metrics.jitter(true_joints, valid, truth.fps))
    up = jnp.asarray(UP, dtype)
    own = posture_figures(joints, valid, up, estimate.fps)
    theirs = posture_figures(true_joints, valid, true_up, truth.fps)
    values |= own | {f"{name}_of_truth": value for name, value in theirs.items()}
    return values | _both("foot_sliding", metrics.foot_sliding(feet, true_feet, valid))


def up_axis(
    joints: Float[Array, "h t 24 3"], present: Bool[Array, "h t"]
) -> tuple[Float[Array, " 3"], Bool[Array, ""]]:
    """Returns the world axis that points up, and whether it is known.

    It is the axis nearest to the mean direction of people's trunks, and known if that
    is within 35 degrees.
    """
    trunk = jnp.where(
        present[..., None], joints[..., NECK, :] - joints[..., PELVIS, :], 0
    )
    total = jnp.sum(trunk, (0, 1))
    largest = jnp.argmax(jnp.abs(total))
    sign = jnp.where(total[largest] < 0, -1, 1).astype(joints.dtype)
    axis = jnp.zeros(3, joints.dtype).at[largest].set(sign)
    known = jnp.abs(total[largest]) > _MIN_TRUNK_COSINE * norm(total)
    return axis, known


def gravity_error(
    T_WC: Float[Array, "t 4 4"],
    true_T_WC: Float[Array, "t 4 4"],
    valid: Bool[Array, " t"],
    true_up: Float[Array, " 3"],
) -> Float[Array, ""]:
    """Returns the mean angle between the up directions of estimate (y) and truth in the
    camera frame, rad; it needs no alignment. NaN without cameras."""
    T, true_T = (
        jnp.where(valid[:, None, None], x, jnp.eye(4, dtype=x.dtype))
        for x in (T_WC, true_T_WC)
    )
    up = T[:, 1, :3]
    true_up_C = jnp.einsum("tji,j->ti", true_T[:, :3, :3], true_up)
    # The arc cosine is inaccurate at small angles.
    angle = jnp.arctan2(norm(jnp.cross(up, true_up_C)), jnp.sum(up * true_up_C, -1))
    return _mean(angle, valid)


def posture_figures(
    joints: Float[Array, "t 24 3"],
    valid: Bool[Array, " t"],
    up: Float[Array, " 3"],
    fps: Float[Array, ""],
) -> dict[str, Float[Array, ""]]:
    """Returns figures of one person's posture and motion, in rad, m, s.

    `knee`, `straighter_knee`: mean angle between thigh and shin, of both and of the
    straighter leg. `feet_low`, `feet_high`: 5th and 95th percentile of the height of
    the lowest of ankle and toe joints, over the world's zero. `foot_speed`: median
    horizontal speed of the lower toe joint. `joint_acceleration`: median over joints
    and frames.
    """
    (joints,) = only(valid, joints)
    thigh = joints[:, _KNEES] - joints[:, _HIPS]
    shin = joints[:, _ANKLES] - joints[:, _KNEES]
    knee = jnp.arctan2(norm(jnp.cross(thigh, shin)), jnp.sum(thigh * shin, -1))
    lowest = jnp.min(joints[:, _ANKLES_AND_FEET] @ up, 1)
    feet = joints[:, _FEET]
    step = jnp.diff(feet, axis=0)
    flat = norm(step - (step @ up)[..., None] * up) * fps
    lower = jnp.argmin(feet[:-1] @ up, 1)
    speed = jnp.take_along_axis(flat, lower[:, None], 1)[:, 0]
    two = valid[1:] & valid[:-1]
    bent = norm(jnp.diff(joints, n=2, axis=0)) * fps**2
    three = two[1:] & two[:-1]
    return {
        "knee": _mean(jnp.mean(knee, 1), valid),
        "straighter_knee": _mean(jnp.min(knee, 1), valid),
        "feet_low": _quantile(lowest, valid, 0.05),
        "feet_high": _quantile(lowest, valid, 0.95),
        "foot_speed": _quantile(speed, two, 0.5),
        "joint_acceleration": _quantile(bent, three[:, None], 0.5),
    }


def _mean(x: Float[Array, " n"], valid: Bool[Array, " n"]) -> Float[Array, ""]:
    count = jnp.sum(valid).astype(x.dtype)
    total = jnp.sum(jnp.where(valid, x, 0))
    return jnp.where(count > 0, total / jnp.maximum(count, 1), jnp.nan)


def _quantile(
    x: Float[Array, "*n"], valid: Bool[Array, "*#n"], share: float
) -> Float[Array, ""]:
    """Returns a quantile of the valid values; NaN without any, or if one of them is
    NaN."""
    if not x.size:  # differences of one frame or two
        return jnp.full((), jnp.nan, x.dtype)
    broken = jnp.any(jnp.isnan(x) & valid)
    found = jnp.nanquantile(jnp.where(valid, x, jnp.nan), jnp.asarray(share, x.dtype))
    return jnp.where(broken, jnp.nan, found)
