"""A camera pose that is known beforehand.

    r = [Log(C̃^T C'_WC), r'_WC - r̃'] / σ

Dimensionless: a rotation vector over rad, then a centre over units of the map. Default:
`config.PATH_SIGMA` = 0.01 of each, in frames in which a camera path was given. Ours.
"""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.geometry import so3
from bodyslam_jax.graph.factor import FrameFactor, in_unit
from bodyslam_jax.graph.losses import Loss, Squared


class CameraPrior(FrameFactor):
    """`r = [Log(C̃^T C), r' - r̃'] / σ`, one row of six for each frame."""

    cameras: Float[Array, "t 4 4"]
    """T̃'_WC: camera to world, its centre in units of the map."""
    sigma: Float[Array, "t 6"]
    """σ of rotation (rad) and of centre (units of the map); `inf` where unknown."""
    loss: Loss = Squared()
    padding = {"sigma": jnp.inf}
    keys = (("camera", 0),)

    def rescaled(self, factor):
        return dataclasses.replace(
            self,
            cameras=self.cameras.at[:, :3, 3].multiply(factor),
            sigma=self.sigma.at[:, 3:].set(in_unit(self.sigma[:, 3:], factor)),
        )

    def frame_residual(self, data, window, shared):
        measured, sigma = data
        camera = window[0].camera
        rotation = so3.log(measured[:3, :3].T @ camera[:3, :3])
        return jnp.concatenate([rotation, camera[:3, 3] - measured[:3, 3]]) / sigma


class ScalePrior(FrameFactor):
    """A known size of the map.

        r = (s - s̃) / σ

    Used where a camera path in metres is given: `s̃` is metres per unit of the map,
    default `σ = config.PATH_SIGMA s̃`, 1 %. Ours.
    """

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
