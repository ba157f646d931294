"""A landmark's position from observations that are not in the problem.

    r = W (l - l̃),    W^T W = Σ^-1

A point that is lost and found again becomes several landmarks, each observed in a short
run of frames, so that the reduced camera matrix stays banded. Each has a prior from the
observations of the others, which is how loop closures constrain the map. `l̃` and `Σ`
come from structure from motion (`sfm/loop_closure.py`), in units of the map, with the
same pixel noise as `Reprojection` (`weights.pixel_sigma`). Ours.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.graph.factor import Factor
from bodyslam_jax.graph.losses import Loss, Squared
from bodyslam_jax.graph.state import State


class LandmarkPrior(Factor):
    """`r = W (l - l̃)`, three rows for each landmark."""

    position: Float[Array, "l 3"]
    """l̃, in units of the map."""
    whitening: Float[Array, "l 3 3"]
    """`W` with `W^T W` the inverse of the covariance; 0 without a prior."""
    loss: Loss = Squared()
    map_units = {"position": 1, "whitening": -1}

    def residual(self, state: State) -> Float[Array, "l 3"]:
        error = state.landmarks - self.position
        return jnp.einsum("lij,lj->li", self.whitening, error)
