"""The person keeps the angular velocity in the world.

    r = (Log(C_{k-1}^T C_k) - Log(C_{k-2}^T C_{k-1})) / σ,    C = C_WC C_CH

In rad per frame squared. Default: `weights.root_turning` = 0.015 rad at 30 fps. Ours.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.geometry import so3
from bodyslam_jax.graph.factor import FrameFactor
from bodyslam_jax.graph.losses import Loss, Squared


class AngularAccelerationPrior(FrameFactor):
    """`r = (Log(C_{k-1}^T C_k) - Log(C_{k-2}^T C_{k-1})) / σ` of `C = C_WH`."""

    sigma: Float[Array, "h t"]
    """rad per frame squared; `inf` where one of the three frames is missing."""
    loss: Loss = Squared()
    padding = {"sigma": jnp.inf}
    keys = tuple((name, lag) for name in ("camera", "root") for lag in range(3))

    def frame_residual(self, data, window, shared):
        (sigma,) = data
        now, before, first = (f.camera[:3, :3] @ f.root[:3, :3] for f in window)
        return (so3.log(before.T @ now) - so3.log(first.T @ before)) / sigma
