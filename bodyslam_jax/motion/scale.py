"""Scale of a monocular trajectory by regression on the predicted displacements."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float

from bodyslam_jax.motion.prediction import Prediction

_MODEL_BIAS_SIGMA = 0.03
"""Standard deviation of the model's bias between sequences, relative to displacement.
The bias does not average out within a sequence. From validation subjects at 5° drift.
"""

_DURATIONS_FRAMES = (1, 5, 15, 30, 60)
"""Durations over which displacements are compared, frames at the sequence's rate; sums
reduce the noise of depth."""


class Scale(NamedTuple):
    """Metres per unit of a trajectory, with its standard error."""

    value: float
    """Scale, m per unit; NaN without enough displacement."""
    standard_error: float
    """Standard error of `value`, from the disagreement between parts of the sequence
    and the model's bias of a few per cent per sequence; inf with a single part."""


def scale_from_motion(
    prediction: Prediction,
    orientation: Float[Array | np.ndarray, "t 3 3"],
    camera: Float[Array | np.ndarray, "t 3"],
    offset: Float[Array | np.ndarray, "t 3"],
) -> Scale:
    """Estimates the scale `s` at which people move as predicted, by linear regression.

    `orientation` is `C_WH`; `camera` the unscaled camera centre `r'_WC`; `offset` the
    pelvis joint relative to the camera, `C_WC r_CH`, in metres. Over every window of
    frames a to b, `s (r'_b - r'_a) + (offset_b - offset_a)` should equal the sum of
    predicted displacements rotated into the world, which is linear in `s`. The
    equations are solved with Cauchy weights for windows of 1 to 60 frames; the value is
    the median over durations of 5 frames and more, where depth noise has less
    influence.
    """
    turn, r_C, r_CH = (np.asarray(x, float) for x in (orientation, camera, offset))
    valid = np.asarray(prediction.valid)
    before = np.concatenate([turn[:1], turn[:-1]])
    step = np.einsum("tab,tb->ta", before, np.asarray(prediction.translation, float))
    step = np.where(valid[:, None], step, 0.0)
    walked = np.cumsum(step, 0)
    gaps = np.cumsum(~valid)
    found, errors, ratio = {}, {}, {}
    for n in _DURATIONS_FRAMES:
        if len(r_C) <= n:
            continue
        whole = gaps[n:] == gaps[:-n]
        x = (r_C[n:] - r_C[:-n])[whole]
        y = (walked[n:] - walked[:-n] - (r_CH[n:] - r_CH[:-n]))[whole]
        if len(x) < 3 or (x * x).sum() < 1e-12:
            continue
        found[n], errors[n] = _robust_ratio(x, y, n)
        moved = (walked[n:] - walked[:-n])[whole]
        ratio[n] = np.sqrt((moved * moved).sum() / (x * x).sum())
    if not found:
        return Scale(float("nan"), float("inf"))
    # Noise of depth has less influence on longer windows.
    chosen = [n for n in found if n >= 5] or list(found)
    value = float(np.median([found[n] for n in chosen]))
    # a short sequence has too few long windows for a standard error
    sure = [n for n in chosen if np.isfinite(errors[n])] or chosen
    best = min(sure, key=lambda n: abs(found[n] - value))
    apart = np.std([found[n] for n in chosen])
    parts = (errors[best], apart, _MODEL_BIAS_SIGMA * ratio[best])
    return Scale(value, float(np.linalg.norm(parts)))


def _robust_ratio(
    x: Float[np.ndarray, "m 3"], y: Float[np.ndarray, "m 3"], duration: int
) -> tuple[float, float]:
    """Returns `argmin_s Σ ρ(|s x - y|)` and its standard error.

    The error is that of a jackknife over blocks: blocks of at least a second are nearly
    independent, single frames are not.
    """

    def solve(x, y):
        weight = np.ones(len(x))
        s = 1.0
        for _ in range(20):
            s = (weight * (x * y).sum(-1)).sum() / max(
                (weight * (x * x).sum(-1)).sum(), 1e-12
            )
            residual = np.linalg.norm(s * x - y, axis=-1)
            width = 1.5 * np.median(residual) + 1e-6
            weight = 1 / (1 + (residual / width) ** 2)
        return float(s)

    # One second at 30 frames per second: errors that far apart correlate by 0.1 to
    # 0.25 (model card).
    blocks = len(x) // max(30, duration)
    if blocks < 2:
        return solve(x, y), float("inf")
    label = np.arange(len(x)) * blocks // len(x)
    left_out = [solve(x[label != b], y[label != b]) for b in range(blocks)]
    spread = np.sqrt((blocks - 1) * np.var(left_out))
    return solve(x, y), float(spread)
