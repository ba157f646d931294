"""A calibration with a known accuracy.

    r = (i - ĩ) / σ,    i = (fx, fy, cx, cy[, k1, k2, p1, p2])

In px, and dimensionless for distortion. Used where intrinsics are estimated; `σ` is
that of the calibration or of the guess that stands for one (`pipeline/sfm_stage.py`).
Ours: the paper's intrinsics are known.
"""

import equinox as eqx
from jaxtyping import Array, Float

from bodyslam_jax.graph.factor import FrameFactor
from bodyslam_jax.graph.losses import Loss, Squared


class AbstractIntrinsicsFactor(FrameFactor):
    """A factor of the intrinsics alone: one row for the whole video."""

    padding = {}  # its one row is no frame
    keys = (("intrinsics", 0),)

    def map_frames(self, function, state, extra=None):
        first = eqx.tree_at(lambda s: s.cameras, state, state.cameras[:1])
        return super().map_frames(function, first, extra)


class IntrinsicsPrior(AbstractIntrinsicsFactor):
    """`r = (i - ĩ) / σ`."""

    intrinsics: Float[Array, "1 i"]
    sigma: Float[Array, "1 i"]
    """px, and 1 for distortion; `inf` where unknown."""
    loss: Loss = Squared()

    def data(self):
        return self.intrinsics, self.sigma

    def frame_residual(self, data, window, shared):
        measured, sigma = data
        return (shared.intrinsics - measured) / sigma
