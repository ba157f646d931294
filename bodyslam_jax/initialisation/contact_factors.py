"""Factors of feet that stand, from the contact network's probabilities."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from bodyslam_jax import graph, motion
from bodyslam_jax.body import BodyModel
from bodyslam_jax.config import GraphWeights

_LOSS = 3.0
"""Cauchy scale of a point's displacement, in standard deviations."""
_LEAST = 0.05
"""Probability of both frames below which a point has no weight."""


def contact_factor(
    probability: Float[Array, "h t 4"],
    state: graph.State,
    present: Bool[np.ndarray, "h t"],
    fps: float,
    body: BodyModel,
    weights: GraphWeights,
) -> graph.FootContact:
    """The factor that points which stand do not move, with `contact_sigma`.

    `probability` is that of each toe and heel to stand; β and s are those of `state`.
    """
    assert weights.contact_sigma is not None
    both = probability * _before(probability)
    both = jnp.where((present & np.asarray(_before(present)))[..., None], both, 0.0)
    leg = motion.leg_length(body, state.shapes)[:, None, None]
    sigma = weights.contact_sigma * np.sqrt(30.0 / fps) * leg
    stands = both > _LEAST
    sigma = jnp.where(stands, sigma / jnp.sqrt(jnp.where(stands, both, 1.0)), jnp.inf)
    shape = jnp.broadcast_to(state.shapes[:, None], (*present.shape, 10))
    scale = jnp.broadcast_to(state.scale, present.shape)
    loss = graph.Cauchy(jnp.asarray(_LOSS))
    return graph.FootContact(body, shape, scale, sigma.astype(shape.dtype), loss=loss)


def without_contacts(
    state: graph.State, fps: float, body: BodyModel, weights: GraphWeights
) -> graph.FootContact:
    """`contact_factor` for probabilities of zero, so that its cost is zero."""
    people, frames = state.poses.shape[:2]
    probability = jnp.zeros((people, frames, 4), state.poses.dtype)
    nobody = np.zeros((people, frames), bool)
    return contact_factor(probability, state, nobody, fps, body, weights)


def _before(x):
    """The values of the previous frame, zero in the first."""
    xp = jnp if isinstance(x, jax.Array) else np
    return xp.concatenate([xp.zeros_like(x[:, :1]), x[:, :-1]], axis=1)
