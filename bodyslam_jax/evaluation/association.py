"""Associates two results in time and person, and computes their errors."""

import dataclasses
from collections.abc import Iterable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.optimize import linear_sum_assignment

from bodyslam_jax.body import BodyModel, joints, keypoints
from bodyslam_jax.body.skeleton import ANKLES_AND_FEET, BODY25_TOES_AND_HEELS, PELVIS
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.evaluation.alignment import align
from bodyslam_jax.evaluation.errors import (
    NOBODY,
    STRAIGHT_PATH_RMS_M,
    Evaluation,
    Pair,
    Scope,
    Trajectories,
    evaluate_trajectories,
)
from bodyslam_jax.evaluation.metrics import Errors, trajectory_error
from bodyslam_jax.evaluation.resampling import (
    Samples,
    bucket,
    interval_of,
    pad_frames,
    pad_people,
    resample,
    samples_of,
    to_bucket,
    without_holes,
)
from bodyslam_jax.types import Result

_BODY_FEET = "toes and heels"
"""Kind of the foot points of a body model."""


def evaluate(
    result: Result | Trajectories,
    truth: Result | Trajectories,
    body: BodyModel | None = None,
    offset: float = 0.0,
) -> Evaluation:
    """Computes every error of `result` against `truth`, in m, rad and s.

    Two `Result`s are first associated in time and person by `associate`, with its
    arguments `body` and `offset` (s). Two `Trajectories` are compared as they are; for
    these the function can be jitted, vmapped and differentiated:
    `jax.jit(jax.vmap(evaluate))(*stack_pairs(pairs))`. Lengths are padded to a few
    (`resampling.bucket`), each of which is compiled once.

    **Raises:** `InputError` if no frame of one is at the time of a frame of the other,
    or the two are of different kinds.
    """
    if isinstance(result, Trajectories) and isinstance(truth, Trajectories):
        return _evaluate(to_bucket(result), to_bucket(truth))
    if not isinstance(result, Result) or not isinstance(truth, Result):
        raise InputError("Evaluate two `Result`s or two `Trajectories`, not one each.")
    pair = _associate(result, truth, body, offset)
    length = bucket(len(pair.estimate.available))
    found = _evaluate(
        pair.estimate.trajectories(pair.fps, length),
        pair.truth.trajectories(pair.fps, length),
    )
    return dataclasses.replace(found, feet=pair.feet, scope=pair.scope)


_evaluate = eqx.filter_jit(evaluate_trajectories)


def stack_pairs(
    pairs: Iterable[tuple[Result, Result] | tuple[Trajectories, Trajectories]],
    body: BodyModel | None = None,
) -> tuple[Trajectories, Trajectories]:
    """Returns the estimates and the truths of pairs, associated, padded and stacked.

    Pairs with fewer frames or people than others are padded with masked ones; the
    errors of the people who were added are NaN. `Trajectories` are compared frame by
    frame and person by person as they are, such as `case.trajectories(state)` and
    `case.truth`.

    **Raises:** `InputError` if there is no pair, if two `Trajectories` differ in frames
    or people, and as `associate`.
    """
    associated = [_associated(*pair, body) for pair in pairs]
    if not associated:
        raise InputError("No pair of a result and a truth to stack.")
    frames = bucket(max(len(truth.camera_valid) for _, truth in associated))
    people = max(len(truth.present) for _, truth in associated)
    estimates, truths = (
        [pad_people(pad_frames(x, frames), people) for x in side]
        for side in zip(*associated, strict=True)
    )
    # NumPy stacks them, so that nothing is compiled for a number of pairs.
    stack = lambda *x: jnp.asarray(np.stack([np.asarray(one) for one in x]))
    return jax.tree.map(stack, *estimates), jax.tree.map(stack, *truths)


def _associated(
    estimate: Result | Trajectories,
    truth: Result | Trajectories,
    body: BodyModel | None,
) -> tuple[Trajectories, Trajectories]:
    if isinstance(estimate, Result) and isinstance(truth, Result):
        return associate(estimate, truth, body)
    if not isinstance(estimate, Trajectories) or not isinstance(truth, Trajectories):
        found = f"{type(estimate).__name__} and {type(truth).__name__}"
        raise InputError(f"pairs: {found}, expected two `Result` or `Trajectories`.")
    if estimate.present.shape != truth.present.shape:
        raise InputError(
            f"pairs: {estimate.present.shape} and {truth.present.shape} people and "
            "frames, expected the same."
        )
    return estimate, truth


def associate(
    result: Result, truth: Result, body: BodyModel | None = None, offset: float = 0.0
) -> tuple[Trajectories, Trajectories]:
    """Returns estimate and truth on common frames and people.

    Time: `offset` (s) is added to the result's timestamps. The frames are those of the
    slower of the two; the faster is interpolated (positions linearly, rotations on the
    geodesic) across at most one and a half of its own frames. At its ends and gaps the
    nearest frame within half a frame is used; other frames are dropped or masked. Gaps
    are filled with masked frames, so that no difference is taken across them.

    People: the assignment with the least total loss. The loss of a pair is the mean
    over the truth's frames of `e / (e + 1 m)`, with `e` the frame's H-ATE under
    alignment A3 (A1 without a camera), and 1 where the estimate lacks the person, so
    that a complete track is preferred to a fragment. People without a partner are left
    out and listed in `Evaluation.scope`.

    Feet: toes and heels of `body` if the joints of both sides are that body's, else the
    ankle and foot joints.

    **Raises:** `InputError` if no frame of one is at the time of a frame of the other.
    """
    pair = _associate(result, truth, body, offset)
    return pair.estimate.trajectories(pair.fps), pair.truth.trajectories(pair.fps)


def associate_with_people(
    result: Result, truth: Result, body: BodyModel
) -> tuple[Trajectories, Trajectories, list[tuple[int, int]], bool]:
    """Returns what `associate` does, the people of each pair (in the result and in the
    truth), and whether the joints of both are those of `body`."""
    pair = _associate(result, truth, body, 0.0)
    people = [(p.estimate, p.truth) for p in pair.scope.people if p.estimate != NOBODY]
    found, true = (side.trajectories(pair.fps) for side in (pair.estimate, pair.truth))
    return found, true, people, pair.feet == _BODY_FEET


@dataclasses.dataclass(frozen=True)
class _Associated:
    """A result and a truth on common frames and people."""

    estimate: Samples
    truth: Samples
    fps: float
    """Frame rate, 1/s."""
    feet: str
    """The kind of foot points, as text."""
    scope: Scope


def _associate(
    result: Result, truth: Result, body: BodyModel | None, offset: float
) -> _Associated:
    """Implements `associate` in NumPy: nothing is compiled for a particular number of
    frames."""
    times = result.timestamps + offset
    slower = interval_of(times) >= 0.999 * interval_of(truth.timestamps)
    at = without_holes(times if slower else truth.timestamps)
    feet, true_feet, kind = _feet(result, truth, body)
    found = resample(samples_of(result, feet), times, at)
    true = resample(samples_of(truth, true_feet), truth.timestamps, at)
    overlap = np.flatnonzero(found.available & true.available)
    if not len(overlap):
        raise InputError(
            f"The result spans {_span(times)}, the ground truth "
            f"{_span(truth.timestamps)}: no frame of one is within half a frame of the "
            "other; `offset` (s; `--offset`) shifts the result's clock."
        )
    frames = slice(overlap[0], overlap[-1] + 1)
    fps = 1 / interval_of(at)
    who, true_who = _match(found.cut(frames), true.cut(frames), fps)
    partner = dict(zip(true_who, who, strict=True))
    rate = interval_of(truth.timestamps) * fps
    scope = _scope(truth, (found, true), partner, rate)
    pair = found.cut(frames, who), true.cut(frames, true_who)
    return _Associated(*pair, fps, kind, scope)


def _scope(
    truth: Result,
    pair: tuple[Samples, Samples],
    partner: dict[int, int],
    rate: float,
) -> Scope:
    """Returns the extent of the comparison, in frames of the comparison.

    `rate` is their number per frame of the truth. Frames of the truth outside the
    result's time span count as not compared.
    """
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
            straight.append(bool(compared) and _from_a_line(path) < STRAIGHT_PATH_RMS_M)
    matched = sum(pair.estimate != NOBODY for pair in people)
    return Scope(
        *counts(found.camera_valid & true.camera_valid, everywhere),
        tuple(people),
        int(found.present.any(axis=1).sum()) - matched,
        tuple(straight),
    )


def _from_a_line(points: Float[np.ndarray, "t 3"]) -> float:
    """Returns the RMS distance from the best-fitting line, m; NaN if a point is not
    finite."""
    if not np.isfinite(points).all():
        return np.nan
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return float(np.linalg.norm(spread[1:]) / np.sqrt(len(points)))


def _span(times: Float[np.ndarray, " t"]) -> str:
    return f"{times[0]:.3f} to {times[-1]:.3f} s"


def _match(found: Samples, true: Samples, fps: float) -> tuple[list[int], list[int]]:
    """Returns the indices of the estimate's and of the truth's person of each pair, in
    the truth's order."""
    num, num_true = len(found.present), len(true.present)
    if num <= 1 and num_true <= 1:
        both = list(range(min(num, num_true)))
        return both, both
    length = bucket(len(found.available))
    pair = found.trajectories(fps, length), true.trajectories(fps, length)
    loss = np.asarray(_loss_of_all_pairs(*pair))
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
        # NaN if the two are never present together.
        return jnp.where(jnp.any(valid), whole.mean(), jnp.nan)

    over_truth = jax.vmap(loss, (None, None, 0, 0))
    return jax.vmap(over_truth, (0, 0, None, None))(
        found.joints, found.present, true.joints, true.present
    )


def _feet(
    result: Result, truth: Result, body: BodyModel | None
) -> tuple[np.ndarray, np.ndarray, str]:
    """Returns the foot points of both sides (h, t, 4, 3; m), and their kind as text."""
    if body is not None:
        feet, true_feet = (_feet_of(x, body) for x in (result, truth))
        if feet is not None and true_feet is not None:
            return feet, true_feet, _BODY_FEET
    feet, true_feet = (x.joints[:, :, ANKLES_AND_FEET] for x in (result, truth))
    return feet, true_feet, "ankle and foot joints"


def _feet_of(result: Result, body: BodyModel) -> np.ndarray | None:
    """Returns the toes and heels if the joints are this body's, to a centimetre, else
    `None`."""
    joints, feet = _joints_and_feet(result, body)
    apart = np.max(np.abs(joints - result.joints), (-2, -1))
    return feet if np.all(apart[result.present] < 0.01) else None


def _joints_and_feet(result: Result, body: BodyModel) -> tuple[np.ndarray, np.ndarray]:
    """Returns the joints (h, t, 24, 3), and the toes and heels (h, t, 4, 3), of the
    posed body, m."""
    people, frames = result.present.shape
    betas = np.broadcast_to(result.betas[:, None], (people, frames, 10))
    # One row per person and frame, padded, so that few lengths are compiled.
    rows = np.zeros((bucket(people * frames), 72 + 10 + 3))
    rows[: people * frames] = np.concatenate(
        [result.poses, betas, result.trans], axis=-1
    ).reshape(-1, rows.shape[1])
    found = _pose_rows(body, jnp.asarray(rows, body.dtype))
    joints, feet = (np.asarray(x)[: people * frames] for x in found)
    shape = lambda x: x.reshape(people, frames, *x.shape[1:])
    return shape(joints), shape(feet)


@eqx.filter_jit
def _pose_rows(body: BodyModel, rows: Float[Array, "n 85"]) -> tuple[Array, Array]:
    pose, shape, trans = rows[:, :72], rows[:, 72:82], rows[:, 82:]
    points = keypoints(body, pose, shape, trans, layout="body25")
    feet = points[:, np.array(BODY25_TOES_AND_HEELS)]
    return joints(body, pose, shape, trans), feet
