"""The up direction and its factor, from the trunks of people who stand or walk."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax import graph
from bodyslam_jax.config import GraphWeights

_MAX_LEAN_RAD = 0.35
"""Largest median lean of the trunk of a person who has a factor, rad."""
_LOSS_SIGMAS = 3.0
"""Cauchy scale, in standard deviations: people bend down occasionally."""


def mean_up(
    state: graph.State, present: Bool[np.ndarray, "h t"]
) -> Float[np.ndarray, "3"]:
    """Returns the mean direction of people's trunks in the world, a unit vector."""
    total = _trunks(state)[present].sum(axis=0)
    return total / max(float(np.linalg.norm(total)), 1e-9)


def upright_factor(
    state: graph.State,
    present: Bool[np.ndarray, "h t"],
    fps: float,
    weights: GraphWeights,
) -> graph.UprightPrior | None:
    """Returns the factor that trunks are parallel to up, with `weights.upright_sigma`
    (rad, at 30 fps); `None` if nobody is upright.

    Up is the mean direction of the trunks in `state`, so an error common to all trunks
    is not corrected.
    """
    if weights.upright_sigma is None or not present.any():
        return None
    up = mean_up(state, present)
    cosine = np.clip(_trunks(state) @ up, -1.0, 1.0)
    lean = np.nanmedian(np.where(present, np.arccos(cosine), np.nan), axis=1)
    upright = present & (lean < _MAX_LEAN_RAD)[:, None]
    if not upright.any():
        return None
    sigma = weights.upright_sigma * np.sqrt(fps / 30.0)
    return graph.UprightPrior(
        up=jnp.asarray(up),
        sigma=jnp.asarray(np.where(upright, sigma, np.inf)),
        loss=graph.Cauchy(jnp.asarray(_LOSS_SIGMAS)),
    )


def _trunks(state: graph.State) -> Float[np.ndarray, "h t 3"]:
    """Returns the y axes of people's root frames in the world."""
    ups = np.asarray(state.roots[..., :3, 1])
    return np.einsum("tij,htj->hti", np.asarray(state.cameras[:, :3, :3]), ups)
