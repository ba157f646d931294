"""Selects weights and calibrates covariances on validation subjects."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from bodyslam_jax.body import BodyModel
from bodyslam_jax.motion.capture.retarget import Trial
from bodyslam_jax.motion.own_model import FunctionNetwork
from bodyslam_jax.motion.paper_network import PaperNetwork
from bodyslam_jax.motion.position_network import MetricNetwork
from bodyslam_jax.motion.prediction import MotionModel
from bodyslam_jax.motion.training.evaluation import run_trials, summary

DRIFTS_DEG = (0.0, 5.0, 9.0)
"""Standard deviations of slow joint-angle errors at which a model is evaluated,
degrees."""

TARGET_RATIOS = (0.10, 0.13, 0.18)
"""Target ratio of error to displacement at each drift."""


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
    (NEES / 3) is 1 over `trials` at all `DRIFTS_DEG`.

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
    if isinstance(model.network, FunctionNetwork):
        spread = model.network.spread * float(np.sqrt(nees.mean()))
        return eqx.tree_at(lambda m: m.network.spread, model, spread)
    factor = 0.5 * np.log(nees.mean())
    bias = lambda m: [layers[-1].bias for layers in m.network.spreads]
    shift = jnp.asarray([factor] * 3 + [0.0] * 3, jnp.float32)
    return eqx.tree_at(bias, model, [b + shift for b in bias(model)])
