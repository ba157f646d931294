"""One focal length for rows and columns.

    r = (fx - a fy) / σ

Used where intrinsics are estimated, with `σ` in px set by `pipeline/sfm_stage.py`.
Ours.
"""

import equinox as eqx
from jaxtyping import Array, Float

from bodyslam_jax.graph.factors.intrinsics_prior import AbstractIntrinsicsFactor
from bodyslam_jax.graph.losses import Loss, Squared


class AspectRatioPrior(AbstractIntrinsicsFactor):
    """`r = (fx - a fy) / σ`."""

    sigma: Float[Array, " 1"]
    """px"""
    loss: Loss = Squared()
    ratio: float = eqx.field(static=True, default=1.0)
    """a, the height of a pixel over its width: 1 for square pixels."""

    def data(self):
        return self.sigma

    def frame_residual(self, data, window, shared):
        return (shared.intrinsics[:1] - self.ratio * shared.intrinsics[1:2]) / data
