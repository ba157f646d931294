"""A regressed body shape (e_shape, section 3.6 of the paper).

    r = (β - β̃) / σ

Dimensionless. A regressor makes the same error in all frames of a video, so there is
one measurement for each person. Default: `weights.shape_sigma` = 0.4. The paper has one
in each frame with `λ_shape = 1`: `weights.shape_each_frame`.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.graph.factor import FrameFactor
from bodyslam_jax.graph.losses import Loss, Squared


class ShapePrior(FrameFactor):
    """`r = (β - β̃) / σ`, ten rows for each frame with a measurement."""

    shape: Float[Array, "h t 10"]
    """β̃"""
    sigma: Float[Array, "h t 10"]
    """`inf` where not measured."""
    loss: Loss = Squared()
    keys = (("shape", 0),)
    padding = {"sigma": jnp.inf}

    def frame_residual(self, data, window, shared):
        shape, sigma = data
        return (shared.shape - shape) / sigma
