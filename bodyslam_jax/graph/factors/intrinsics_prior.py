"""Intrinsics with a known accuracy, and one focal length for rows and columns.

Both factors are used where intrinsics are estimated; `σ` in px is set by
`pipeline/sfm_stage.py`. Ours: the paper's intrinsics are known.
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


class AspectRatioPrior(AbstractIntrinsicsFactor):
    """One focal length for rows and columns.

        r = (fx - a fy) / σ

    Used where intrinsics are estimated, with `σ` in px set by `pipeline/sfm_stage.py`.
    Ours.
    """

    sigma: Float[Array, " 1"]
    """px"""
    loss: Loss = Squared()
    ratio: float = eqx.field(static=True, default=1.0)
    """a, the height of a pixel over its width: 1 for square pixels."""

    def data(self):
        return self.sigma

    def frame_residual(self, data, window, shared):
        return (shared.intrinsics[:1] - self.ratio * shared.intrinsics[1:2]) / data
