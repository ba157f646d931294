"""A regressed body shape (e_shape, section 3.6 of the paper).

    r = (β - β̃) / σ

Dimensionless. A regressor makes the same error in all frames of a video, so there is
one measurement for each person. Default: `weights.shape_sigma` = 0.4. The paper has one
in each frame with `λ_shape = 1`: `weights.shape_each_frame`.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.graph.factor import FrameFactor, Key
from bodyslam_jax.graph.losses import Loss, Squared


class ShapePrior(FrameFactor):
    """`r = (β - β̃) / σ`, ten rows for each frame with a measurement."""

    shape: Float[Array, "h t 10"]
    """β̃"""
    sigma: Float[Array, "h t 10"]
    """`inf` where not measured."""
    loss: Loss = Squared()
    padding = {"sigma": jnp.inf}

    @property
    def keys(self) -> tuple[Key, ...]:
        return (("shape", 0),)

    def data(self):
        return self.shape, self.sigma

    def frame_residual(self, data, window, shared):
        shape, sigma = data
        return (shared.shape - shape) / sigma
