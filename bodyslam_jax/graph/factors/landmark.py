"""What is known of landmarks besides the observations in the problem."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.graph.factor import Factor
from bodyslam_jax.graph.losses import Loss, Squared
from bodyslam_jax.graph.state import State


class LandmarkPrior(Factor):
    """A landmark is where its other sightings put it: `W (l - l̃)`.

    A point that is lost and found again is several landmarks, each seen in a few frames
    in a row, so that the solver's blocks stay near the diagonal. What the sightings say
    of each other is a prior on each, with which a place seen again still holds the map
    together. It is taken from the map of structure from motion, in its unit.
    """

    place: Float[Array, "l 3"]
    """l̃, in units of the map."""
    whitening: Float[Array, "l 3 3"]
    """`W` with `W^T W` the inverse of the covariance; 0 where nothing is known."""
    loss: Loss = Squared()

    def residual(self, state: State) -> Float[Array, "l 3"]:
        away = state.landmarks - self.place
        return jnp.einsum("lij,lj->li", self.whitening, away)
