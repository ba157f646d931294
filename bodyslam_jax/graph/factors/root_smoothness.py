"""The pelvis keeps its velocity in the world.

    r = (r_WH,k - 2 r_WH,k-1 + r_WH,k-2) / (L σ),    r_WH = s r'_WC + C_WC r_CH

In m per frame squared, or with a `body` in leg lengths `L(β)`, as `HumanMotion`.
Default: `weights.root_smoothness` = 0.02 m at 30 fps. Real pelvises accelerate by 0.006
m per frame squared, but with that value a camera that follows the person would be
estimated to move less, and the world to be smaller. Ours.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.body import BodyModel
from bodyslam_jax.graph.factor import FrameFactor, Key
from bodyslam_jax.graph.factors.human_motion import unit_length
from bodyslam_jax.graph.losses import Loss, Squared


class RootSmoothness(FrameFactor):
    """`r = (r_k - 2 r_{k-1} + r_{k-2}) / (L σ)` of `r = r_WH`."""

    sigma: Float[Array, "h t"]
    """m, or leg lengths, per frame squared; `inf` where one of the three frames is
    missing."""
    loss: Loss = Squared()
    body: BodyModel | None = None
    padding = {"sigma": jnp.inf}

    @property
    def keys(self) -> tuple[Key, ...]:
        return (
            *(("camera", lag) for lag in range(3)),
            *(("root", lag) for lag in range(3)),
            ("scale", 0),
            *((("shape", 0),) if self.body is not None else ()),
        )

    def frame_residual(self, data, window, shared):
        (sigma,) = data
        now, before, first = (
            shared.scale * f.camera[:3, 3] + f.camera[:3, :3] @ f.root[:3, 3]
            for f in window
        )
        return (now - 2 * before + first) / unit_length(self.body, shared) / sigma
