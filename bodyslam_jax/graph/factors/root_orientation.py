"""A regressed orientation of the person relative to the camera.

    e_k = Log(C̃_CH,k^T C_CH,k),    r_k = (e_k - ρ e_{k-1}) / (σ sqrt(1 - ρ²))

In rad, with AR(1) errors as in `BodyPosePrior`. Default: `weights.root_sigma` = 0.12
rad and `weights.root_correlation` = 0.99 at 30 fps. Ours: the paper uses it as a start
only.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.geometry import so3
from bodyslam_jax.graph.factor import FrameFactor, Key
from bodyslam_jax.graph.losses import Loss, Squared, innovation
from bodyslam_jax.graph.pelvis_displacement import previous_frame
from bodyslam_jax.graph.state import State


class RootOrientation(FrameFactor):
    """`r = (e_k - ρ e_{k-1}) / (σ sqrt(1 - ρ²))`, `e = Log(C̃_CH^T C_CH)`."""

    orientation: Float[Array, "h t 3 3"]
    """C̃_CH"""
    sigma: Float[Array, "h t"]
    """Stationary standard deviation per axis, rad; `inf` where not measured."""
    correlation: Float[Array, "h t"]
    """ρ between the errors of k-1 and k; 0 at the start of a run."""
    loss: Loss = Squared()
    padding = {"sigma": jnp.inf, "correlation": 0.0}
    keys = (("root", 0), ("root", 1))

    def data(self):
        previous = jnp.roll(self.orientation, 1, axis=1)
        return self.orientation, previous, self.sigma, self.correlation

    def frame_residual(self, data, window, shared):
        measured, previous, sigma, correlation = data
        error = so3.log(measured.T @ window[0].root[:3, :3])
        before = so3.log(previous.T @ window[1].root[:3, :3])
        return innovation(error, before, correlation) / sigma

    def residual(self, state: State) -> Float[Array, "h t 3"]:
        error = self._error(state)
        now, earlier = self._coefficients
        return now * error + earlier * previous_frame(error)

    def jacobians(self, state):
        error = self._error(state)
        now, earlier = self._coefficients
        by_turn = so3.inverse_right_jacobian(error)
        by_root = jnp.concatenate([by_turn, jnp.zeros_like(by_turn)], axis=-1)
        parts: dict[Key, Array] = {
            ("root", 0): now[..., None] * by_root,
            ("root", 1): earlier[..., None] * previous_frame(by_root),
        }
        return now * error + earlier * previous_frame(error), parts

    def _error(self, state: State) -> Float[Array, "h t 3"]:
        return so3.log(so3.inverse(self.orientation) @ state.roots[..., :3, :3])

    @property
    def _coefficients(self):
        """Returns the coefficients of both frames' errors in the residual."""
        rho = self.correlation[..., None]
        # Division by sigma comes last: inf * 0 would make the derivative by ρ NaN.
        now = 1 / jnp.sqrt(1 - rho**2) / self.sigma[..., None]
        return now, -rho * now
