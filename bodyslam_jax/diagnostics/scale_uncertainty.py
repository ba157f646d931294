"""Uncertainty of the scale, and so of every length in metres.

Three contributions, in this order:

1. the marginal covariance of the joint problem (`solver.marginals`);
2. where bodies were fitted to keypoints, the part of the shape's variance that the
   tightened shape prior hides (`inflate_fitted_shapes`);
3. where two cues of scale contradict each other, half of their difference
   (`reported_sigma`).
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from bodyslam_jax.body import BodyModel
from bodyslam_jax.motion import leg_length
from bodyslam_jax.types import ScaleStart

_MIN_CONTRADICTION_FACTOR = 1.25
"""Factor between the scales of two cues below which they are considered to agree."""


def covariance_sigma(variance: float, *, moving: bool, metric: bool) -> float:
    """Returns the standard deviation of the scale by the joint problem, m per unit of
    the map.

    Infinite where neither people's steps and feet nor a metric camera path determine
    metres (`metric` is false): the scale is held at 1 then, or what smooth motion makes
    of it, and its variance means nothing. NaN where the variance was not computed, or
    the camera does not move.
    """
    if np.isnan(variance) or not moving:
        return np.nan
    return variance**0.5 if metric else np.inf


def inflate_fitted_shapes(
    scale_variance: Float[Array, ""],
    shape_covariance: Float[Array, "h 10 10"],
    scale: Float[Array, ""],
    shapes: Float[Array, "h 10"],
    body: BodyModel,
    shape_sigma: Float[np.ndarray, " h"],
    present: Bool[np.ndarray, " h"],
) -> tuple[Float[Array, ""], Float[Array, "h 10 10"]]:
    """Returns the variances of scale and shapes, re-inflated where bodies were fitted
    to keypoints.

    Errors of a detector are correlated over time, so that keypoints of many frames
    determine a shape hardly better than those of a few. The graph treats them as
    independent and compensates with a prior of `shape_sigma` below 1 on β. That gives
    the right estimates, but variances that are too small by the same weight
    w = `shape_sigma`⁻²: the variance of the estimate is Σ (Σ⁻¹ - w + w²) Σ. The excess
    carries over to the scale through the length of the legs, to which predicted
    displacements are proportional.

    Args:
        shape_sigma: of the prior on β of each person; 1 where nothing is to be done.
        present: people who are in any frame. The scale follows the mean of their leg
            lengths, whose errors are independent.
    """
    weight = np.maximum(shape_sigma**-2.0, 1.0)
    more = jnp.asarray(weight * (weight - 1))
    extra = more[:, None, None] * (shape_covariance @ shape_covariance)
    legs = leg_variance(body, shapes, extra)
    variance = (
        scale_variance + scale**2 * jnp.sum(legs[present]) / float(present.sum()) ** 2
    )
    return variance, shape_covariance + extra


def leg_variance(
    body: BodyModel,
    shapes: Float[Array, "h 10"],
    covariance: Float[Array, "h 10 10"],
) -> Float[Array, " h"]:
    """Returns the relative variance of each person's leg length, by the covariance of
    β."""
    slope = jax.vmap(jax.grad(lambda shape: jnp.log(leg_length(body, shape))))(shapes)
    return jnp.einsum("hi,hij,hj->h", slope, covariance, slope)


def cue_discrepancy(start: ScaleStart) -> float:
    """Returns the absolute logarithm of the ratio of two scales: by people's motion,
    and by the ground.

    It is 0 where they agree within their errors, or one is missing.
    """
    sigma = np.hypot(
        start.motion_error / start.motion, start.ground_error / start.ground
    )
    ratio = abs(np.log(start.motion / start.ground))
    # A missing cue has an infinite error.
    if not np.isfinite(sigma) or np.exp(ratio) < max(
        _MIN_CONTRADICTION_FACTOR, 1 + 2 * sigma
    ):
        return 0.0
    return float(ratio)


def reported_sigma(scale: float, sigma: float, start: ScaleStart) -> float:
    """Returns the standard deviation of the scale that is reported, m per unit of the
    map.

    `sigma` is that of the covariance; NaN, where it was not computed, stays NaN. Where
    two cues contradict each other, half their difference is a lower bound: the standard
    error of two measurements with unknown errors of their own (DerSimonian and Laird,
    1986), in the limit of errors much larger than those stated.
    """
    return float(np.maximum(abs(sigma), cue_discrepancy(start) / 2 * abs(scale)))


def discrepancy_warning(start: ScaleStart) -> list[str]:
    """Returns a warning if people's motion and the ground contradict each other, else
    an empty list."""
    discrepancy = cue_discrepancy(start)
    if not discrepancy:
        return []
    ratio = start.motion / start.ground
    return [
        f"people's motion makes the map {ratio:.2f} times as large as the ground under "
        "their feet does: postures, focal length or ground are off. See in the overlay "
        "whether bodies fit the people, and in the scene whether soles are on the "
        "floor; --focal or --bodies mend the first. "
        f"Sizes are therefore known to no better than {50 * discrepancy:.0f} %."
    ]
