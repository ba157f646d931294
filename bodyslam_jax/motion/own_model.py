"""A motion model made of a function and its parameters."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from bodyslam_jax.body import BodyModel
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.motion.function_network import FunctionNetwork, Step
from bodyslam_jax.motion.network import Window
from bodyslam_jax.motion.prediction import MotionModel


def make_motion_model(
    step: Step,
    parameters: PyTree,
    *,
    body: BodyModel,
    fps: float = 30.0,
    past: int = 1,
) -> MotionModel:
    """A motion model that predicts with `step(parameters, window)`.

    It serves where the models that ship do: in `predict`, `graph.MotionPredictor`,
    `evaluate_model`, and its `network` in `train(..., network=...)`.

    Args:
        step: see `Step`; a window (`motion.Window`) has frames k-past to k.
        parameters: floating-point arrays in any pytree; kept in float32.
        body: the body model whose joints the windows hold.
        fps: frames per second at which `step` expects its frames.
        past: how many frames before k a window has, 1 or more.

    **Raises:** `InputError` if `parameters` hold anything but floating-point arrays, or
    what `step` returns has other shapes.
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
    """Evaluates the shapes of one prediction."""
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
