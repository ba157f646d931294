"""Defines variants of a joint problem: factors disabled or added, variables held
constant."""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp

from bodyslam_jax import graph

_SCALE_FACTORS = (
    graph.HumanMotion,
    graph.RootSmoothness,
    graph.GroundContact,
)
"""Factors that relate the map's unit to metres."""

Start = tuple[graph.Problem, graph.State]
Variant = Callable[[graph.Problem, graph.State], Start]


def without(*kinds: type[graph.Factor]) -> Variant:
    """Returns the variant without these factors; s is held if no remaining factor
    determines it.

    A problem that has no such factors is returned unchanged.
    """

    def variant(problem: graph.Problem, state: graph.State) -> Start:
        disabled = graph.disable(problem, *kinds)
        if eqx.tree_equal(disabled, problem):
            return problem, state
        remaining = [f for f in problem.factors if isinstance(f, _SCALE_FACTORS)]
        if all(isinstance(f, kinds) for f in remaining):
            disabled = dataclasses.replace(
                disabled, free=graph.set_constant(disabled.free, "scale")
            )
        return disabled, state

    return variant


def held(*names: str) -> Variant:
    """Returns the variant that holds these groups of variables at their start
    values."""

    def variant(problem: graph.Problem, state: graph.State) -> Start:
        free = graph.set_constant(problem.free, *names)
        return dataclasses.replace(problem, free=free), state

    return variant


def without_landmarks(problem: graph.Problem, state: graph.State) -> Start:
    """Returns the problem without observations of landmarks: landmarks are held, as no
    factor determines them, and cameras are free."""
    return held("landmarks")(
        *without(graph.Reprojection, graph.LandmarkPrior)(problem, state)
    )


def with_regressed_shape(problem: graph.Problem, state: graph.State) -> Start:
    """Returns the problem with β held at the regressor's value."""
    (prior,) = (f for f in problem.factors if isinstance(f, graph.ShapePrior))
    valid = jnp.isfinite(prior.sigma)
    count = valid.sum(axis=1, dtype=prior.shape.dtype)
    mean = jnp.where(valid, prior.shape, 0.0).sum(axis=1) / jnp.maximum(count, 1)
    shapes = jnp.where(valid.any(axis=1), mean, state.shapes)
    return held("shapes")(problem, dataclasses.replace(state, shapes=shapes))


FULL = "full"
VARIANTS: dict[str, Variant] = {
    FULL: lambda problem, state: (problem, state),
    "no motion model": without(graph.HumanMotion),
    "no ground": without(graph.GroundContact),
    "nothing that sees scale": without(
        graph.HumanMotion, graph.RootSmoothness, graph.GroundContact
    ),
    "no smooth path": without(graph.RootSmoothness),
    "no landmarks": without_landmarks,
    "no places seen again": without(graph.LandmarkPrior),
    "no keypoints": without(graph.KeypointReprojection),
    "no regressed postures": without(graph.BodyPosePrior),
    "no regressed orientation": without(graph.RootOrientation),
    "no steady turning": without(graph.AngularAccelerationPrior),
    "no regressed shape": without(graph.ShapePrior),
    "β held at the regressor's": with_regressed_shape,
    "cameras and map held": held("cameras", "landmarks"),
}
"""The variants of `ablation`, solved from the start of the full problem."""
