"""Changes of problems and states that keep all shapes: nothing is recompiled."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bodyslam_jax.graph.factor import Factor, FrameFactor
from bodyslam_jax.graph.factors.intrinsics_prior import AbstractIntrinsicsFactor
from bodyslam_jax.graph.factors.landmark_prior import LandmarkPrior
from bodyslam_jax.graph.factors.reprojection import Reprojection
from bodyslam_jax.graph.padding import Masked
from bodyslam_jax.graph.problem import Problem
from bodyslam_jax.graph.state import State, Step


def disable(problem: Problem, *kinds: type[Factor]) -> Problem:
    """The problem without the cost of its factors of these classes.

    The factors stay, with all their measurements marked as missing.
    """
    factors = tuple(
        _missing(f, problem) if isinstance(f, kinds) else f for f in problem.factors
    )
    return eqx.tree_at(lambda p: p.factors, problem, factors)


def _missing(factor: Factor, problem: Problem) -> Factor:
    if isinstance(factor, Reprojection):
        values = {"sigma": jnp.inf}
    elif isinstance(factor, LandmarkPrior):
        values = {"whitening": 0.0}
    elif isinstance(factor, AbstractIntrinsicsFactor) and hasattr(factor, "sigma"):
        values = {"sigma": jnp.inf}
    elif isinstance(factor, FrameFactor) and factor.padding:
        values = factor.padding
    elif isinstance(factor, FrameFactor):
        free = problem.free
        lead = free.roots if factor.of_people else free.cameras
        return Masked(factor=factor, present=jnp.zeros(lead.shape[:-1], bool))
    else:
        name = type(factor).__name__
        raise ValueError(f"factors: {name} is neither of landmarks nor over frames.")
    for field, value in values.items():
        full = jnp.full_like(getattr(factor, field), value)
        factor = eqx.tree_at(lambda f, n=field: getattr(f, n), factor, full)
    return factor


def set_constant(free: Step, *names: str) -> Step:
    """The mask with these variables (names of `State`'s fields) held constant."""
    held = {name: jnp.zeros_like(getattr(free, name)) for name in names}
    return dataclasses.replace(free, **held)


def rescaled(state: State, factor: Float[Array | np.ndarray, "*f"] | float) -> State:
    """The same state in a map that is `factor` times as large.

    Camera centres and landmarks are multiplied by `factor`, and the scale s stays, so
    that lengths in metres grow by it; a solve from there ends with s divided by
    `factor`. An array of factors gives a batch of states with the array's axes leading.
    """
    by = jnp.asarray(factor, state.scale.dtype)
    one = lambda f: eqx.tree_at(
        lambda s: (s.cameras, s.landmarks),
        state,
        (state.cameras.at[:, :3, 3].multiply(f), state.landmarks * f),
    )
    for _ in range(by.ndim):
        one = jax.vmap(one)
    return one(by)
