"""Other problems from the same measurements: terms off, terms on, variables held."""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from bodyslam_jax import graph
from bodyslam_jax.body import BodyModel
from bodyslam_jax.config import GraphWeights
from bodyslam_jax.experiments.problems import rebuild
from bodyslam_jax.initialisation import upright_factor

_SEE_SCALE = (
    graph.HumanMotion,
    graph.RootSmoothness,
    graph.GroundContact,
)
"""What ties the map's unit to metres."""

Start = tuple[graph.Problem, graph.State]
Variant = Callable[[graph.Problem, graph.State], Start]

ASKED_FOR = GraphWeights(upright_sigma=0.1)
"""Of what is off by default: how upright people walk, rad."""
_FPS = 30.0
"""Of the simulated sequences."""


def without(*kinds: type[graph.Factor]) -> Variant:
    """The problem without these terms; s is held where nothing is left to see it.

    Where they measure nothing, it is the very problem that was given.
    """

    def variant(problem: graph.Problem, state: graph.State) -> Start:
        muted = graph.disable(problem, *kinds)
        if eqx.tree_equal(muted, problem):
            return problem, state
        seeing = [f for f in problem.factors if isinstance(f, _SEE_SCALE)]
        if all(isinstance(f, kinds) for f in seeing):
            muted = dataclasses.replace(
                muted, free=graph.set_constant(muted.free, "scale")
            )
        return muted, state

    return variant


def held(*names: str) -> Variant:
    """The problem with these groups of variables as they are at the start."""

    def variant(problem: graph.Problem, state: graph.State) -> Start:
        free = graph.set_constant(problem.free, *names)
        return dataclasses.replace(problem, free=free), state

    return variant


def without_landmarks(problem: graph.Problem, state: graph.State) -> Start:
    """No point of the map is seen; points stay, since nothing else says where they
    are, and cameras are free."""
    return held("landmarks")(
        *without(graph.Reprojection, graph.LandmarkPrior)(problem, state)
    )


def with_regressed_shape(problem: graph.Problem, state: graph.State) -> Start:
    """β as the regressor has it, not as people alone have moved it, and held there."""
    (said,) = (f for f in problem.factors if isinstance(f, graph.ShapePrior))
    known = jnp.isfinite(said.sigma)
    count = known.sum(axis=1, dtype=said.shape.dtype)
    mean = jnp.where(known, said.shape, 0.0).sum(axis=1) / jnp.maximum(count, 1)
    shapes = jnp.where(known.any(axis=1), mean, state.shapes)
    return held("shapes")(problem, dataclasses.replace(state, shapes=shapes))


def beside(
    make: Callable[
        [BodyModel, graph.State, Bool[np.ndarray, "h t"]], graph.Factor | None
    ],
) -> Variant:
    """One more term, if there is anything for it to say."""

    def variant(problem: graph.Problem, state: graph.State) -> Start:
        body, present = _person(problem)
        more = make(body, state, np.asarray(present))
        factors = problem.factors if more is None else [*problem.factors, more]
        return rebuild(problem, state, factors), state

    return variant


def _person(problem: graph.Problem) -> tuple[BodyModel, Bool[Array, "h t"]]:
    motion = problem.motion
    if motion is not None:
        return motion.body, motion.present
    for factor in problem.factors:  # where predictions stay as they are
        if isinstance(factor, graph.KeypointReprojection):
            return factor.body, jnp.isfinite(factor.sigma).any(axis=-1)
    raise ValueError("the problem has no people; expected a moving person.")


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
    "with up direction": beside(
        lambda body, state, there: upright_factor(state, there, _FPS, ASKED_FOR)
    ),
}
"""What `ablation` solves, from the start of the full problem but for what is held."""
