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


class Stature(FrameFactor):
    """A known height of a person.

        r = (h_0 + g · β - h̃) / σ

    In m. The height of the mesh at rest, between the vertices that are highest and
    lowest in the mean shape, is linear in β (`people/stature.py`). `h̃` and `σ` are
    what the user states (`--height`). The shape prior is centred on a shape of that
    stature (`people.with_statures`): far from the mean it would pull away from the
    fact. Ours.
    """

    template: Float[Array, ""]
    """h_0, m"""
    slope: Float[Array, " 10"]
    """g, m"""
    height: Float[Array, "h t"]
    """h̃, m"""
    sigma: Float[Array, "h t"]
    """m; finite in one frame of each person who was measured, `inf` elsewhere."""
    loss: Loss = Squared()
    keys = (("shape", 0),)
    padding = {"sigma": jnp.inf}

    def frame_residual(self, data, window, shared):
        height, sigma = data
        return (self.template + jnp.dot(self.slope, shared.shape) - height)[
            None
        ] / sigma
