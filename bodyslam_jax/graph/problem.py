"""The optimisation problem: factors, the mask of free variables, the motion model.

Problems are made by `make_problem`, which checks everything that the solver relies on.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from bodyslam_jax.geometry.lengths import LENGTHS, is_traced
from bodyslam_jax.graph.factor import Factor, FrameFactor
from bodyslam_jax.graph.factors.body_pose_prior import BodyPosePrior
from bodyslam_jax.graph.factors.human_motion import HumanMotion
from bodyslam_jax.graph.factors.marginal_prior import MarginalPrior
from bodyslam_jax.graph.factors.reprojection import LandmarkPrior, Reprojection
from bodyslam_jax.graph.globals import (
    GlobalPrior,
    Named,
    Variable,
    bound,
    split,
    vector_of,
)
from bodyslam_jax.graph.layout import (
    CHUNK_LANDMARKS,
    Layout,
    Tracks,
    is_dense,
    layouts_of_one_size,
    make_layout,
)
from bodyslam_jax.graph.ordering import CHUNK
from bodyslam_jax.graph.padding import Masked, check_padding, extend
from bodyslam_jax.graph.state import TURNS, State, Step, gauge
from bodyslam_jax.graph.terms import TermCosts, names_of_terms
from bodyslam_jax.graph.validation import (
    Sizes,
    check_basis,
    check_measurements,
    check_memory,
    check_prior,
    check_shapes,
    check_state,
)
from bodyslam_jax.graph.validation_weights import check_mask, check_precision
from bodyslam_jax.motion import Clock, leg_length

VARIABLES = (
    *("scale", "cameras", "roots", "poses", "shapes", "landmarks", "intrinsics"),
    "globals",
)
"""Groups of variables: the fields of `State`."""


class MotionPredictor(eqx.Module):
    """A motion model bound to its parameters and the body: predicts from a state."""

    predict: Callable[..., Any] = eqx.field(static=True)
    """`predict(model, body, orientation, body_pose, shape, present)` of one person,
    with `translation`, `rotation`, `body_pose` in its result, and `valid` where it does
    not predict all steps."""
    model: Any
    body: Any
    present: Bool[Array, "h t"]

    def lengthened(self, frames: int) -> "MotionPredictor":
        """Returns the predictor for `frames` frames, with nobody present in those that
        are added at the end."""
        present = extend(self.present, 1, frames - self.present.shape[1], False)
        of_clock = lambda x: isinstance(x, Clock)
        stretch = lambda x: x.lengthened(frames) if of_clock(x) else x
        model = jax.tree.map(stretch, self.model, is_leaf=of_clock)
        return dataclasses.replace(self, model=model, present=present)

    def from_frame(self, start: int) -> "MotionPredictor":
        """Returns the predictor for the sequence from frame `start` on."""
        of_clock = lambda x: isinstance(x, Clock)
        cut = lambda x: x.from_frame(start) if of_clock(x) else x
        model = jax.tree.map(cut, self.model, is_leaf=of_clock)
        return dataclasses.replace(self, model=model, present=self.present[:, start:])

    def __call__(self, state: State) -> Any:
        """Returns the predictions of all people; leading axes `h t`."""
        orientation = state.cameras[:, :3, :3] @ state.roots[..., :3, :3]
        one = lambda *person: self.predict(self.model, self.body, *person)
        return jax.vmap(one)(orientation, state.poses, state.shapes, self.present)


class Problem(eqx.Module):
    """A sum of the costs of factors, which `solve` minimises over a state."""

    factors: tuple[Factor, ...]
    free: Step
    """1 for coordinates that are estimated, 0 for those that are held constant."""
    motion: MotionPredictor | None
    layout: Layout
    variables: tuple[str, ...] = eqx.field(static=True, default=VARIABLES)
    """Groups of variables with at least one free coordinate. Blocks of the Hessian of
    the other groups are not formed."""
    globals: Named = eqx.field(static=True, default=())
    """Names and sizes of the variables in `State.globals`."""
    basis: Float[Array, "69 k"] | None = None
    """Orthonormal columns that span the turns of the 23 joints (rad, each in its own
    frame) in a step. The part of a posture that they do not span stays as in the first
    state. `None` for all turns."""

    def cost(self, state: State, *, held: bool = False) -> Float[Array, ""]:
        """Returns the negative log-likelihood, up to a constant.

        Predictions of the motion model are made at `state`, and no gradient flows
        through them; with `held` they are those in the factors, as within a step of the
        solver.
        """
        costs = self.cost_by_term(state, held=held).values()
        return sum(costs, jnp.zeros_like(state.scale))

    def cost_by_term(self, state: State, *, held: bool = False) -> TermCosts:
        """Returns the cost of each term by its name (`graph/terms.py`); `held` as in
        `cost`. The result is a `dict` that accepts names of factors' classes too."""
        problem = self if held else self.refresh(state)
        costs = [factor.cost(state) for factor in problem.factors]
        return TermCosts(zip(self.names, costs, strict=True))

    @property
    def names(self) -> list[str]:
        """Returns the name of each factor's term, as in `weights`: `human_motion`,
        `keypoints`, numbered from the second term of a name on (`graph/terms.py`)."""
        return names_of_terms(self.factors)

    def predict(self, state: State, *, frozen: bool = True) -> Any:
        """Returns the motion model's prediction at a state, `None` without a model.

        With `frozen`, no gradient flows through the network. Otherwise postures would
        be moved to where the network happens to predict the displacements that the
        camera poses require.
        """
        if self.motion is None:
            return None
        found = self.motion(jax.lax.stop_gradient(state) if frozen else state)
        prediction = {
            "leg": leg_length(self.motion.body, state.shapes)[:, None, None],
            "valid": getattr(found, "valid", None),
        }
        # What no factor takes is left out, so that it is not computed.
        for name in map(_predicted_by, self.factors):
            if name is not None:
                prediction[name] = getattr(found, name)
        return prediction

    def with_prediction(self, prediction: Any) -> "Problem":
        """Returns the problem with a prediction (`predict`) in its factors; they keep
        their own where it is not valid, as the sequence does not hold its whole
        window."""
        if prediction is None:
            return self
        factors = tuple(_with_prediction(f, prediction) for f in self.factors)
        return eqx.tree_at(lambda p: p.factors, self, factors)

    def refresh(self, state: State) -> "Problem":
        """Returns the problem with the motion model's prediction at `state`."""
        return self.with_prediction(self.predict(state))

    def with_motion_model(
        self, predict: Callable[..., Any], parameters: Any
    ) -> "Problem":
        """Returns the problem with another motion model, with which `solve` predicts.

        `predict(parameters, body, orientation, body_pose, shape, present)` is called
        for one person: root rotations (t, 3, 3) to the world, joint rotations
        (t, 23, 3) in rad, SMPL β (10,), presence (t,). It returns a
        `motion.Prediction`: row k is the step from frame k-1 to k. The weight of each
        step stays that of the model with which the problem was built (`with_weights`
        changes it).

        **Raises:** `ValueError` if the problem has no motion model: no people, or
        `motion_coupling="frozen"`.
        """
        if self.motion is None:
            raise ValueError(
                "problem.motion: found none, expected a problem with people and "
                "`motion_coupling` other than `frozen`."
            )
        other = dataclasses.replace(self.motion, predict=predict, model=parameters)
        return dataclasses.replace(self, motion=other)

    def with_variables(
        self, state: State, **variables: Variable
    ) -> tuple["Problem", State]:
        """Returns the problem and state with more named globals, which are free.

        Their priors are factors (`GlobalPrior`). Other factors that depend on them are
        added by `with_factors`.

        **Raises:** `ValueError` for a name that is taken or no identifier, a value that
        is not finite, or a sigma that is not above 0.
        """
        dtype = state.scale.dtype
        found = {n: vector_of(n, v, dtype) for n, v in variables.items()}
        taken = [name for name, _ in self.globals if name in found]
        if taken:
            raise ValueError(f"variables: {taken[0]!r} is a variable already.")
        values = [value for value, _ in found.values()]
        more = jnp.concatenate([state.globals[:0], *values])
        state = dataclasses.replace(
            state, globals=jnp.concatenate([state.globals, more])
        )
        free = dataclasses.replace(
            self.free,
            globals=jnp.concatenate([self.free.globals, jnp.ones_like(more)]),
        )
        named = (*self.globals, *((n, len(v)) for n, (v, _) in found.items()))
        kept = tuple(
            v for v in VARIABLES if v in self.variables or (v == "globals" and named)
        )
        problem = dataclasses.replace(self, free=free, globals=named, variables=kept)
        priors = [
            GlobalPrior(mean=value, sigma=sigma, name=name)
            for name, (value, sigma) in found.items()
            if is_traced(sigma) or np.isfinite(np.asarray(sigma)).any()
        ]
        return problem.with_factors(*priors), state

    def named(self, values: Float[Array, "*b g"]) -> dict[str, Float[Array, "*b _"]]:
        """Returns each named global of `State.globals`, by its name."""
        return dict(split(self.globals, values))

    def with_factors(self, *factors: Factor) -> "Problem":
        """Returns the problem with more factors; states of this problem fit it, too.

        Checks and layout are those of `make_problem`. Named globals of `factors` must
        be variables of the problem (`with_variables`). What is held stays held, except
        a scale that no factor depended on so far and one of `factors` does: it is free
        in what this returns. A custom factor is best checked first (`check_factor`).

        **Raises:** `ValueError` naming the factor and its field where shapes, kinds or
        values do not fit, or if there would be two `Reprojection`.
        """
        sizes = dict[str, int]()
        factors = tuple(bound(factor, self.globals) for factor in factors)
        check_shapes(self.free, "problem.free", sizes)
        sample = _sample_state(self.free)
        for factor in factors:
            check_measurements(factor, sizes)
            check_precision(factor, sample)
            if isinstance(factor, FrameFactor):
                check_padding(factor, sample)
        everything = (*self.factors, *factors)
        layout = self.layout
        laid = Reprojection | LandmarkPrior | MarginalPrior
        if any(isinstance(f, laid) for f in factors):
            layout = layout_of(everything, sizes, None)
            width = TURNS if self.basis is None else self.basis.shape[1]
            check_memory(layout, sample, width)
        free, variables = self.free, self.variables
        if "scale" in _variables_of(factors) - _variables_of(self.factors):
            free = dataclasses.replace(free, scale=jnp.ones_like(free.scale))
            variables = tuple(v for v in VARIABLES if v in (*variables, "scale"))
        return dataclasses.replace(
            self, factors=everything, free=free, layout=layout, variables=variables
        )


def _predicted_by(factor: Factor) -> str | None:
    """Returns the name of the prediction that a factor takes, if it takes one."""
    if isinstance(factor, Masked):
        return _predicted_by(factor.factor)
    if isinstance(factor, HumanMotion):
        return "translation"
    if isinstance(factor, BodyPosePrior) and factor.predicted:
        return "body_pose"
    return None


def _with_prediction(factor: Factor, prediction: dict[str, Array]) -> Factor:
    """Returns the factor with its predicted measurements replaced, if it has any."""
    if isinstance(factor, Masked):
        inner = _with_prediction(factor.factor, prediction)
        return eqx.tree_at(lambda f: f.factor, factor, inner)
    name = _predicted_by(factor)
    if name not in prediction:
        return factor
    if isinstance(factor, HumanMotion):
        unit = 1 if factor.body is None else prediction["leg"]
        value = prediction["translation"] / unit
        return _predicted(factor, "translation", value, prediction)
    return _predicted(factor, "rotation", prediction[name], prediction)


def _predicted(factor: Factor, name: str, value: Array, prediction: Any) -> Factor:
    valid, known = prediction.get("valid"), getattr(factor, name)
    if valid is not None:
        valid = valid.reshape(*valid.shape, *(1,) * (known.ndim - valid.ndim))
        value = jnp.where(valid, value, known)
    return eqx.tree_at(lambda f: getattr(f, name), factor, value)


def make_problem(
    factors: Sequence[Factor],
    state: State,
    *,
    motion: MotionPredictor | None = None,
    free_intrinsics: bool = False,
    free: Step | None = None,
    common_sizes: bool | None = None,
    named: Named = (),
    basis: Float[Array | np.ndarray, "m k"] | None = None,
) -> Problem:
    """Checks factors against a first state, fixes the gauge, and lays out the blocks.

    By default everything is free except the gauge (the first camera, and one coordinate
    of the camera farthest from it), the intrinsics unless `free_intrinsics`, and the
    scale s if no factor depends on it. `free` replaces this mask.

    `common_sizes` pads the problem to one of a few sizes (`graph/layout.py`), whose
    compiled programs videos of other lengths share. By default (`None`) a problem
    without people that has 200 frames or more and more than six landmarks a frame is
    not padded so: it compiles a program of its own, whose steps take half the time.

    `named` has the names and sizes of `state.globals`; `Problem.with_variables` adds
    named globals to a problem with their priors.

    `basis` has the turns of joints that steps may give a posture, as orthonormal
    columns, such as `people.posture_basis()`: what it does not span stays as in the
    first state. By default it is all turns, which takes longer to compile and to solve.

    **Raises:** `ValueError` if shapes or dtypes of arrays do not fit, a value is not
    finite or not valid (a pose that is not rigid, sigma 0, a correlation of 1, a weight
    in a frame without an earlier one), an index is out of range, padding changes the
    cost of a custom factor, or the problem does not fit into memory.
    """
    sizes = check_state(state)
    known = sum(size for _, size in named)
    if known != sizes["g"]:
        raise ValueError(
            f"named: {known} coordinates, expected the {sizes['g']} of state.globals."
        )
    factors = tuple(bound(factor, named) for factor in factors)
    for factor in factors:
        check_measurements(factor, sizes)
        check_precision(factor, state)
        if isinstance(factor, FrameFactor):
            check_padding(factor, state)
    if motion is not None:
        check_shapes(motion, "motion", dict(sizes))
    if free is not None:
        check_shapes(free, "free", dict(sizes))
        check_mask(free)
    layout = layout_of(factors, sizes, common_sizes)
    check_memory(layout, state, TURNS if basis is None else basis.shape[1])
    mask: Step
    if free is None:
        ones = jax.tree.map(jnp.ones_like, state.zero_step())
        mask = Step(
            scale=ones.scale * float("scale" in _variables_of(factors)),
            cameras=gauge(state.cameras),
            roots=ones.roots,
            poses=ones.poses,
            shapes=ones.shapes,
            landmarks=ones.landmarks,
            intrinsics=ones.intrinsics * float(free_intrinsics),
            globals=ones.globals,
        )
    else:
        # `solve` knows a problem's precision by its mask.
        mask = jax.tree.map(lambda x: x.astype(state.scale.dtype), free)
    moves = lambda x: is_traced(x) or bool(np.any(np.asarray(x)))
    movable = jax.tree.map(moves, mask)
    variables = tuple(name for name in VARIABLES if getattr(movable, name))
    if basis is not None:
        basis = check_basis(basis, state.scale.dtype)
    return Problem(factors, mask, motion, layout, variables, named, basis)


def _variables_of(factors: Sequence[Factor]) -> set[str]:
    """Returns the names (as in `Key`) of the variables that any `FrameFactor` depends
    on, with the scale if a `MarginalPrior` has people."""
    over_frames = [f for f in factors if isinstance(f, FrameFactor)]
    known = {name for factor in over_frames for name, _ in factor.touched}
    priors = [f for f in factors if isinstance(f, MarginalPrior)]
    of_people = any(len(prior.estimate.roots) for prior in priors)
    return known | ({"scale"} if of_people else set())


def layout_of(
    factors: Sequence[Factor], sizes: Sizes, common_sizes: bool | None
) -> Layout:
    """Returns the layout of landmark observations in dense tables (`graph/layout.py`).

    **Raises:** `ValueError` for two `Reprojection` or `MarginalPrior`, and for priors
    of landmarks without an observation.
    """
    frame, landmark, front = _tracks_of(factors)
    for factor in factors:
        if isinstance(factor, LandmarkPrior):
            check_prior(factor, landmark)
    if common_sizes is None:
        common_sizes = not is_dense(sizes["t"], sizes["l"], sizes["h"])
    given = sizes["t"], sizes["l"], frame, landmark, sizes["h"]
    return make_layout(*given, common_sizes=common_sizes, front=front)


def _tracks_of(factors: Sequence[Factor]) -> tuple[np.ndarray, np.ndarray, int]:
    """Returns frame and landmark of each observation, and the number of chunks that a
    `MarginalPrior` couples."""
    priors = [f for f in factors if isinstance(f, MarginalPrior)]
    if len(priors) > 1:
        raise ValueError(f"factors: {len(priors)} `MarginalPrior`, expected one.")
    front = -(-priors[0].frames // CHUNK) if priors else 0
    tracks = [f for f in factors if isinstance(f, Reprojection)]
    if len(tracks) > 1:
        raise ValueError(
            f"factors: {len(tracks)} `Reprojection`, expected one with all landmarks."
        )
    frame = np.asarray(tracks[0].frame) if tracks else np.zeros(0, int)
    landmark = np.asarray(tracks[0].landmark) if tracks else np.zeros(0, int)
    return frame, landmark, front


def in_one_layout(cases: Sequence[tuple[Problem, State]]) -> list[Problem]:
    """Returns the problems with layouts of equal shapes, the smallest ones that hold
    all of them.

    **Raises:** `ValueError` if no common size holds each of them.
    """
    tracks = []
    for problem, state in cases:
        frame, landmark, front = _tracks_of(problem.factors)
        size = len(state.cameras), len(state.landmarks)
        tracks.append(Tracks(*size, frame, landmark, front))
    layouts = layouts_of_one_size(tracks)
    if layouts is None:
        frames, landmarks = max(t[0] for t in tracks), max(t[1] for t in tracks)
        raise ValueError(
            f"cases: up to {frames} frames and {landmarks} landmarks, expected what "
            f"fits one of the common sizes, of up to {LENGTHS[-1]} frames with "
            f"{CHUNK_LANDMARKS} landmarks for each {CHUNK}; or tracks are too long for "
            "it."
        )
    return [
        dataclasses.replace(problem, layout=layout)
        for (problem, _), layout in zip(cases, layouts, strict=True)
    ]


def _sample_state(free: Step) -> State:
    """Returns an arbitrary valid state with the shapes and dtype of `free`, for checks.

    All cameras are at the origin; people and landmarks are 3 m in front of them.
    """
    eye = lambda x: (
        jnp.zeros((*x.shape[:-1], 4, 4), x.dtype) + jnp.eye(4, dtype=x.dtype)
    )
    # Convention: an image of 640x480 px, seen from 3 m; any regular state will do.
    depth, pinhole = 3.0, jnp.array([500.0, 500.0, 320.0, 240.0])
    intrinsics = jnp.zeros_like(free.intrinsics)
    return State(
        scale=jnp.ones_like(free.scale),
        cameras=eye(free.cameras),
        roots=eye(free.roots).at[..., 2, 3].set(depth),
        poses=jnp.zeros_like(free.poses),
        shapes=jnp.zeros_like(free.shapes),
        landmarks=jnp.zeros_like(free.landmarks).at[:, 2].set(depth),
        intrinsics=intrinsics.at[:4].set(pinhole),
        globals=jnp.zeros_like(free.globals),
    )
