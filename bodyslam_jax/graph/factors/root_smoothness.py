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
