"""A standing person's trunk points along a known up direction.

    r = (C_WC C_CH e_y - u) / σ

`e_y` is the y axis of the root frame; the length of the difference is the angle by
which the trunk leans, in rad, while that is small. In no problem by default;
0.1 rad at 30 fps suits people who walk (their pelvises sway by 0.05 rad). Ours.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.graph.factor import FrameFactor
from bodyslam_jax.graph.losses import Loss, Squared


class UprightPrior(FrameFactor):
    """`r = (C_WC C_CH e_y - u) / σ`."""

    up: Float[Array, " 3"]
    """u, a unit vector in the world."""
    sigma: Float[Array, "h t"]
    """rad; `inf` where the person is absent."""
    loss: Loss = Squared()
    padding = {"sigma": jnp.inf}
    keys = (("camera", 0), ("root", 0))

    def frame_residual(self, data, window, shared):
        (sigma,), (frame,) = data, window
        trunk = frame.camera[:3, :3] @ frame.root[:3, 1]
        return (trunk - self.up) / sigma
