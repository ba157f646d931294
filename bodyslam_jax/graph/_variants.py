"""Other problems with the shapes of a given one, so that nothing is compiled anew."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp

from bodyslam_jax.graph._abstract import AbstractFactor
from bodyslam_jax.graph._human_motion import HumanMotion
from bodyslam_jax.graph._landmark_prior import LandmarkPrior
from bodyslam_jax.graph._problem import Problem
from bodyslam_jax.graph._state import Step


def mute(problem: Problem, *kinds: type[AbstractFactor]) -> Problem:
    """The problem with its terms of these kinds weighing nothing.

    Their measurements become missing ones.
    """
    factors = tuple(_missing(f) if isinstance(f, kinds) else f for f in problem.factors)
    return eqx.tree_at(lambda p: p.factors, problem, factors)


def _missing(factor: AbstractFactor) -> AbstractFactor:
    whitened = isinstance(factor, HumanMotion | LandmarkPrior)
    field = "whitening" if whitened else "sigma"
    old = getattr(factor, field)
    value = 0.0 if field == "whitening" else jnp.inf
    return eqx.tree_at(lambda f: getattr(f, field), factor, jnp.full_like(old, value))


def hold(free: Step, *names: str) -> Step:
    """The same mask with groups of variables held, by their names in `State`."""
    held = {name: jnp.zeros_like(getattr(free, name)) for name in names}
    return dataclasses.replace(free, **held)
