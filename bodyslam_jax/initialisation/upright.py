"""People who are on their feet keep their trunk about where it points on average."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax import graph
from bodyslam_jax.config import GraphWeights

_STANDS = 0.35
"""rad: of somebody who leans by more, in the median, nothing is said."""
_LOSS = 3.0
"""Cauchy scale, in standard deviations: people bend down now and then."""


def mean_up(
    state: graph.State, there: Bool[np.ndarray, "h t"]
) -> Float[np.ndarray, "3"]:
    """Where trunks point on average, in the map's world; a unit vector."""
    total = _trunks(state)[there].sum(axis=0)
    return total / max(float(np.linalg.norm(total)), 1e-9)


def upright_factor(
    state: graph.State,
    there: Bool[np.ndarray, "h t"],
    fps: float,
    weights: GraphWeights,
) -> graph.UprightPrior | None:
    """Trunks lean by `upright_sigma` about their mean; `None` if nobody is upright.

    The mean is of the measured trunks, so that an error that they share stays in it.
    """
    if weights.upright_sigma is None or not there.any():
        return None
    up = mean_up(state, there)
    cosine = np.clip(_trunks(state) @ up, -1.0, 1.0)
    lean = np.nanmedian(np.where(there, np.arccos(cosine), np.nan), axis=1)
    stands = there & (lean < _STANDS)[:, None]
    if not stands.any():
        return None
    sigma = weights.upright_sigma * np.sqrt(fps / 30.0)
    return graph.UprightPrior(
        up=jnp.asarray(up),
        sigma=jnp.asarray(np.where(stands, sigma, np.inf)),
        loss=graph.Cauchy(jnp.asarray(_LOSS)),
    )


def _trunks(state: graph.State) -> Float[np.ndarray, "h t 3"]:
    """The y axis of people's root frames in the map's world."""
    ups = np.asarray(state.roots[..., :3, 1])
    return np.einsum("tij,htj->hti", np.asarray(state.cameras[:, :3, :3]), ups)
