"""The person keeps the angular velocity in the world.

    r = (Log(C_{k-1}^T C_k) - Log(C_{k-2}^T C_{k-1})) / σ,    C = C_WC C_CH

In rad per frame squared. Default: `weights.root_turning` = 0.015 rad at 30 fps. Ours.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.geometry import so3
from bodyslam_jax.graph.factor import FrameFactor, Key
from bodyslam_jax.graph.losses import Loss, Squared
from bodyslam_jax.graph.pelvis_displacement import previous_frame
from bodyslam_jax.graph.state import State


class AngularAccelerationPrior(FrameFactor):
    """`r = (Log(C_{k-1}^T C_k) - Log(C_{k-2}^T C_{k-1})) / σ` of `C = C_WH`."""

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
