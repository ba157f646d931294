"""Motion models that consist of a user's function and its parameters."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from bodyslam_jax.body import BodyModel
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.motion.capture.clips import FPS
from bodyslam_jax.motion.network import Guess, MotionNetwork, Window
from bodyslam_jax.motion.prediction import MotionModel

Step = Callable[[Any, Window], Any]
"""A function `step(parameters, window)` of one window, without batch axes. It returns
the displacement of the pelvis from k-1 to k in H_{k-1} (3,), m, and its standard
deviation, m, as one number or one per axis; or a whole `Guess`."""


class FunctionNetwork(MotionNetwork):
    """Wraps `step(parameters, window)` in the interface of the package's networks."""

    step: Step = eqx.field(static=True)
    parameters: PyTree[Float[Array, "..."]]
    """Parameters that training changes."""
    spread: Float[Array, ""]
    """Factor on predicted standard deviations: 1, until training calibrates it."""

    def __call__(self, window: Window) -> Guess:
        one = lambda window: self._guess(window)
        for _ in range(window.leg.ndim):
            one = jax.vmap(one)
        return one(window)

    def _guess(self, window: Window) -> Guess:
        """Returns the guess for one window, without batch axes."""
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
            # Without a prediction of posture, it remains as in frame k-1.
            body_pose=window.body_pose[-2],
            rotation=jnp.zeros(3, dtype),
        )


def make_motion_model(
    step: Step,
    parameters: PyTree,
    *,
    body: BodyModel,
    fps: float = FPS,
    past: int = 1,
) -> MotionModel:
    """Makes a motion model that predicts with `step(parameters, window)`.

    It can replace the package's models in `predict`, `graph.MotionPredictor`,
    `evaluate_model`, and its `network` in `train(..., network=...)`.

    Args:
        step: see `Step`; a window (`motion.Window`) has frames k-past to k.
        parameters: floating-point arrays in any pytree; kept in float32.
        body: the body model whose joints the windows hold.
        fps: frames per second at which `step` expects its frames.
        past: number of frames before k in a window, 1 or more.

    **Raises:** `InputError` if `parameters` hold anything but floating-point arrays, or
    if the result of `step` has other shapes.
    """
    if past < 1:
        raise InputError(f"past: found {past}, expected 1 or more.")
    for path, leaf in jax.tree_util.tree_leaves_with_path(parameters):
        if not eqx.is_inexact_array_like(leaf):
            where = jax.tree_util.keystr(path)
            raise InputError(
                f"parameters{where}: found {leaf!r:.40}, expected a floating-point "
                "array; let the function hold all else."
            )
    cast = lambda x: jnp.asarray(x, jnp.float32)
    network = FunctionNetwork(step, jax.tree.map(cast, parameters), cast(1.0))
    _check(network, past)
    return MotionModel(network, body.kind, fps, past)


def _check(network: FunctionNetwork, past: int) -> None:
    """Checks the shapes of one prediction, without computing it.

    **Raises:** `InputError` if the displacement does not have shape (3,).
    """
    frames = past + 1
    lengths = (frames, 3, 3), (frames, 23, 3), (frames, 24, 3), (10,), ()
    like = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in lengths]
    predict = lambda n, *arrays: n.step(n.parameters, Window(*arrays))
    found = eqx.filter_eval_shape(predict, network, *like)
    translation = getattr(found, "translation", None)
    if translation is None and isinstance(found, tuple) and len(found) == 2:
        translation = found[0]
    shape = getattr(translation, "shape", None)
    if shape != (3,):
        raise InputError(
            f"step: a displacement of shape {shape}, expected (3,) and a standard "
            "deviation, or a `Guess`."
        )
