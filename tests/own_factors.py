"""Factors as a user may write them, with couplings that no built-in factor has."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

import bodyslam_jax.graph as g
from bodyslam_jax.body import BodyModel, local_keypoints
from bodyslam_jax.geometry.so3 import log


class CameraSmoothness(g.FrameFactor):
    """The camera keeps its velocity: a factor of three cameras."""

    sigma: Float[Array, "t 2"]
    """Per frame squared: rad, units of the map; `inf` for the first two frames."""
    loss: g.Loss = g.Squared()
    padding = {"sigma": jnp.inf}
    keys = (("camera", 0), ("camera", 1), ("camera", 2))

    def data(self):
        return self.sigma

    def frame_residual(self, data, window, shared):
        now, before, first = (f.camera for f in window)
        turn = log(before[:3, :3].T @ now[:3, :3])
        turn = turn - log(first[:3, :3].T @ before[:3, :3])
        shift = now[:3, 3] - 2 * before[:3, 3] + first[:3, 3]
        return jnp.concatenate([turn / data[0], shift / data[1]])


class StillFeet(g.FrameFactor):
    """Points of the feet do not move in the world: two cameras, roots and postures."""

    body: BodyModel
    sigma: Float[Array, "h t 4"]
    """m per frame; `inf` in the first frame."""
    loss: g.Loss = g.Squared()
    points: tuple[int, ...] = eqx.field(static=True, default=(19, 21, 22, 24))
    padding = {"sigma": jnp.inf}
    keys = (
        *((name, lag) for name in ("camera", "root", "pose") for lag in range(2)),
        ("scale", 0),
        ("shape", 0),
    )

    def data(self):
        return self.sigma

    def frame_residual(self, data, window, shared):
        now, before = (self._feet(frame, shared) for frame in window)
        return (now - before) / data[:, None]

    def _feet(self, frame, shared):
        p_H = local_keypoints(self.body, frame.pose, shared.shape, "body25")
        p_C = p_H[jnp.array(self.points)] @ frame.root[:3, :3].T + frame.root[:3, 3]
        return p_C @ frame.camera[:3, :3].T + shared.scale * frame.camera[:3, 3]
