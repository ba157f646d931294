"""Postures and shapes, regressed or predicted (Section 3.6 of the paper).

Henning et al., BodySLAM, ECCV 2022. What all terms have in common is in `factor.py`.
"""

import equinox as eqx
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from bodyslam_jax.geometry.so3 import compose, log_of
from bodyslam_jax.graph.factor import FrameFactor, Key
from bodyslam_jax.graph.losses import Loss, Squared
from bodyslam_jax.graph.pelvis_displacement import before
from bodyslam_jax.graph.state import State, inverse_right_jacobian
from bodyslam_jax.graph.whitening import innovation


class BodyPosePrior(FrameFactor):
    """Each joint's rotation against a measured or predicted one.

    `e_k = Log(C̃_k^T C(θ_k))`, the geodesic form of the paper's `θ_k - θ̃_k`. Errors of a
    regressor last: with a correlation ρ the residual is the innovation
    `(e_k - ρ e_{k-1}) / (σ sqrt(1 - ρ²))`, and `e_k / σ` where a run of frames begins.
    """

    rotation: Float[Array, "h t 23 3"]
    """θ̃, axis-angle, rad"""
    sigma: Float[Array, "h t 23"]
    """Stationary standard deviation per axis, rad; `inf` where not measured."""
    correlation: Float[Array, "h t"]
    """ρ between the errors of k-1 and k; 0 at the start of a run."""
    loss: Loss = Squared()
    correlated: bool = eqx.field(static=True, default=True)
    predicted: bool = eqx.field(static=True, default=False)
    """Whether θ̃ is the motion model's prediction (the paper), not a regressor's."""
    of_people = True
    time_fields = ("rotation", "sigma", "correlation")
    padding = {"sigma": jnp.inf, "correlation": 0.0}
    per_joint = True

    @property
    def keys(self) -> tuple[Key, ...]:
        return (("pose", 0), ("pose", 1)) if self.correlated else (("pose", 0),)

    def data(self):
        t = self.rotation.shape[1]
        previous = self.rotation[:, jnp.maximum(jnp.arange(t) - 1, 0)]
        return self.rotation, previous, self.sigma, self._lasting

    @property
    def _lasting(self) -> Float[Array, "h t 23"]:
        """ρ of each joint: 0 where it was not measured in the frame before."""
        known = jnp.isfinite(before(self.sigma))
        return jnp.where(known, self.correlation[..., None], 0.0)

    def frame_residual(self, data, window, shared):
        rotation, previous, sigma, correlation = data
        error = rotation_between(rotation, window[0].pose)
        if self.correlated:
            last = rotation_between(previous, window[1].pose)
            error = innovation(error, last, correlation[:, None])
        return error / sigma[:, None]

    def residual(self, state: State) -> Float[Array, "h t 23 3"]:
        return self._innovation(rotation_between(self.rotation, state.poses))[0]

    def jacobians(self, state):
        error = rotation_between(self.rotation, state.poses)
        residual, now, earlier = self._innovation(error)
        by_error = inverse_right_jacobian(error)
        parts: dict[Key, Array] = {("pose", 0): now[..., None] * by_error}
        if self.correlated:
            parts["pose", 1] = earlier[..., None] * before(by_error)
        return residual, parts

    def _innovation(self, error):
        """The residual, and what it takes of this frame's error and the last one's."""
        rho = self._lasting[..., None]
        # An infinite sigma last, or its derivative by ρ is no number.
        now = 1 / jnp.sqrt(1 - rho**2) / self.sigma[..., None]
        earlier = -rho * now
        if not self.correlated:
            return error / self.sigma[..., None], 1 / self.sigma[..., None], earlier
        return now * error + earlier * before(error), now, earlier


class ShapePrior(FrameFactor):
    """Regressed shape: `β - β̃_k`. Regressors err alike in all frames of a video: one
    measurement, in one frame, says as much as it knows."""

    shape: Float[Array, "h t 10"]
    """β̃"""
    sigma: Float[Array, "h t 10"]
    """`inf` where not measured."""
    loss: Loss = Squared()
    of_people = True
    time_fields = ("shape", "sigma")
    padding = {"sigma": jnp.inf}

    @property
    def keys(self) -> tuple[Key, ...]:
        return (("shape", 0),)

    def data(self):
        return self.shape, self.sigma

    def frame_residual(self, data, window, shared):
        shape, sigma = data
        return (shared.shape - shape) / sigma


class Stature(FrameFactor):
    """A known height of the person, `(h_0 + g · β - h̃) / σ`.

    The height of the mesh at rest, between the vertices that are highest and lowest in
    the mean shape, is linear in β.
    """

    template: Float[Array, ""]
    """h_0, m"""
    slope: Float[Array, " 10"]
    """g, m"""
    height: Float[Array, "h t"]
    """h̃, m"""
    sigma: Float[Array, "h t"]
    """m; finite in one frame of each person who was measured, `inf` elsewhere."""
    loss: Loss = Squared()
    of_people = True
    time_fields = ("height", "sigma")
    padding = {"sigma": jnp.inf}

    @property
    def keys(self) -> tuple[Key, ...]:
        return (("shape", 0),)

    def data(self):
        return self.height, self.sigma

    def frame_residual(self, data, window, shared):
        height, sigma = data
        return (self.template + jnp.dot(self.slope, shared.shape) - height)[
            None
        ] / sigma


def rotation_between(
    first: Float[Array, "*b 3"], second: Float[Array, "*b 3"]
) -> Float[Array, "*b 3"]:
    """`Log(Exp(first)^T Exp(second))`, at most pi long."""
    return log_of(compose(jaxlie.SO3.exp(-first), jaxlie.SO3.exp(second)))
