"""The pelvis keeps its velocity in the world.

    r = (r_WH,k - 2 r_WH,k-1 + r_WH,k-2) / (L σ),    r_WH = s r'_WC + C_WC r_CH

In m per frame squared, or with a `body` in leg lengths `L(β)`, as `HumanMotion`.
Default: `weights.root_smoothness` = 0.02 m at 30 fps. Real pelvises accelerate by 0.006
m per frame squared, but with that value a camera that follows the person would be
estimated to move less, and the world to be smaller. Ours.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.body import BodyModel
from bodyslam_jax.geometry import so3
from bodyslam_jax.graph.factor import FrameFactor, Key
from bodyslam_jax.graph.factors.human_motion import (
    unit_length,
    unit_lengths,
    unit_lengths_by_shape,
)
from bodyslam_jax.graph.losses import Loss, Squared
from bodyslam_jax.graph.pelvis_displacement import (
    by_rotation_of,
    pelvis_in_world,
    previous_frame,
)
from bodyslam_jax.graph.state import State


class RootSmoothness(FrameFactor):
    """`r = (r_k - 2 r_{k-1} + r_{k-2}) / (L σ)` of `r = r_WH`."""

    sigma: Float[Array, "h t"]
    """m, or leg lengths, per frame squared; `inf` where one of the three frames is
    missing."""
    loss: Loss = Squared()
    body: BodyModel | None = None
    padding = {"sigma": jnp.inf}

    @property
    def keys(self) -> tuple[Key, ...]:
        return (
            *(("camera", lag) for lag in range(3)),
            *(("root", lag) for lag in range(3)),
            ("scale", 0),
            *((("shape", 0),) if self.body is not None else ()),
        )

    def frame_residual(self, data, window, shared):
        (sigma,) = data
        now, before, first = (
            shared.scale * f.camera[:3, 3] + f.camera[:3, :3] @ f.root[:3, 3]
            for f in window
        )
        return (now - 2 * before + first) / unit_length(self.body, shared) / sigma

    def residual(self, state: State) -> Float[Array, "h t 3"]:
        return self._whitened(_bend(pelvis_in_world(state)), state)

    def _whitened(self, x: Float[Array, "h t *b"], state: State) -> Array:
        """Returns `x / (L σ)`. Division by σ comes last: the derivative of `L σ` by the
        shape is infinite where σ is."""
        after = (..., *(None,) * (x.ndim - 2))
        leg = unit_lengths(self.body, state)[:, None]
        return x / leg[after] / self.sigma[after]

    def jacobians(self, state):
        residual = self.residual(state)
        camera = jnp.broadcast_to(state.cameras, state.roots.shape)
        C, r_WC = camera[..., :3, :3], camera[..., :3, 3]
        by_rotation = by_rotation_of(C, state.roots[..., :3, 3])
        eye = jnp.broadcast_to(jnp.eye(3, dtype=C.dtype), C.shape)
        join = lambda *parts: jnp.concatenate(parts, axis=-1)
        of_frame = {
            "camera": join(by_rotation, state.scale * eye),
            "root": join(jnp.zeros_like(C), C),
        }
        parts: dict[Key, Array] = {
            ("scale", 0): self._whitened(_bend(r_WC), state)[..., None]
        }
        for name, part in of_frame.items():
            for lag, factor in enumerate((1.0, -2.0, 1.0)):
                parts[name, lag] = factor * self._whitened(part, state)
                part = previous_frame(part)
        by_shape = unit_lengths_by_shape(self.body, state)
        if by_shape is not None:
            longer = by_shape / unit_lengths(self.body, state)[:, None]
            parts["shape", 0] = -residual[..., None] * longer[:, None, None]
        return residual, parts


def _bend(x: Float[Array, "h t 3"]) -> Float[Array, "h t 3"]:
    """Returns the second difference `x_k - 2 x_{k-1} + x_{k-2}`."""
    before = previous_frame(x)
    return x - 2 * before + previous_frame(before)


class AngularAccelerationPrior(FrameFactor):
    """The person keeps the angular velocity in the world.

        r = (Log(C_{k-1}^T C_k) - Log(C_{k-2}^T C_{k-1})) / σ,    C = C_WC C_CH

    In rad per frame squared. Default: `weights.root_turning` = 0.015 rad at 30 fps.
    Ours.
    """

    sigma: Float[Array, "h t"]
    """rad per frame squared; `inf` where one of the three frames is missing."""
    loss: Loss = Squared()
    padding = {"sigma": jnp.inf}
    keys = tuple((name, lag) for name in ("camera", "root") for lag in range(3))

    def frame_residual(self, data, window, shared):
        (sigma,) = data
        now, before, first = (f.camera[:3, :3] @ f.root[:3, :3] for f in window)
        return (so3.log(before.T @ now) - so3.log(first.T @ before)) / sigma

    def residual(self, state: State) -> Float[Array, "h t 3"]:
        return self._change(self._turns(state)[0]) / self.sigma[..., None]

    def jacobians(self, state):
        turn, C_HC = self._turns(state)
        # By a rotation on the right of C_k, and of C_{k-1}.
        now = so3.inverse_right_jacobian(turn)
        before = -so3.inverse_right_jacobian(-turn)
        by_root = now, before - previous_frame(now), -previous_frame(before)
        parts: dict[Key, Array] = {}
        for lag, by_turn in enumerate(by_root):
            by_turn = by_turn / self.sigma[..., None, None]
            # C_WC Exp(ω) C_CH = C_WH Exp(C_HC ω).
            of_camera = by_turn @ _shifted_back(C_HC, lag)
            for name, part in (("root", by_turn), ("camera", of_camera)):
                none = jnp.zeros_like(part)
                parts[name, lag] = jnp.concatenate([part, none], axis=-1)
        return self._change(turn) / self.sigma[..., None], parts

    def _turns(self, state: State) -> tuple[Float[Array, "h t 3"], Array]:
        """Returns `Log(C_{k-1}^T C_k)`, rad, and C_HC of each frame."""
        C_CH = state.roots[..., :3, :3]
        C_WH = state.cameras[:, :3, :3] @ C_CH
        return so3.log(so3.inverse(previous_frame(C_WH)) @ C_WH), so3.inverse(C_CH)

    def _change(self, turn: Float[Array, "h t 3"]) -> Float[Array, "h t 3"]:
        return turn - previous_frame(turn)


def _shifted_back(x: Array, lag: int) -> Array:
    """Applies `previous_frame` `lag` times."""
    for _ in range(lag):
        x = previous_frame(x)
    return x
