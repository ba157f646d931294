"""People move and turn as the motion model predicts (Section 3.6 of the paper).

Henning et al., BodySLAM, ECCV 2022. What all terms have in common is in `factor.py`.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from bodyslam_jax.body import BodyModel
from bodyslam_jax.geometry.so3 import log
from bodyslam_jax.graph.factor import FrameFactor, Key, Shared
from bodyslam_jax.graph.losses import Loss, Squared
from bodyslam_jax.graph.pelvis_displacement import before, displacement, displacements
from bodyslam_jax.graph.whitening import innovation
from bodyslam_jax.motion import leg_length


class HumanMotion(FrameFactor):
    """The pelvis moves as the motion model predicts.

    `e_k = C_WH_{k-1}^T (r_WH_k - r_WH_{k-1}) - r̃_k` with `r_WH = s r'_WC + C_WC r_CH`,
    so that it is linear in s. With a correlation ρ the model's errors in successive
    frames are not taken for independent: the residual is `e_k - ρ e_{k-1}` over its
    own standard deviation.

    With a `body`, lengths are in lengths of the leg, whose steps the model predicts.
    Otherwise a smaller person in a smaller world has smaller errors in metres, and the
    estimate shrinks.
    """

    translation: Float[Array, "h t 3"]
    """r̃: predicted displacement from k-1 to k, in H_{k-1}, m (with `body`: legs)."""
    whitening: Float[Array, "h t 3 3"]
    """`W` with `W^T W` the inverse of the covariance (m^-1); 0 where not predicted."""
    correlation: Float[Array, "h t"]
    """ρ between the errors of k-1 and k; 0 where k-1 has no prediction."""
    loss: Loss = Squared()
    correlated: bool = eqx.field(static=True, default=True)
    """Whether any correlation is used; if not, a term spans two frames, not three."""
    body: BodyModel | None = None
    of_people = True
    time_fields = ("translation", "whitening", "correlation")
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
            last = displacement(window[2], window[1], shared.scale) / leg - previous
            error = innovation(error, last, correlation)
        return whitening @ error

    def jacobians(self, state):
        d, parts = displacements(state)
        jac = jnp.concatenate(list(parts.values()), axis=-1)
        leg = jnp.ones_like(state.shapes[:, :1])
        if self.body is not None:
            one = jax.value_and_grad(lambda b: leg_length(self.body, b))
            leg, by_shape = jax.vmap(one)(state.shapes)
            leg = leg[:, None]
            by_shape = -d[..., None] * (by_shape / leg**2)[:, None, None]
            jac = jnp.concatenate([jac / leg[..., None, None], by_shape], axis=-1)
        error = d / leg[..., None] - self.translation
        whitening, last = self.whitening, jnp.zeros_like(jac)
        if self.correlated:
            rho = self.correlation[..., None]
            error = error - rho * before(error)
            whitening = whitening / jnp.sqrt(1 - rho**2)[..., None]
            last = -rho[..., None] * before(jac)
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
        return (whitening @ error[..., None])[..., 0], keys


class RelativeOrientation(FrameFactor):
    """The person turns as the motion model predicts: `Log(C̃^T C_WH_{k-1}^T C_WH_k)`.

    The paper's model predicts it; its cost leaves it out.
    """

    rotation: Float[Array, "h t 3"]
    """Rotation vector from H_{k-1} to H_k, rad."""
    sigma: Float[Array, "h t"]
    """Per axis, rad; `inf` where not predicted."""
    loss: Loss = Squared()
    of_people = True
    time_fields = ("rotation", "sigma")
    padding = {"sigma": jnp.inf}

    @property
    def keys(self) -> tuple[Key, ...]:
        return ("camera", 0), ("camera", 1), ("root", 0), ("root", 1)

    def data(self):
        return self.rotation, self.sigma

    def frame_residual(self, data, window, shared):
        rotation, sigma = data
        now, before = (f.camera[:3, :3] @ f.root[:3, :3] for f in window)
        predicted = jaxlie.SO3.exp(rotation).as_matrix()
        return log(predicted.T @ before.T @ now) / sigma


def unit_length(body: BodyModel | None, shared: Shared) -> Float[Array, ""]:
    """The length of the person's leg, m; 1 m without a body."""
    if body is None or shared.shape is None:
        return jnp.ones_like(shared.scale)
    return leg_length(body, shared.shape)
