"""A known size of the map.

    r = (s - s̃) / σ

Used where a camera path in metres is given: `s̃` is metres per unit of the map, default
`σ = config.PATH_SIGMA s̃`, 1 %. Ours.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.graph.factor import FrameFactor
from bodyslam_jax.graph.losses import Loss, Squared


class ScalePrior(FrameFactor):
    """`r = (s - s̃) / σ`."""

    scale: Float[Array, " t"]
    """s̃, m per unit of the map."""
    sigma: Float[Array, " t"]
    """m per unit of the map; finite in one frame, `inf` in all others."""
    loss: Loss = Squared()
    padding = {"sigma": jnp.inf}
    map_units = {"scale": -1, "sigma": -1}
    keys = (("scale", 0),)

    def frame_residual(self, data, window, shared):
        measured, sigma = data
        return (shared.scale - measured)[None] / sigma
