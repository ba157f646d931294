"""A measured or predicted body pose (e_posture, section 3.6 of the paper).

    e_k = Log(C̃_k^T C(θ_k)),    r_k = (e_k - ρ e_{k-1}) / (σ sqrt(1 - ρ²))

for each joint but the root, in rad: the geodesic form of the paper's `θ_k - θ̃_k`. The
errors of a regressor are temporally correlated and modelled as AR(1) with correlation
`ρ`; at the start of a run of frames `r_k = e_k / σ`. Default: `weights.posture_sigma` =
0.2 rad and `weights.posture_correlation` = 0.99 at 30 fps. The paper compares with the
motion model's prediction, `λ_posture = 1`, independent: `weights.posture_predicted`.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.geometry import so3
from bodyslam_jax.graph.factor import FrameFactor, Key
from bodyslam_jax.graph.losses import Loss, Squared, innovation
from bodyslam_jax.graph.pelvis_displacement import previous_frame
from bodyslam_jax.graph.state import State


class BodyPosePrior(FrameFactor):
    """`r = (e_k - ρ e_{k-1}) / (σ sqrt(1 - ρ²))` of each joint, `e = Log(C̃^T
    C(θ))`."""

    rotation: Float[Array, "h t 23 3"]
    """θ̃, axis-angle, rad."""
    sigma: Float[Array, "h t 23"]
    """Stationary standard deviation per axis, rad; `inf` where not measured."""
    correlation: Float[Array, "h t"]
    """ρ between the errors of k-1 and k; 0 at the start of a run."""
    loss: Loss = Squared()
    correlated: bool = eqx.field(static=True, default=True)
    predicted: bool = eqx.field(static=True, default=False)
    """Whether θ̃ is the motion model's prediction (the paper), not a regressor's."""
    padding = {"sigma": jnp.inf, "correlation": 0.0}
    per_joint = True

    @property
    def keys(self) -> tuple[Key, ...]:
        return (("pose", 0), ("pose", 1)) if self.correlated else (("pose", 0),)

    def data(self):
        t = self.rotation.shape[1]
        previous = self.rotation[:, jnp.maximum(jnp.arange(t) - 1, 0)]
        return self.rotation, previous, self.sigma, self._joint_correlation

    @property
    def _joint_correlation(self) -> Float[Array, "h t 23"]:
        """Returns ρ of each joint: 0 where not measured in the previous frame."""
        measured = jnp.isfinite(previous_frame(self.sigma))
        return jnp.where(measured, self.correlation[..., None], 0.0)

    def frame_residual(self, data, window, shared):
        rotation, previous, sigma, correlation = data
        error = so3.between(rotation, window[0].pose)
        if self.correlated:
            earlier = so3.between(previous, window[1].pose)
            error = innovation(error, earlier, correlation[:, None])
        return error / sigma[:, None]

    def residual(self, state: State) -> Float[Array, "h t 23 3"]:
        return self._innovation(so3.between(self.rotation, state.poses))[0]

    def jacobians(self, state):
        error = so3.between(self.rotation, state.poses)
        residual, now, earlier = self._innovation(error)
        by_error = so3.inverse_right_jacobian(error)
        parts: dict[Key, Array] = {("pose", 0): now[..., None] * by_error}
        if self.correlated:
            parts["pose", 1] = earlier[..., None] * previous_frame(by_error)
        return residual, parts

    def _innovation(self, error):
        """Returns the residual, and the coefficients of both frames' errors in it."""
        rho = self._joint_correlation[..., None]
        # Division by sigma comes last: inf * 0 would make the derivative by ρ NaN.
        now = 1 / jnp.sqrt(1 - rho**2) / self.sigma[..., None]
        earlier = -rho * now
        if not self.correlated:
            return error / self.sigma[..., None], 1 / self.sigma[..., None], earlier
        return now * error + earlier * previous_frame(error), now, earlier
