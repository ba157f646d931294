"""A regressed position of the person relative to the camera.

    e = [(x - x̃ z/z̃) / z̃, (y - ỹ z/z̃) / z̃, z/z̃ - 1]
    r_k = (e_k - ρ e_{k-1}) / (σ sqrt(1 - ρ²))

A direction and a depth, both as shares of the measured depth z̃, with AR(1) errors as
in `BodyPosePrior`. Linear in the position, so it has no singularity at z = 0. Used in
frames that are more than a second away from any keypoint of the person. Default:
`weights.root_direction` = 0.015, `weights.root_depth` = 0.07,
`weights.root_correlation`. Ours.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.graph.factor import FrameFactor
from bodyslam_jax.graph.losses import Loss, Squared, innovation


class RootPositionPrior(FrameFactor):
    """`r = (e_k - ρ e_{k-1}) / (σ sqrt(1 - ρ²))`, `e` the relative error of `r_CH`."""

    position: Float[Array, "h t 3"]
    """r̃_CH, m; z̃ above 0 where measured."""
    sigma: Float[Array, "h t 2"]
    """Stationary standard deviations of direction and of depth, as shares of the
    depth; `inf` where not measured."""
    correlation: Float[Array, "h t"]
    """ρ between the errors of k-1 and k; 0 at the start of a run."""
    loss: Loss = Squared()
    padding = {"sigma": jnp.inf, "correlation": 0.0}
    keys = (("root", 0), ("root", 1))

    def data(self):
        # A missing measurement may be 0, which has no direction.
        measured = jnp.isfinite(self.sigma).any(axis=-1, keepdims=True)
        position = jnp.where(measured, self.position, 1.0)
        previous = jnp.roll(position, 1, axis=1)
        return position, previous, self.sigma, self.correlation

    def frame_residual(self, data, window, shared):
        measured, previous, sigma, correlation = data
        error = _relative_error(measured, window[0].root[:3, 3])
        before = _relative_error(previous, window[1].root[:3, 3])
        direction, depth = sigma
        sigmas = jnp.stack([direction, direction, depth])
        return innovation(error, before, correlation) / sigmas


def _relative_error(
    measured: Float[Array, " 3"], position: Float[Array, " 3"]
) -> Float[Array, " 3"]:
    """Returns errors of direction (2) and depth, as shares of the measured depth."""
    share = position / measured[2]
    direction = share[:2] - measured[:2] / measured[2] * share[2]
    return jnp.append(direction, share[2] - 1)
