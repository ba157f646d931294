"""Two results brought together: same moments, same people."""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.optimize import linear_sum_assignment

from bodyslam_jax.body import BodyModel, joints, keypoints
from bodyslam_jax.body.skeleton import ANKLES_AND_FEET, BODY25_TOES_AND_HEELS, PELVIS
from bodyslam_jax.evaluation.alignment import align
from bodyslam_jax.evaluation.errors import (
    NOBODY,
    STRAIGHT,
    Evaluation,
    Pair,
    Scope,
    Trajectories,
    evaluate_trajectories,
)
from bodyslam_jax.evaluation.metrics import Errors, trajectory_error
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.types import Result


def evaluate(
    result: Result | Trajectories,
    truth: Result | Trajectories,
    body: BodyModel | None = None,
    offset: float = 0.0,
) -> Evaluation:
    """Every error of `result` against `truth`.

    Results are first associated in time and person (`associate`, on the host).
    `Trajectories`, which are associated already, pass straight to the pure
    `evaluate_trajectories`: jit, vmap and differentiate this function with those.

    **Raises:** `ValueError` if no frame of one is at the time of a frame of the other.
    """
    if isinstance(result, Trajectories) and isinstance(truth, Trajectories):
        return evaluate_trajectories(result, truth)
    if not isinstance(result, Result) or not isinstance(truth, Result):
        raise ValueError("Evaluate two `Result`s or two `Trajectories`, not one each.")
    *pair, feet, scope = _associate(result, truth, body, offset)
    return dataclasses.replace(_evaluate(*pair), feet=feet, scope=scope)


_evaluate = eqx.filter_jit(evaluate_trajectories)


def associate(
    result: Result, truth: Result, body: BodyModel | None = None, offset: float = 0.0
) -> tuple[Trajectories, Trajectories]:
    """Estimate and truth on common frames and people.

    Time: `offset` (s) is added to the result's timestamps. The slower of the two sets
    the frames; the faster is interpolated there (positions linearly, rotations on the
    geodesic), across at most one and a half of its own frames; at its ends and gaps the
    nearest frame within half a frame is taken. Other frames are dropped or masked, and
    where frames are missing there are masked ones: nothing is a difference across them.

    People: the pairing with the least total loss, `e / (e + 1 m)` of the H-ATE of a
    frame under alignment A3 (A1 without a camera), and 1 for a frame of the truth that
    the estimate lacks, so that a piece of a track does not beat the whole. People
    without partner are left out (`Evaluation.scope` says who).

    Feet: toes and heels of `body` if both sides' joints are that body's, else the ankle
    and foot joints.

    **Raises:** `ValueError` if no frame of one is at the time of a frame of the other.
    """
    return _associate(result, truth, body, offset)[:2]


def _associate(
    result: Result, truth: Result, body: BodyModel | None, offset: float
) -> tuple[Trajectories, Trajectories, str, Scope]:
    """Estimate, truth, which points the feet are, and what is compared."""
    times = result.timestamps + offset
    slower = _interval(times) >= 0.999 * _interval(truth.timestamps)
    at = _without_holes(times if slower else truth.timestamps)
    feet, true_feet, kind = _feet(result, truth, body)
    found = _resample(_host(result, feet), times, at)
    true = _resample(_host(truth, true_feet), truth.timestamps, at)
    overlap = np.flatnonzero(found.close & true.close)
    if not len(overlap):
        raise ValueError(
            f"The result spans {_span(times)}, the ground truth "
            f"{_span(truth.timestamps)}: no frame of one is within half a frame of the "
            "other; `offset` (s; `--offset`) shifts the result's clock."
        )
    frames = slice(overlap[0], overlap[-1] + 1)
    fps = 1 / _interval(at)
    everybody = range(len(found.present)), range(len(true.present))
    pair = (
        _bundle(found, frames, everybody[0], fps),
        _bundle(true, frames, everybody[1], fps),
    )
    who, true_who = _match(*pair)
    partner = dict(zip(true_who, who, strict=True))
    rate = _interval(truth.timestamps) * fps
    scope = _scope(truth, (found, true), partner, rate)
    found, true = (
        _bundle(found, frames, who, fps),
        _bundle(true, frames, true_who, fps),
    )
    return found, true, kind, scope


def _scope(
    truth: Result,
    pair: tuple["_Host", "_Host"],
    partner: dict[int, int],
    rate: float,
) -> Scope:
    """What of the truth is compared, in frames of which `rate` (1) go on one of its
    own; also those of its frames that the result's time does not reach."""
    found, true = pair

    def counts(both: np.ndarray, own: np.ndarray) -> tuple[int, int]:
        compared = int(both.sum())
        return compared, max(compared, round(float(own.sum()) * rate))

    camera = truth.summary.get("has_camera", True)
    everywhere = np.full(len(truth.timestamps), bool(camera))
    people, straight = [], []
    for i, own in enumerate(truth.present):
        who = partner.get(i)
        both = true.present[i] & (False if who is None else found.present[who])
        compared, of = counts(both, own)
        if of:
            someone = NOBODY if who is None or not compared else who
            people.append(Pair(i, someone, compared, of))
            path = true.joints[i, both, PELVIS]
            straight.append(bool(compared) and _from_a_line(path) < STRAIGHT)
    matched = sum(pair.estimate != NOBODY for pair in people)
    return Scope(
        *counts(found.camera_valid & true.camera_valid, everywhere),
        tuple(people),
        int(found.present.any(axis=1).sum()) - matched,
        tuple(straight),
    )


def _from_a_line(points: Float[np.ndarray, "t 3"]) -> float:
    """Root mean square distance from the line that fits best, m; NaN if a point is."""
    if not np.isfinite(points).all():
        return np.nan
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return float(np.linalg.norm(spread[1:]) / np.sqrt(len(points)))


def _without_holes(times: Float[np.ndarray, " t"]) -> Float[np.ndarray, " u"]:
    """The moments, and those between where frames are missing, a hundred at most."""
    interval = _interval(times)
    filled = [
        np.linspace(a, b, min(max(round((b - a) / interval), 1), _HOLE), endpoint=False)
        for a, b in zip(times[:-1], times[1:], strict=True)
    ]
    return np.concatenate([*filled, times[-1:]])


_HOLE = 101
"""Steps across missing frames at most."""


def pad_frames(trajectories: Trajectories, num_frames: int) -> Trajectories:
    """The same with frames that do not count added to the end: equal shapes stack."""
    missing = num_frames - trajectories.T_WC.shape[0]

    def pad(x: Array, axis: int, mode: str = "edge") -> Array:
        return jnp.pad(x, [(0, missing * (i == axis)) for i in range(x.ndim)], mode)

    return Trajectories(
        pad(trajectories.T_WC, 0),
        pad(trajectories.camera_valid, 0, "constant"),
        pad(trajectories.joints, 1),
        pad(trajectories.present, 1, "constant"),
        pad(trajectories.feet, 1),
        trajectories.fps,
    )


@dataclasses.dataclass(frozen=True)
class _Host:
    """`Trajectories` before they are cut to size, and which frames have data."""

    T_WC: np.ndarray
    camera_valid: np.ndarray
    joints: np.ndarray
    present: np.ndarray
    feet: np.ndarray
    close: np.ndarray


def _host(result: Result, feet: np.ndarray) -> _Host:
    has_camera = bool(result.summary.get("has_camera", True))
    every = np.ones(len(result.timestamps), bool)
    camera = result.located & has_camera
    return _Host(result.T_WC, camera, result.joints, result.present, feet, every)


def _interval(times: Float[np.ndarray, " t"]) -> float:
    return float(np.median(np.diff(times))) if len(times) > 1 else 1 / 30


def _span(times: Float[np.ndarray, " t"]) -> str:
    return f"{times[0]:.3f} to {times[-1]:.3f} s"


def brackets(
    times: Float[np.ndarray, " t"], at: Float[np.ndarray, " u"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Frames before and after each moment, the weight of the latter, whether close.

    A weight strictly between 0 and 1 interpolates, and never across a gap; `close` is
    where there is data to interpolate, or a frame within half a frame.
    """
    interval = _interval(times)
    after = np.clip(np.searchsorted(times, at), min(1, len(times) - 1), len(times) - 1)
    before = np.maximum(after - 1, 0)
    gap = np.maximum(times[after] - times[before], 1e-12)
    weight = np.clip((at - times[before]) / gap, 0, 1)
    nearest = np.round(weight)
    # Timestamps are rounded in files, and a gap is nothing to interpolate across.
    blend = (abs(weight - nearest) > 1e-3) & (gap <= 1.5 * interval)
    distance = np.minimum(abs(at - times[before]), abs(at - times[after]))
    return (
        before,
        after,
        np.where(blend, weight, nearest),
        blend | (distance <= 0.5001 * interval),
    )


def interpolate_poses(
    T: Float[np.ndarray, "t 4 4"],
    before: np.ndarray,
    after: np.ndarray,
    weight: np.ndarray,
) -> Float[np.ndarray, "u 4 4"]:
    """Poses between frames: centres linearly, rotations on the geodesic."""
    w = weight[:, None, None]
    found = (1 - w) * T[before] + w * T[after]
    if np.any((weight > 0) & (weight < 1)):
        start, end = T[before, :3, :3], T[after, :3, :3]
        found[:, :3, :3] = so3.interpolate(start, end, weight)
    return found


def _resample(host: _Host, times: np.ndarray, at: np.ndarray) -> _Host:
    """The same at other moments; `close` says where there was data to take."""
    if not len(times):
        raise ValueError("A result without frames cannot be evaluated.")
    before, after, weight, close = brackets(times, at)

    def positions(x: np.ndarray) -> np.ndarray:
        w = weight[:, None, None]
        return (1 - w) * x[:, before] + w * x[:, after]

    def flags(x: np.ndarray) -> np.ndarray:
        known = (x[..., before] | (weight == 1)) & (x[..., after] | (weight == 0))
        return known & close

    return _Host(
        interpolate_poses(host.T_WC, before, after, weight),
        flags(host.camera_valid),
        positions(host.joints),
        flags(host.present),
        positions(host.feet),
        close,
    )


def _bundle(
    host: _Host, frames: slice, people: Sequence[int], fps: float
) -> Trajectories:
    who = list(people)
    return Trajectories(
        jnp.asarray(host.T_WC[frames]),
        jnp.asarray(host.camera_valid[frames]),
        jnp.asarray(host.joints[who][:, frames]),
        jnp.asarray(host.present[who][:, frames]),
        jnp.asarray(host.feet[who][:, frames]),
        jnp.asarray(fps),
    )


def _match(found: Trajectories, true: Trajectories) -> tuple[list[int], list[int]]:
    """Who is who: estimate's and truth's person of each pair, in the truth's order."""
    num, num_true = len(found.present), len(true.present)
    if num <= 1 and num_true <= 1:
        both = list(range(min(num, num_true)))
        return both, both
    loss = np.asarray(_loss_of_all_pairs(found, true))
    never = np.isnan(loss)
    who, true_who = linear_sum_assignment(np.where(never, 1e6, loss))
    pairs = sorted(
        (int(b), int(a)) for a, b in zip(who, true_who, strict=True) if not never[a, b]
    )
    return [a for _, a in pairs], [b for b, _ in pairs]


@eqx.filter_jit
def _loss_of_all_pairs(
    found: Trajectories, true: Trajectories
) -> Float[Array, "h true"]:
    camera_valid = found.camera_valid & true.camera_valid

    def loss(joints, present, true_joints, true_present):
        valid = present & true_present
        _, human = align(
            "A3",
            true.T_WC,
            found.T_WC,
            camera_valid.astype(joints.dtype),
            true_joints[:, PELVIS],
            joints[:, PELVIS],
            valid.astype(joints.dtype),
        )
        error = trajectory_error(
            joints[:, PELVIS], true_joints[:, PELVIS], valid, human
        )
        lost = error.value / (error.value + 1.0)
        whole = Errors(jnp.where(valid, lost, 1.0), true_present)
        # NaN where they are never known together.
        return jnp.where(jnp.any(valid), whole.mean(), jnp.nan)

    over_truth = jax.vmap(loss, (None, None, 0, 0))
    return jax.vmap(over_truth, (0, 0, None, None))(
        found.joints, found.present, true.joints, true.present
    )


def _feet(
    result: Result, truth: Result, body: BodyModel | None
) -> tuple[np.ndarray, np.ndarray, str]:
    """Foot points of both sides, of the same kind, and which."""
    if body is not None:
        feet, true_feet = (_feet_of(x, body) for x in (result, truth))
        if feet is not None and true_feet is not None:
            return feet, true_feet, "toes and heels"
    feet, true_feet = (x.joints[:, :, ANKLES_AND_FEET] for x in (result, truth))
    return feet, true_feet, "ankle and foot joints"


def _feet_of(result: Result, body: BodyModel) -> np.ndarray | None:
    """Toes and heels, if the joints are this body's, to a centimetre."""
    mine, points = _joints_and_feet(body, *_pose_shape_trans(result, body))
    apart = np.max(np.abs(np.asarray(mine) - result.joints), (-2, -1))
    return np.asarray(points) if np.all(apart[result.present] < 0.01) else None


@eqx.filter_jit
def _joints_and_feet(body, pose, shape, trans):
    points = keypoints(body, pose, shape, trans, layout="body25")
    return joints(body, pose, shape, trans), points[
        ..., np.array(BODY25_TOES_AND_HEELS), :
    ]


def _pose_shape_trans(result: Result, body: BodyModel) -> tuple[Array, Array, Array]:
    dtype = body.template.dtype
    return (
        jnp.asarray(result.poses, dtype),
        jnp.asarray(result.betas[:, None], dtype),
        jnp.asarray(result.trans, dtype),
    )
