"""Measures of predicted displacements: error, bias, spread, calibration, correlation.

The slope is the projection of predicted on true displacement: it is 1 without bias, and
its relative error is that of a scale estimated with the model.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

SLOPE_FRAMES = 30
"""Duration of the displacements of `slope_30`, frames: one second."""

LAGS_FRAMES = (1, 2, 4, 8, 15, 30)
"""Time lags at which the correlation of errors is measured, frames."""

_CHI2_95 = 7.815
"""95 % quantile of the chi-square distribution with 3 degrees of freedom."""


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
