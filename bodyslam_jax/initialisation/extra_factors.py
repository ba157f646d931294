"""Error terms that are off unless a weight says how far they are trusted."""

import math
from typing import TypeGuard

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from bodyslam_jax import graph, motion
from bodyslam_jax.body import BodyModel
from bodyslam_jax.config import GraphWeights

_STANCE_LOSS = 2.0
"""Cauchy scale, in standard deviations: the lowest foot is not always one that
carries, and then goes a few centimetres a frame, forward."""


def optional_factors(
    state: graph.State,
    seen: motion.Prediction,
    there: Bool[np.ndarray, "h t"],
    fps: float,
    body: BodyModel,
    weights: GraphWeights,
) -> list[graph.Factor]:
    """People turn as the motion model predicts, the foot that carries stands, the
    camera keeps its velocity: those of them that `weights` switch on."""
    factors = (
        turn_factor(seen, fps, weights),
        stance_factor(state, there, fps, body, weights),
        steady_camera_factor(state, fps, weights),
    )
    return [factor for factor in factors if factor is not None]


def turn_factor(
    seen: motion.Prediction, fps: float, weights: GraphWeights
) -> graph.RelativeOrientation | None:
    """`orientation_sigma`: turns are as the motion model predicts them."""
    if not _is_on(weights.orientation_sigma):
        return None
    sigma = weights.orientation_sigma * 30.0 / fps
    return graph.RelativeOrientation(
        rotation=jnp.where(seen.valid[..., None], seen.rotation, 0.0),
        sigma=jnp.where(seen.valid, sigma, jnp.inf),
    )


def stance_factor(
    state: graph.State,
    there: Bool[np.ndarray, "h t"],
    fps: float,
    body: BodyModel,
    weights: GraphWeights,
) -> graph.StanceFoot | None:
    """`stance_sigma`: the lowest point of the feet, as the state has it, stands."""
    if not _is_on(weights.stance_sigma):
        return None
    stands = graph.stance_mask(body, state, jnp.asarray(there))
    sigma = jnp.where(stands, weights.stance_sigma * 30.0 / fps, jnp.inf)
    return graph.StanceFoot(body, sigma, loss=graph.Cauchy(jnp.asarray(_STANCE_LOSS)))


def steady_camera_factor(
    state: graph.State, fps: float, weights: GraphWeights
) -> graph.CameraSmoothness | None:
    """`camera_smoothness`: in units of the map, by the state's scale."""
    if not _is_on(weights.camera_smoothness):
        return None
    sigma = np.full((len(state.cameras), 2), np.inf)
    sigma[2:] = weights.camera_smoothness * (30.0 / fps) ** 2
    sigma[:, 1] /= float(state.scale)
    return graph.CameraSmoothness(jnp.asarray(sigma))


def _is_on(sigma: float | None) -> TypeGuard[float]:
    return sigma is not None and math.isfinite(sigma)
