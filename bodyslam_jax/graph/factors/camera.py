"""Priors of the camera, and error terms of it beyond the paper."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.geometry.so3 import log
from bodyslam_jax.graph.factor import FrameFactor, Key
from bodyslam_jax.graph.losses import Loss, Squared


class CameraPrior(FrameFactor):
    """A camera known beforehand: `[Log(C̃^T C), r' - r̃'] / σ`."""

    cameras: Float[Array, "t 4 4"]
    """T̃'_WC"""
    sigma: Float[Array, "t 6"]
    """rad, then units of the map; `inf` where not known."""
    loss: Loss = Squared()
    of_people = False
    time_fields = ("cameras", "sigma")
    padding = {"sigma": jnp.inf}

    @property
    def keys(self) -> tuple[Key, ...]:
        return (("camera", 0),)

    def data(self):
        return self.cameras, self.sigma

    def frame_residual(self, data, window, shared):
        known, sigma = data
        camera = window[0].camera
        turn = log(known[:3, :3].T @ camera[:3, :3])
        return jnp.concatenate([turn, camera[:3, 3] - known[:3, 3]]) / sigma


class ScalePrior(FrameFactor):
    """A known size of the map, `(s - s̃) / σ`: of a camera path that is in metres."""

    scale: Float[Array, " t"]
    """s̃, m per unit of the map."""
    sigma: Float[Array, " t"]
    """m per unit of the map; finite in one frame, `inf` in all others."""
    loss: Loss = Squared()
    of_people = False
    time_fields = ("scale", "sigma")
    padding = {"sigma": jnp.inf}

    @property
    def keys(self) -> tuple[Key, ...]:
        return (("scale", 0),)

    def data(self):
        return self.scale, self.sigma

    def frame_residual(self, data, window, shared):
        known, sigma = data
        return (shared.scale - known)[None] / sigma


class AbstractIntrinsicsFactor(FrameFactor):
    """A factor of the intrinsics alone: one for the whole video."""

    of_people = False
    time_fields = ()
    padding = {}  # its one row is no frame

    @property
    def keys(self) -> tuple[Key, ...]:
        return (("intrinsics", 0),)

    def map_frames(self, function, state, extra=None):
        first = eqx.tree_at(lambda s: s.cameras, state, state.cameras[:1])
        return super().map_frames(function, first, extra)


class IntrinsicsPrior(AbstractIntrinsicsFactor):
    """A calibration, as known as it is: `(intrinsics - known) / σ`."""

    intrinsics: Float[Array, "1 i"]
    sigma: Float[Array, "1 i"]
    """px, distortion: 1; `inf` where not known."""
    loss: Loss = Squared()

    def data(self):
        return self.intrinsics, self.sigma

    def frame_residual(self, data, window, shared):
        known, sigma = data
        return (shared.intrinsics - known) / sigma


class AspectRatioPrior(AbstractIntrinsicsFactor):
    """One focal length for rows and columns, `(fx - a fy) / σ`."""

    sigma: Float[Array, " 1"]
    """px"""
    loss: Loss = Squared()
    ratio: float = eqx.field(static=True, default=1.0)
    """a, the height of a pixel over its width: 1 for square pixels."""

    def data(self):
        return self.sigma

    def frame_residual(self, data, window, shared):
        return (shared.intrinsics[:1] - self.ratio * shared.intrinsics[1:2]) / data
