"""A user's function in the place of a network: a motion model of one's own."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from bodyslam_jax.motion.network import Guess, MotionNetwork, Window

Step = Callable[[Any, Window], Any]
"""`step(parameters, window)` of one window, without batch axes: the displacement of
the pelvis from k-1 to k in H_{k-1} (3,), m, and its standard deviation, m, one number
or one for each axis; or a whole `Guess`."""


class FunctionNetwork(MotionNetwork):
    """`step(parameters, window)` with the interface of the networks that ship."""

    step: Step = eqx.field(static=True)
    parameters: PyTree[Float[Array, "..."]]
    """What training changes."""
    spread: Float[Array, ""]
    """Factor on predicted standard deviations; training calibrates it, 1 before."""

    def __call__(self, window: Window) -> Guess:
        one = lambda window: self._guess(window)
        for _ in range(window.leg.ndim):
            one = jax.vmap(one)
        return one(window)

    def _guess(self, window: Window) -> Guess:
        found = self.step(self.parameters, window)
        dtype = window.joints.dtype
        if isinstance(found, Guess):
            return eqx.tree_at(
                lambda g: g.cholesky, found, self.spread * found.cholesky
            )
        translation, sigma = found
        axes = jnp.broadcast_to(jnp.asarray(sigma, dtype), (3,))
        return Guess(
            translation=jnp.asarray(translation, dtype),
            cholesky=jnp.diag(self.spread * axes),
            # Without a prediction of posture, people stay as they are.
            body_pose=window.body_pose[-2],
            rotation=jnp.zeros(3, dtype),
        )
