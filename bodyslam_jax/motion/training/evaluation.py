"""Evaluates a motion model on motion capture.

Errors of predicted displacements are measured by their size, bias, spread, calibration
and correlation. The slope is the projection of predicted on true displacement: it is 1
without bias, and its relative error is that of a scale estimated with the model.

Validation during training takes the same errors (`validated`) and selects the epoch
whose weights are kept (`kept`).
"""

import dataclasses
import json
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from bodyslam_jax.body import BodyModel, local_joints
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.geometry import so3
from bodyslam_jax.motion.capture.clips import FPS, Clip, Trial, place, resample
from bodyslam_jax.motion.own_model import FunctionNetwork
from bodyslam_jax.motion.paper_network import PaperNetwork
from bodyslam_jax.motion.position_network import MetricNetwork
from bodyslam_jax.motion.prediction import MotionModel, Prediction, in_dtype, predict
from bodyslam_jax.motion.training.sampling import disturb, drift

SLOPE_FRAMES = 30
"""Duration of the displacements of `slope_30`, frames: one second."""
LAGS_FRAMES = (1, 2, 4, 8, 15, 30)
"""Time lags at which the correlation of errors is measured, frames."""
_CHI2_95 = 7.815
"""95 % quantile of the chi-square distribution with 3 degrees of freedom."""
DRIFTS_DEG = (0.0, 5.0, 9.0)
"""Standard deviations of slow joint-angle errors at which a model is evaluated,
degrees."""
_WHITE_DEG = 0.4
"""Standard deviation of white joint-angle errors beside slow ones, degrees: two thirds
of the largest in training."""
TARGET_RATIOS = (0.10, 0.13, 0.18)
"""Target ratio of error to displacement at each drift."""


@eqx.filter_jit
def _steps(
    model: MotionModel,
    body: BodyModel,
    poses: Float[Array, "c t 24 3"],
    estimated: Float[Array, "c t 24 3"],
    trans: Float[Array, "c t 3"],
    shape: Float[Array, "c 10"],
    present: Bool[Array, "c t"],
) -> tuple[Array, ...]:
    """Returns the fields of `Steps`, predicted from the `estimated` postures."""

    def one(poses, estimated, trans, shape, present):
        frame = so3.exp(poses[:, 0])
        found: Prediction = predict(
            model,
            body,
            so3.exp(estimated[:, 0]),
            estimated[:, 1:],
            shape,
            present,
        )
        before = jnp.concatenate([frame[:1], frame[:-1]])
        step = jnp.concatenate(
            [jnp.zeros((1, 3), trans.dtype), jnp.diff(trans, axis=0)]
        )
        true = jnp.einsum("tba,tb->ta", before, step)
        previous = jnp.concatenate([jnp.zeros((1, 3), trans.dtype), true[:-1]])
        posture = so3.between(found.body_pose, poses[:, 1:])
        angle = jnp.sqrt((posture**2).sum(-1) + 1e-12).mean(-1)
        turn = so3.inverse(before) @ frame
        root = so3.log(so3.inverse(so3.exp(found.rotation)) @ turn)
        gap = local_joints(body, found.body_pose, shape) - local_joints(
            body, poses[:, 1:], shape
        )
        return (
            found.translation,
            true,
            previous,
            found.covariance,
            before,
            angle,
            jnp.sqrt((root**2).sum(-1)),
            jnp.sqrt((gap**2).sum(-1)).mean(-1),
            found.valid,
        )

    return jax.vmap(one)(poses, estimated, trans, shape, present)


class Steps(NamedTuple):
    """All valid predictions of a data set, `n` steps in `c` sequences padded to `t`."""

    predicted: Float[np.ndarray, "c t 3"]
    """Displacement in H_{k-1}, m."""
    true: Float[np.ndarray, "c t 3"]
    """True displacement, from the capture, in H_{k-1}, m."""
    previous: Float[np.ndarray, "c t 3"]
    """True displacement of the previous step, in H_{k-2}, m: the prediction of constant
    velocity."""
    covariance: Float[np.ndarray, "c t 3 3"]
    """Covariance of `predicted`, m²."""
    frame: Float[np.ndarray, "c t 3 3"]
    """True C_{W H_{k-1}}."""
    angle: Float[np.ndarray, "c t"]
    """Angular error of the predicted posture, mean over joints, rad."""
    root_angle: Float[np.ndarray, "c t"]
    """Error of the predicted root rotation, rad."""
    place: Float[np.ndarray, "c t"]
    """Position error of the predicted posture, mean over joints, m."""
    valid: Bool[np.ndarray, "c t"]


def run_trials(
    model: MotionModel,
    body: BodyModel,
    trials: Sequence[Trial],
    drift_deg: float,
    *,
    seed: int = 0,
) -> Steps:
    """Predicts all trials from postures with errors of a given size.

    `drift_deg` is the standard deviation of slow errors per joint axis (1.5 times that
    at hands and feet); if it is positive, white noise is added. The root's orientation
    has no errors.
    """
    length = max(len(trial.trans) for trial in trials)
    length = -(-length // 64) * 64
    poses = np.zeros((len(trials), length, 24, 3), np.float32)
    trans = np.zeros((len(trials), length, 3), np.float32)
    present = np.zeros((len(trials), length), bool)
    for i, trial in enumerate(trials):
        t = len(trial.trans)
        poses[i, :t], trans[i, :t], present[i, :t] = trial.clip.poses, trial.trans, True
        poses[i, t:], trans[i, t:] = poses[i, t - 1], trans[i, t - 1]
    shape = np.stack([trial.shape for trial in trials]).astype(np.float32)
    estimated = poses
    if drift_deg > 0:
        estimated = np.asarray(
            disturbed(
                jnp.asarray(poses),
                jax.random.split(jax.random.key(seed), len(trials)),
                jnp.deg2rad(jnp.float32(drift_deg)),
                jnp.float32(0.0),
            )
        )
    chunk = 16
    model, body = in_dtype(model, jnp.float32), in_dtype(body, jnp.float32)
    parts = []
    for i in range(0, len(trials), chunk):
        rows = np.arange(i, i + chunk).clip(max=len(trials) - 1)
        out = _steps(
            model,
            body,
            *(jnp.asarray(x[rows]) for x in (poses, estimated, trans, shape, present)),
        )
        keep = min(chunk, len(trials) - i)
        parts.append([np.asarray(x)[:keep] for x in out])
    return Steps(*(np.concatenate(x) for x in zip(*parts, strict=True)))


@jax.jit
def disturbed(poses, keys, sigma, root):
    """Adds errors to postures of clips: slow ones of `sigma` (rad) and white noise;
    those of the root are scaled by `root`."""
    white = jnp.deg2rad(jnp.float32(_WHITE_DEG))
    noise = jax.vmap(drift, (0, None, None, None))(keys, poses.shape[1], sigma, white)
    return disturb(poses, noise.at[:, :, 0].multiply(root))


def evaluate_model(
    model: MotionModel,
    body: BodyModel,
    dataset: Sequence[Clip],
    drift_deg: float = 0.0,
    *,
    seeds: int = 3,
    skip: int = 0,
    constant: Float[np.ndarray, " 3"] | None = None,
) -> dict[str, dict[str, float]]:
    """Evaluates a model on clips, per motion class and over `all`, and the baselines.

    Clips may have any rate; of interleaved phases only the first is used. Noise is
    drawn `seeds` times. `skip` excludes the first frames of every clip, so that models
    with windows of different lengths are compared on the same steps. Keys of the result
    are `all` and every class, then `constant velocity` (which, unlike the model, is
    given the previous displacement) over all clips, and `constant`, if given: a
    displacement in H_{k-1} (m) that is predicted for every step.

    **Raises:** `InputError` if no clip is long enough for a prediction.
    """
    clips = [clip for clip in dataset if clip.phase == 0]
    clips = resample(clips, FPS)
    trials = place(body, clips)
    draws = range(seeds if drift_deg > 0 else 1)
    runs = [run_trials(model, body, trials, drift_deg, seed=i) for i in draws]
    steps = Steps(*(np.concatenate(x) for x in zip(*runs, strict=True)))
    valid = steps.valid.copy()
    valid[:, : max(skip, 2)] = False
    steps = steps._replace(valid=valid)
    if not valid.any():
        raise InputError(
            f"no usable sequence among {len(clips)}: a prediction needs "
            f"{model.past + 1} frames at {FPS:g} frames per second."
        )
    kinds = np.array([trial.clip.motion for trial in trials] * len(draws))
    select = lambda rows: Steps(*(x[rows] for x in steps))
    out = {"all": summary(steps)}
    for kind in sorted(set(kinds)):
        if steps.valid[kinds == kind].any():
            out[str(kind)] = summary(select(kinds == kind))
    out["constant velocity"] = summary(steps, steps.previous)
    if constant is not None:
        always = np.broadcast_to(constant, steps.true.shape)
        out["constant"] = summary(steps, always)
    return out


def baseline_mean(dataset: Sequence[Clip]) -> Float[np.ndarray, " 3"]:
    """Returns the mean displacement of training clips in H_{k-1}, m per frame at 30
    fps."""
    moves = []
    for clip in resample([clip for clip in dataset if clip.phase == 0], FPS):
        turn = np.asarray(so3.exp(jnp.asarray(clip.poses[:-1, 0])))
        moves.append(np.einsum("tba,tb->ta", turn, np.diff(clip.trans, axis=0)))
    return np.concatenate(moves).mean(0)


def slope(
    predicted: Float[np.ndarray, "*n 3"], true: Float[np.ndarray, "*n 3"]
) -> float:
    """Returns the projection of predicted on true displacement."""
    return float((predicted * true).sum() / max(float((true * true).sum()), 1e-12))


def summary(
    steps: Steps, predicted: Float[np.ndarray, "c t 3"] | None = None
) -> dict[str, float]:
    """Computes the measures of displacements; for baselines, `predicted` (m) replaces
    those of the model."""
    valid = steps.valid
    guess = steps.predicted if predicted is None else predicted
    error = np.linalg.norm(guess - steps.true, axis=-1)[valid]
    size = np.linalg.norm(steps.true, axis=-1)[valid]
    per_sequence = np.array(
        [
            slope(g[v], d[v])
            for g, d, v in zip(guess, steps.true, valid, strict=True)
            if v.any() and np.linalg.norm(d[v], axis=-1).mean() > 0.01
        ]
    )
    long_guess, long_true = _longer(guess, steps), _longer(steps.true, steps)
    out = {
        "steps": float(valid.sum()),
        "error_mm": 1e3 * float(error.mean()),
        "step_mm": 1e3 * float(size.mean()),
        "ratio": float(error.mean() / size.mean()),
        "slope": slope(guess[valid], steps.true[valid]),
        "slope_30": slope(long_guess, long_true) if len(long_true) else float("nan"),
        "spread": float(per_sequence.std()) if len(per_sequence) else float("nan"),
    }
    if predicted is None:
        residual = (steps.predicted - steps.true)[valid].astype(float)
        covariance = steps.covariance[valid].astype(float)
        nees = (
            residual * np.linalg.solve(covariance, residual[..., None])[..., 0]
        ).sum(-1)
        out |= {
            "nees": float(nees.mean() / 3),
            "coverage_95": float((nees < _CHI2_95).mean()),
            "posture_deg": float(np.rad2deg(steps.angle[valid].mean())),
            "root_deg": float(np.rad2deg(steps.root_angle[valid].mean())),
            "posture_mm": 1e3 * float(steps.place[valid].mean()),
        }
        out |= error_correlation(steps)
    return out


def error_correlation(steps: Steps) -> dict[str, float]:
    """Returns the correlation of errors in H_{k-1} at each of `LAGS_FRAMES`, as
    `corr_<lag>`.

    No mean is subtracted: a constant error counts as much as a varying one.
    """
    error = np.where(steps.valid[..., None], steps.predicted - steps.true, 0.0)
    found = {}
    for lag in LAGS_FRAMES:
        a, b = error[:, :-lag], error[:, lag:]
        both = steps.valid[:, :-lag] & steps.valid[:, lag:]
        a, b = a[both], b[both]
        size = np.sqrt(float((a * a).sum()) * float((b * b).sum()))
        found[f"corr_{lag}"] = float((a * b).sum()) / size if size > 0 else np.nan
    return found


def _longer(
    moves: Float[np.ndarray, "c t 3"], steps: Steps
) -> Float[np.ndarray, "n 3"]:
    """Returns the displacements over `SLOPE_FRAMES` frames in the world where all steps
    are valid."""
    world = np.einsum("ctab,ctb->cta", steps.frame, moves)
    sums = np.lib.stride_tricks.sliding_window_view(world, SLOPE_FRAMES, 1).sum(-1)
    whole = np.lib.stride_tricks.sliding_window_view(steps.valid, SLOPE_FRAMES, 1).all(
        -1
    )
    return sums[whole]


def validated(
    model: MotionModel, body: BodyModel, trials: Sequence[Trial]
) -> Float[np.ndarray, " 6"]:
    """Returns the mean error over the mean step length at each of `DRIFTS_DEG`, then
    the slope (projection of predicted on true displacement) at each."""
    runs = [summary(run_trials(model, body, trials, d)) for d in DRIFTS_DEG]
    return np.array([run[k] for k in ("ratio", "slope") for run in runs])


def named(row: Float[np.ndarray, " 6"]) -> dict[str, float]:
    """Names the values that `validated` returns."""
    names = [f"{what} at {d:g}°" for what in ("ratio", "slope") for d in DRIFTS_DEG]
    return dict(zip(names, map(float, row), strict=True))


def kept(history: Float[np.ndarray, "e 7"], drift_deg: float) -> int | None:
    """Returns the epoch, from 0, whose weights were kept; `None` without validation."""
    scores = np.array([score(row, drift_deg) for row in history[:, 1:]])
    return None if np.isnan(scores).all() else int(np.nanargmin(scores))


def score(row: Float[np.ndarray, " 6"], drift_deg: float) -> float:
    """Returns the validation score, lower for better models, from errors relative to
    their targets and from slopes, at the drifts used in training."""
    trained = np.array(DRIFTS_DEG) <= drift_deg
    errors, bias = row[:3] / TARGET_RATIOS, np.abs(row[3:] - 1)
    return float(np.mean(errors[trained]) + 5 * np.mean(bias[trained]))


def calibrated(
    model: MotionModel, body: BodyModel, trials: Sequence[Trial]
) -> MotionModel:
    """Scales the predicted covariance so that the mean squared whitened error per axis
    (NEES / 3) is 1 over `trials` at all `DRIFTS_DEG`. The factor on standard deviations
    is the entry `covariance_factor` of `about`.

    The paper's network predicts no covariance; that of its errors is used as a
    constant.
    """
    runs = [run_trials(model, body, trials, d) for d in DRIFTS_DEG]
    error = np.concatenate([(r.predicted - r.true)[r.valid] for r in runs]).astype(
        float
    )
    if isinstance(model.network, PaperNetwork):
        spread = np.linalg.cholesky(error.T @ error / len(error) + 1e-10 * np.eye(3))
        new = jnp.asarray(spread, jnp.float32)
        return eqx.tree_at(lambda m: m.network.spread, model, new)
    if not isinstance(model.network, MetricNetwork | FunctionNetwork):
        return model
    covariance = np.concatenate([r.covariance[r.valid] for r in runs]).astype(float)
    nees = (error * np.linalg.solve(covariance, error[..., None])[..., 0]).sum(-1) / 3
    factor = float(np.sqrt(nees.mean()))
    about = json.loads(model.about) | {"covariance_factor": factor}
    return dataclasses.replace(widened(model, factor), about=json.dumps(about))


def widened(model: MotionModel, factor: float) -> MotionModel:
    """Returns the model with its standard deviations multiplied by a factor."""
    if isinstance(model.network, FunctionNetwork):
        spread = model.network.spread * factor
        return eqx.tree_at(lambda m: m.network.spread, model, spread)
    bias = lambda m: [layers[-1].bias for layers in m.network.spreads]
    shift = jnp.asarray([np.log(factor)] * 3 + [0.0] * 3, jnp.float32)
    return eqx.tree_at(bias, model, [b + shift for b in bias(model)])
