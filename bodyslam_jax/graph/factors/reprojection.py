"""Static landmarks projected into the camera (e_lm, section 3.6 of the paper).

    r = (u(T'_WC^-1 l) - z) / σ

In px, two rows for each observation. Cameras and landmarks are both in units of the
map, so the scale s does not enter. Default: σ is the noise that bundle adjustment
measured, within 0.3 to 3 px, or `weights.pixel_sigma`; Cauchy loss of scale
`weights.landmark_loss` = 1.5 σ. The paper: `λ_lm = 64/b²` with b = 2.25 px, so σ =
0.281 px.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from bodyslam_jax.geometry.camera import project
from bodyslam_jax.graph.factor import Factor
from bodyslam_jax.graph.losses import Loss, Squared
from bodyslam_jax.graph.state import State


class Reprojection(Factor):
    """`r = (u(T'_WC^-1 l) - z) / σ`, for `m` observations."""

    frame: Int[Array, " m"]
    landmark: Int[Array, " m"]
    pixel: Float[Array, "m 2"]
    sigma: Float[Array, " m"]
    """σ of each pixel coordinate, px; `inf` where rejected or missing."""
    loss: Loss

    def residual(self, state: State) -> Float[Array, "m 2"]:
        camera = state.cameras[self.frame]
        offset = state.landmarks[self.landmark] - camera[:, :3, 3]
        # Fused sums: one small matrix product for each observation would be slow.
        p_C = sum(camera[:, j, :3] * offset[:, j, None] for j in range(3))
        return (project(state.intrinsics, p_C) - self.pixel) / self.sigma[:, None]


class LandmarkPrior(Factor):
    """A landmark's position from observations that are not in the problem.

        r = W (l - l̃),    W^T W = Σ^-1

    A point that is lost and found again becomes several landmarks, each observed in a
    short run of frames, so that the reduced camera matrix stays banded. Each has a
    prior from the observations of the others, which is how loop closures constrain the
    map. `l̃` and `Σ` come from structure from motion (`sfm/loop_closure.py`), in units
    of the map, with the same pixel noise as `Reprojection` (`weights.pixel_sigma`).
    Ours.
    """

    position: Float[Array, "l 3"]
    """l̃, in units of the map."""
    whitening: Float[Array, "l 3 3"]
    """`W` with `W^T W` the inverse of the covariance; 0 without a prior."""
    loss: Loss = Squared()
    map_units = {"position": 1, "whitening": -1}

    def residual(self, state: State) -> Float[Array, "l 3"]:
        error = state.landmarks - self.position
        return jnp.einsum("lij,lj->li", self.whitening, error)
