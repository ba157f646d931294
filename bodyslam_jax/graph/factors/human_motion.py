"""The displacement that the motion model predicts (e_mm, section 3.6 of the paper).

    e_k = C_WH,k-1^T (r_WH,k - r_WH,k-1) / L - r̃_k,    r_WH = s r'_WC + C_WC r_CH
    r_k = W_k (e_k - ρ e_{k-1}) / sqrt(1 - ρ²),        W^T W = Σ^-1

`r̃` is the predicted displacement of the pelvis; the residual is linear in the scale s.
With a `body`, lengths are in leg lengths `L(β)`: in metres a smaller person in a
smaller world would have smaller errors, and the estimate would shrink. The model's
errors are modelled as AR(1) with correlation ρ. Default: the network's `Σ`, enlarged by
an error common to all steps of a person (`weights.step_error` = 5 %), and
`weights.motion_correlation` = 0.8. The paper: in metres, `λ_mm = 100`
(`weights.motion_sigma` = 0.1 m), independent.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.body import BodyModel
from bodyslam_jax.graph.factor import FrameFactor, Key, Shared
from bodyslam_jax.graph.losses import Loss, Squared, innovation
from bodyslam_jax.graph.pelvis_displacement import (
    displacement,
    displacements,
    displacements_with_derivatives,
    previous_frame,
)
from bodyslam_jax.graph.state import State
from bodyslam_jax.motion import leg_length


class HumanMotion(FrameFactor):
    """`r = W (e_k - ρ e_{k-1}) / sqrt(1 - ρ²)`, `e` the error of a displacement."""

    translation: Float[Array, "h t 3"]
    """r̃: predicted displacement from k-1 to k in H_{k-1}, m; with a `body`, in leg
    lengths."""
    whitening: Float[Array, "h t 3 3"]
    """`W` with `W^T W` the inverse of the covariance (m^-1); 0 where not predicted."""
    correlation: Float[Array, "h t"]
    """ρ between the errors of k-1 and k; 0 where k-1 has no prediction."""
    loss: Loss = Squared()
    correlated: bool = eqx.field(static=True, default=True)
    """Whether the errors are correlated; if not, `keys` span two frames, not three."""
    body: BodyModel | None = None
    padding = {"whitening": 0.0, "correlation": 0.0}

    @property
    def keys(self) -> tuple[Key, ...]:
        lags = range(3 if self.correlated else 2)
        return (
            *(("camera", lag) for lag in lags),
            *(("root", lag) for lag in lags),
            ("scale", 0),
            *((("shape", 0),) if self.body is not None else ()),
        )

    def data(self):
        previous = jnp.concatenate(
            [jnp.zeros_like(self.translation[:, :1]), self.translation[:, :-1]], axis=1
        )
        return self.translation, previous, self.whitening, self.correlation

    def frame_residual(self, data, window, shared):
        translation, previous, whitening, correlation = data
        leg = unit_length(self.body, shared)
        error = displacement(window[1], window[0], shared.scale) / leg - translation
        if self.correlated:
            earlier = displacement(window[2], window[1], shared.scale) / leg - previous
            error = innovation(error, earlier, correlation)
        return whitening @ error

    def residual(self, state: State) -> Float[Array, "h t 3"]:
        leg = unit_lengths(self.body, state)
        return self._whitened(displacements(state) / leg[:, None, None])

    def _whitened(self, d: Float[Array, "h t 3"]) -> Float[Array, "h t 3"]:
        """Returns the residual of displacements in the unit of length."""
        error, whitening = d - self.translation, self.whitening
        if self.correlated:
            rho = self.correlation[..., None]
            error = innovation(error, previous_frame(error), rho)
        return (whitening @ error[..., None])[..., 0]

    def jacobians(self, state):
        d, parts = displacements_with_derivatives(state)
        jac = jnp.concatenate(list(parts.values()), axis=-1)
        leg = unit_lengths(self.body, state)[:, None]
        by_shape = unit_lengths_by_shape(self.body, state)
        if by_shape is not None:
            by_shape = -d[..., None] * (by_shape / leg**2)[:, None, None]
            jac = jnp.concatenate([jac / leg[..., None, None], by_shape], axis=-1)
        whitening, last = self.whitening, jnp.zeros_like(jac)
        if self.correlated:
            rho = self.correlation[..., None]
            whitening = whitening / jnp.sqrt(1 - rho**2)[..., None]
            last = -rho[..., None] * previous_frame(jac)
        now, last = whitening @ jac, whitening @ last
        six = lambda x, i: x[..., 6 * i : 6 * i + 6]
        keys: dict[Key, Array] = {("scale", 0): (now + last)[..., 24:25]}
        for i, name in enumerate(("camera", "root")):
            keys[name, 0] = six(now, 2 * i)
            keys[name, 1] = six(now, 2 * i + 1) + six(last, 2 * i)
            if self.correlated:
                keys[name, 2] = six(last, 2 * i + 1)
        if self.body is not None:
            keys["shape", 0] = (now + last)[..., 25:]
        return self._whitened(d / leg[..., None]), keys


def unit_lengths(body: BodyModel | None, state: State) -> Float[Array, " h"]:
    """Returns the leg length of each person, m; 1 m without a body."""
    if body is None:
        return jnp.ones_like(state.shapes[:, 0])
    return leg_length(body, state.shapes)


def unit_lengths_by_shape(
    body: BodyModel | None, state: State
) -> Float[Array, "h 10"] | None:
    """Returns the derivative of `unit_lengths` by the shape, `None` without a body."""
    if body is None:
        return None
    return jax.vmap(jax.jacfwd(lambda shape: leg_length(body, shape)))(state.shapes)


def unit_length(body: BodyModel | None, shared: Shared) -> Float[Array, ""]:
    """Returns the length of the person's leg, m; 1 m without a body."""
    if body is None:
        return jnp.ones_like(shared.scale)
    return leg_length(body, shared.shape)
