"""Factors that are absent unless a weight switches them on."""

import math

import jax.numpy as jnp

from bodyslam_jax import graph, motion
from bodyslam_jax.config import GraphWeights


def optional_factors(
    prediction: motion.Prediction, fps: float, weights: GraphWeights
) -> list[graph.Factor]:
    """The predicted change of orientation, if `orientation_sigma` is finite."""
    sigma = weights.orientation_sigma
    if sigma is None or not math.isfinite(sigma):
        return []
    valid = prediction.valid
    rotation = jnp.where(valid[..., None], prediction.rotation, 0.0)
    per_frame = jnp.where(valid, sigma * 30.0 / fps, jnp.inf)
    return [graph.RelativeOrientation(rotation=rotation, sigma=per_frame)]
