"""Edits of problems and states that keep all shapes, so that nothing is recompiled."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bodyslam_jax.geometry.lengths import is_traced
from bodyslam_jax.graph.factor import Factor, FrameFactor
from bodyslam_jax.graph.factors.intrinsics_prior import AbstractIntrinsicsFactor
from bodyslam_jax.graph.factors.marginal_prior import MarginalPrior
from bodyslam_jax.graph.factors.reprojection import LandmarkPrior, Reprojection
from bodyslam_jax.graph.padding import Masked
from bodyslam_jax.graph.problem import Problem
from bodyslam_jax.graph.state import State, Step, moved_at_random

_RESIDUAL_RTOL = {"float64": 1e-9, "float32": 1e-4}
"""Largest relative difference of a residual in two units of the map, by precision."""


def disable(problem: Problem, *kinds: type[Factor]) -> Problem:
    """Returns the problem without the cost of its factors of these classes.

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
    elif isinstance(factor, MarginalPrior):
        values = {"root": 0.0, "offset": 0.0}
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
    """Returns the mask with these variables (fields of `State`) held constant."""
    held = {name: jnp.zeros_like(getattr(free, name)) for name in names}
    return dataclasses.replace(free, **held)


def rescaled(
    problem: Problem | State,
    state: State | Float[Array | np.ndarray, "*f"] | float,
    factor: Float[Array | np.ndarray, "*f"] | float | None = None,
) -> tuple[Problem, State]:
    """Returns the problem and its state in a map that is `factor` times as large.

    Camera centres and landmarks are multiplied by `factor`, and so is all that the
    problem's factors measure in units of the map (`Factor.rescaled`). The scale s
    stays, so that the state's lengths in metres grow by `factor`; a solve from there
    ends with s divided by it. With `state.scale / factor` the cost is unchanged.

    For an array of factors both are batches, with the array's axes leading.

    **Raises:** `ValueError` for a state alone, for a factor that is not above 0, and
    for a problem with a custom factor whose residual changes with the unit of the map:
    it is compared in a map of twice the size, or, where it is traced, must declare
    `map_units`.
    """
    if not isinstance(problem, Problem) or not isinstance(state, State):
        raise ValueError(
            "rescaled: found a state alone, expected `rescaled(problem, state, "
            "factor)`, which returns both: ground, priors of landmarks and a camera "
            "path in the problem are in units of the map, too."
        )
    if factor is None or (
        not is_traced(factor)
        and not (np.isfinite(factor) & (np.asarray(factor) > 0)).all()
    ):
        raise ValueError(f"factor: found {factor}, expected a number above 0.")
    for each in problem.factors:
        _check_units(each, state)
    by = jnp.asarray(factor, state.scale.dtype)
    whole = (problem, state)
    if by.ndim:  # `jax.vmap` maps arrays only.
        as_array = lambda x: jnp.asarray(x, by.dtype) if isinstance(x, float) else x
        whole = jax.tree.map(as_array, whole)
    arrays, static = eqx.partition(whole, eqx.is_array)

    def one(by):
        problem, state = eqx.combine(arrays, static)
        return eqx.filter(_in_unit(problem, state, by), eqx.is_array)

    for _ in range(by.ndim):
        one = jax.vmap(one)
    return eqx.combine(one(by), static)


def _in_unit(
    problem: Problem, state: State, factor: Float[Array, ""]
) -> tuple[Problem, State]:
    factors = tuple(f.rescaled(factor) for f in problem.factors)
    larger = dataclasses.replace(
        state,
        cameras=state.cameras.at[:, :3, 3].multiply(factor),
        landmarks=factor * state.landmarks,
    )
    return dataclasses.replace(problem, factors=factors), larger


def _check_units(factor: Factor, state: State) -> None:
    """Refuses a custom factor whose residual depends on the unit of the map.

    In a map of twice the size with half as many metres per unit it must be the same:
    both are exact in binary floating point.
    """
    custom = factor.factor if isinstance(factor, Masked) else factor
    name = type(custom).__name__
    if type(custom).__module__.partition(".")[0] == __name__.partition(".")[0]:
        return
    seen = {key for key, _ in custom.keys} if isinstance(custom, FrameFactor) else None
    if seen is not None and not seen & {"camera", "scale"}:
        return
    advice = (
        f"declare the power of the map's unit in each of its fields that has one, such "
        f'as `map_units = {{"position": 1}}`, or `{{}}` ({name}.map_units).'
    )
    if is_traced((factor, state)):
        if custom.map_units is None:
            raise ValueError(
                f"problem.factors: {name} is traced, so that it cannot be found out "
                f"whether it measures in units of the map; {advice}"
            )
        return
    two = jnp.asarray(2.0, state.scale.dtype)
    moved = moved_at_random(state)
    larger = dataclasses.replace(
        moved,
        scale=moved.scale / two,
        cameras=moved.cameras.at[:, :3, 3].multiply(two),
        landmarks=two * moved.landmarks,
    )
    before = np.asarray(factor.residual(moved))
    after = np.asarray(factor.rescaled(two).residual(larger))
    same = _RESIDUAL_RTOL[state.scale.dtype.name]
    size = float(abs(before).max(initial=0.0, where=np.isfinite(before)))
    if not np.allclose(after, before, same, same * size, equal_nan=True):
        raise ValueError(
            f"problem.factors: the residual of {name} changes with the unit of the "
            f"map; {advice}"
        )
