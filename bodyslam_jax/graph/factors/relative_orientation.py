"""The turn of the person that the motion model predicts.

    r = Log(C̃_k^T C_WH,k-1^T C_WH,k) / σ

In rad. In no problem by default: the paper's motion model predicts the turn, but the
paper's cost does not use it. Ours.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.geometry import so3
from bodyslam_jax.graph.factor import FrameFactor
from bodyslam_jax.graph.losses import Loss, Squared


class RelativeOrientation(FrameFactor):
    """`r = Log(C̃^T C_WH,k-1^T C_WH,k) / σ`."""

    rotation: Float[Array, "h t 3"]
    """Log C̃: rotation vector from H_{k-1} to H_k, rad."""
    sigma: Float[Array, "h t"]
    """Per axis, rad; `inf` where not predicted."""
    loss: Loss = Squared()
    padding = {"sigma": jnp.inf}
    keys = (("camera", 0), ("camera", 1), ("root", 0), ("root", 1))

    def frame_residual(self, data, window, shared):
        rotation, sigma = data
        now, before = (f.camera[:3, :3] @ f.root[:3, :3] for f in window)
        predicted = so3.exp(rotation)
        return so3.log(predicted.T @ before.T @ now) / sigma
