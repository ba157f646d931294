"""A problem: factors, what may move, and the motion model that predicts.

`make_problem` is the door: it checks everything that the solver relies on.
"""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from bodyslam_jax.graph.factor import Factor, FrameFactor, Limbs
from bodyslam_jax.graph.factors.body_pose_prior import BodyPosePrior
from bodyslam_jax.graph.factors.human_motion import HumanMotion
from bodyslam_jax.graph.factors.landmark_prior import LandmarkPrior
from bodyslam_jax.graph.factors.relative_orientation import RelativeOrientation
from bodyslam_jax.graph.factors.reprojection import Reprojection
from bodyslam_jax.graph.layout import Layout, make_layout
from bodyslam_jax.graph.memory import check_memory
from bodyslam_jax.graph.padding import Masked, check_padding
from bodyslam_jax.graph.state import State, Step, gauge
from bodyslam_jax.graph.tracing import is_traced
from bodyslam_jax.graph.validation import (
    check_factor,
    check_prior,
    check_shapes,
    check_state,
)
from bodyslam_jax.graph.validation_weights import check_mask, check_precision
from bodyslam_jax.motion import leg_length

VARIABLES = ("scale", "cameras", "roots", "poses", "shapes", "landmarks", "intrinsics")


class MotionPredictor(eqx.Module):
    """The motion model as the graph sees it: a state in, predictions out."""

    predict: Callable[..., Any] = eqx.field(static=True)
    """`predict(model, body, orientation, body_pose, shape, present)` of one person,
    with `translation`, `rotation`, `body_pose` in its result."""
    model: Any
    body: Any
    present: Bool[Array, "h t"]

    def __call__(self, state: State) -> Any:
        """Predictions of all people; leading axes `h t`."""
        orientation = state.cameras[:, :3, :3] @ state.roots[..., :3, :3]
        one = lambda o, p, s, there: self.predict(self.model, self.body, o, p, s, there)
        return jax.vmap(one)(orientation, state.poses, state.shapes, self.present)


class Problem(eqx.Module):
    """What `solve` minimises: the sum of the costs of its factors."""

    factors: tuple[Factor, ...]
    free: Step
    """1 where a coordinate may move, 0 where it is held."""
    motion: MotionPredictor | None
    layout: Layout
    variables: tuple[str, ...] = eqx.field(static=True, default=VARIABLES)
    """Groups that may move at all: the blocks of the others are not even formed."""

    def cost(self, state: State) -> Float[Array, ""]:
        """Negative log-likelihood, up to a constant; predictions as they stand."""
        return sum(self.cost_by_term(state).values(), jnp.zeros_like(state.scale))

    def cost_by_term(self, state: State) -> dict[str, Float[Array, ""]]:
        """The cost of each factor, by the name of its class."""
        costs = [factor.cost(state) for factor in self.factors]
        return dict(zip(self.names, costs, strict=True))

    @property
    def names(self) -> list[str]:
        """Names of the terms: the factors' classes, numbered where one repeats."""
        names: list[str] = []
        for factor in self.factors:
            inner = factor.factor if isinstance(factor, Masked) else factor
            name = type(inner).__name__
            taken = sum(other.split("_")[0] == name for other in names)
            names.append(f"{name}_{taken + 1}" if taken else name)
        return names

    def predict(self, state: State, *, frozen: bool = True) -> Any:
        """What the motion model predicts at a state; `None` without one.

        `frozen`, no gradient flows through the network: people are not drawn to
        postures for which it happens to predict what the cameras want.
        """
        if self.motion is None:
            return None
        seen = self.motion(jax.lax.stop_gradient(state) if frozen else state)
        return {
            "translation": seen.translation,
            "leg": leg_length(self.motion.body, state.shapes)[:, None, None],
            "rotation": seen.rotation,
            "body_pose": seen.body_pose,
        }

    def with_prediction(self, seen: Any) -> "Problem":
        """The same problem with this prediction in its factors."""
        if seen is None:
            return self
        factors = tuple(_with_prediction(factor, seen) for factor in self.factors)
        return eqx.tree_at(lambda p: p.factors, self, factors)

    def refresh(self, state: State) -> "Problem":
        """The same problem with the motion predicted anew."""
        return self.with_prediction(self.predict(state))


def _with_prediction(factor, seen):
    if isinstance(factor, HumanMotion) and "translation" in seen:
        unit = 1 if factor.body is None else seen["leg"]
        return eqx.tree_at(lambda f: f.translation, factor, seen["translation"] / unit)
    if isinstance(factor, RelativeOrientation) and "rotation" in seen:
        return eqx.tree_at(lambda f: f.rotation, factor, seen["rotation"])
    if isinstance(factor, BodyPosePrior) and factor.predicted and "body_pose" in seen:
        return eqx.tree_at(lambda f: f.rotation, factor, seen["body_pose"])
    return factor


def limbs_of(factors: Sequence[Factor]) -> Limbs:
    """Joints that factors see together, narrow limbs first; none that only its own
    measurements and those of other frames tie to anything."""
    found: list[set[int]] = []
    for factor in factors:
        if not isinstance(factor, FrameFactor) or factor.per_joint:
            continue
        if not any(name == "pose" for name, _ in factor.keys):
            continue
        for joints in map(set, factor.limbs):
            near = [limb for limb in found if limb & joints]
            found = [limb for limb in found if not limb & joints]
            found += [joints.union(*near)] if joints else []
    return tuple(sorted((tuple(sorted(x)) for x in found), key=lambda x: (len(x), x)))


def make_problem(
    factors: Sequence[Factor],
    state: State,
    *,
    motion: MotionPredictor | None = None,
    free_intrinsics: bool = False,
    free: Step | None = None,
) -> Problem:
    """Checks factors against a first state, holds the gauge, and lays out the blocks.

    `free` replaces the mask that follows from the factors: everything may move but the
    gauge (first camera, one coordinate of the farthest), intrinsics unless
    `free_intrinsics`, and s where no factor touches it.

    **Raises:** `ValueError` if shapes or kinds of arrays do not fit, a value is not
    finite or means nothing (a pose that is not rigid, sigma 0, a correlation of 1, a
    weight where there is no earlier frame), an index is out of range, a factor of one's
    own has another cost once frames are added that measure nothing, or the problem does
    not fit into memory.
    """
    factors = tuple(factors)
    sizes = check_state(state)
    for factor in factors:
        check_factor(factor, sizes)
        check_precision(factor, state)
        if isinstance(factor, FrameFactor):
            check_padding(factor, state)
    if motion is not None:
        check_shapes(motion, "motion", dict(sizes))
    if free is not None:
        check_shapes(free, "free", dict(sizes))
        check_mask(free)
    tracks = [f for f in factors if isinstance(f, Reprojection)]
    if len(tracks) > 1:
        raise ValueError(
            f"factors: {len(tracks)} `Reprojection`, expected one with all landmarks."
        )
    frame = np.asarray(tracks[0].frame) if tracks else np.zeros(0, int)
    landmark = np.asarray(tracks[0].landmark) if tracks else np.zeros(0, int)
    for factor in factors:
        if isinstance(factor, LandmarkPrior):
            check_prior(factor, landmark)
    limbs = limbs_of(factors)
    layout = make_layout(sizes["t"], sizes["l"], frame, landmark, sizes["h"], limbs)
    check_memory(layout, state)
    if free is None:
        touched = {
            name
            for factor in factors
            if isinstance(factor, FrameFactor)
            for name, _ in factor.keys
        }
        ones = jax.tree.map(jnp.ones_like, state.zero_step())
        free = Step(
            scale=ones.scale * float("scale" in touched),
            cameras=gauge(state.cameras),
            roots=ones.roots,
            poses=ones.poses,
            shapes=ones.shapes,
            landmarks=ones.landmarks,
            intrinsics=ones.intrinsics * float(free_intrinsics),
        )
    else:
        # `solve` knows a problem's precision by its mask.
        free = jax.tree.map(lambda x: x.astype(state.scale.dtype), free)
    moves = lambda x: is_traced(x) or bool(np.any(np.asarray(x)))
    movable = jax.tree.map(moves, free)
    variables = tuple(name for name in VARIABLES if getattr(movable, name))
    return Problem(factors, free, motion, layout, variables)
