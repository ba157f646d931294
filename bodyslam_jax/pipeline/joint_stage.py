"""The joint estimate: cameras, people, map and scale in one problem (section 3.6).

Finally, standing feet are held (`contact_stage.py`). Before that, the problem is solved
a second time if people stand on uneven ground. The ground under a foot is where the ray
through the foot meets the landmarks. Its first estimate uses people and landmarks from
before the joint estimate. A second one, at the optimum, is a fixed point: a third
changes scale by less than 0.1 %. A plane does not change with people and landmarks, so
only ground that is not a plane is estimated again (`benchmarks/contact.md`).

User-defined factors and variables are added to the complete problem, so that first
values and the initial scale depend on the video alone. While standing feet are held,
cameras, map and scale are constants, and so are the user's variables.
"""

import dataclasses
from collections.abc import Callable, Mapping
from collections.abc import Sequence as Many

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax import graph, initialisation, people, solver
from bodyslam_jax.body import BodyModel
from bodyslam_jax.config import Config, GraphWeights
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.diagnostics.scale_uncertainty import (
    covariance_sigma,
    inflate_fitted_shapes,
    leg_variance,
)
from bodyslam_jax.ground.vertical_edges import Edges
from bodyslam_jax.pipeline.contact_stage import hold_standing_feet
from bodyslam_jax.pipeline.joint_problem import Prepared, prepare, solve_stage
from bodyslam_jax.pipeline.people_floor import people_on_floor
from bodyslam_jax.types import (
    Bodies,
    JointEstimate,
    Keypoints,
    OwnFactor,
    OwnVariable,
    ScaleStart,
    Sequence,
    SfmResult,
)

Factors = Many[graph.Factor] | Callable[[graph.State], Many[graph.Factor]]
"""Factors, or a function that makes them from the initial state of the joint solve: `t`
frames, `h` people, landmarks and cameras in units of the map."""


@dataclasses.dataclass(frozen=True)
class OwnTerms:
    """Factors and variables that a user adds to the joint problem."""

    factors: Factors = ()
    variables: Mapping[str, graph.Variable] = dataclasses.field(default_factory=dict)
    """Named globals that `factors` depend on, with their priors."""

    def __bool__(self) -> bool:
        return callable(self.factors) or bool(self.factors or self.variables)

    def added_to(self, prepared: Prepared) -> Prepared:
        """Adds these terms to the prepared problem and its state.

        **Raises:** `InputError` if a factor does not fit the problem, naming it.
        """
        if not self:
            return prepared
        try:
            problem, state = prepared.problem.with_variables(
                prepared.state, **self.variables
            )
            own = self.factors
            own = own(prepared.state) if callable(own) else own
            problem = problem.with_factors(*own)
        except ValueError as error:
            raise InputError(f"factors: {error}") from error
        return dataclasses.replace(prepared, problem=problem, state=state)

    def found(
        self,
        before: graph.Problem,
        problem: graph.Problem,
        state: graph.State,
        marginals: solver.Marginals | None,
    ) -> tuple[tuple[OwnVariable, ...], tuple[OwnFactor, ...]]:
        """Returns values of the variables and misfits of the factors at the optimum.

        `state` is the optimum of `problem`, which is `before` with these terms added.
        Without `marginals` the sigmas of variables are NaN.
        """
        if not self:
            return (), ()
        values = problem.named(state.globals)
        sigma = {}
        if marginals is not None:
            sigma = problem.named(jnp.sqrt(jnp.diagonal(marginals.globals)))
        numbers = lambda x: tuple(np.atleast_1d(np.asarray(x, float)).tolist())
        variables = []
        for name, given in self.variables.items():
            unknown = jnp.full_like(values[name], jnp.nan)
            variables.append(
                OwnVariable(
                    name,
                    numbers(values[name]),
                    numbers(sigma.get(name, unknown)),
                    numbers(given.value),
                    numbers(np.broadcast_to(given.sigma, np.shape(values[name]))),
                )
            )
        # Priors of variables precede the user's factors.
        first = len(before.factors)
        factors = [
            _misfit(name, factor, state)
            for name, factor in zip(problem.names[first:], problem.factors[first:])
            if not isinstance(factor, graph.GlobalPrior)
        ]
        return tuple(variables), tuple(factors)


@dataclasses.dataclass(frozen=True)
class Uncertainty:
    """Uncertainty of an optimum; NaN where it was not computed."""

    scale_sigma: float
    """Standard deviation of the scale, m per unit of the map."""
    shape_covariance: Float[np.ndarray, "h 10 10"]
    unobserved: tuple[str, ...] = ()
    """Descriptions of quantities that the measurements do not determine, a line
    each."""
    statures: Float[np.ndarray, "h 4"] | None = None
    """Given statures and estimates without them, m, as in `JointEstimate.statures`."""
    root_covariance: Float[np.ndarray, "h t 3 3"] | None = None
    """Covariance of pelvis joints in the world, m², as in
    `JointEstimate.root_covariance`."""
    marginals: solver.Marginals | None = None
    """Marginal covariances; `None` where they were not computed."""


def estimate(
    sequence: Sequence,
    cameras: SfmResult,
    bodies: Bodies,
    body: BodyModel,
    config: Config,
    edges: Edges | None = None,
    own: OwnTerms = OwnTerms(),
) -> JointEstimate:
    """Builds and solves the joint problem, with a user's `own` terms, by the schedule
    of the paper: two partial steps, then the optimum of all variables.

    Args:
        cameras: cameras and map up to scale.
        bodies: people in the camera frame.
        edges: straight edges in the world of a camera that does not move.

    **Raises:** as `prepare`, unless a detector searched all images and found nobody;
    `InputError` if an own term does not fit the problem.
    """
    searched = sequence.detected is not None and sequence.keypoints is None
    if searched and cameras.kind != "moving" and not len(bodies.present):
        return empty_estimate(cameras)
    prepared = prepare(sequence, cameras, bodies, body, config, edges=edges)
    alone = prepared.problem
    prepared = own.added_to(prepared)
    solution, stage = solve_stage(prepared.problem, prepared.state, config, "joint")
    stages = (stage,)
    if is_uneven(prepared.problem):
        prepared = with_ground_of(
            solution.state,
            prepared,
            cameras.registered,
            sequence.keypoints,
            body,
            config.weights,
            sequence.fps,
        )
        solution, stage = solve_stage(
            prepared.problem, solution.state, config, "uneven ground"
        )
        stages += (stage,)
    best = solution.state
    uncertainty = estimate_uncertainty(sequence, prepared, best, body, config)
    standing = hold_standing_feet(prepared, best, sequence, cameras, body, config)
    variables, factors = own.found(alone, prepared.problem, best, uncertainty.marginals)
    estimate = of_state(
        standing.state,
        prepared,
        uncertainty,
        str(solution.status),
        (*stages, *standing.stages),
        standing.probability,
    )
    return dataclasses.replace(estimate, own_variables=variables, own_factors=factors)


def of_state(
    state: graph.State,
    prepared: Prepared,
    uncertainty: Uncertainty,
    status: str,
    stages: tuple[dict, ...],
    contacts: Float[np.ndarray, "h t 4"] | None = None,
) -> JointEstimate:
    """Converts a state of the prepared problem to a `JointEstimate`; `contacts` are the
    contact probabilities of the contact stage."""
    return JointEstimate(
        # With a camera that does not move, s is the height of the floor.
        scale=float(state.scale) if prepared.moving else 1.0,
        start=prepared.scale,
        scale_sigma=uncertainty.scale_sigma,
        shape_covariance=uncertainty.shape_covariance,
        statures=uncertainty.statures,
        root_covariance=uncertainty.root_covariance,
        unobserved=(
            *prepared.warnings,
            *(f"not well determined: {line}" for line in uncertainty.unobserved),
        ),
        cameras=np.asarray(state.cameras),
        roots=np.asarray(state.roots),
        poses=np.asarray(state.poses),
        shapes=np.asarray(state.shapes),
        landmarks=np.asarray(state.landmarks),
        intrinsics=np.asarray(state.intrinsics),
        present=prepared.roots.present,
        status=status,
        stages=stages,
        contacts=contacts,
        on_floor=None if prepared.moving else people_on_floor(prepared.problem),
        above_ground=_above_ground(prepared.problem),
    )


def _above_ground(problem: graph.Problem) -> Float[np.ndarray, "h t 3"] | None:
    """Returns the upward vectors from the ground to what people stand on, m; `None` if
    everybody stands on the ground itself."""
    for factor in problem.factors:
        if isinstance(factor, graph.GroundContact) and np.any(factor.height):
            return np.asarray(factor.height)[..., None] * np.asarray(factor.normal)
    return None


def estimate_uncertainty(
    sequence: Sequence,
    prepared: Prepared,
    best: graph.State,
    body: BodyModel,
    config: Config,
) -> Uncertainty:
    """Returns the marginal covariances of scale, shapes and pelvis joints at the
    optimum `best`, and the quantities that the measurements do not determine."""
    if not config.uncertainty:
        shapes = np.full((len(best.shapes), 10, 10), np.nan)
        return Uncertainty(np.nan, shapes)
    marginals = solver.marginals(prepared.problem, best)
    unobserved = solver.observability(prepared.problem, best, marginals)
    variance, shapes = marginals.scale, marginals.shapes
    statures = _statures(prepared, best, np.asarray(shapes), body, config)
    fitted = people.without_bodies(sequence)
    anywhere = np.any(prepared.roots.present, axis=1)
    hidden = np.zeros(len(anywhere))
    if len(anywhere) and (fitted & anywhere).any():
        sigma = np.where(fitted, config.weights.shape_sigma, 1.0)
        variance, shapes = inflate_fitted_shapes(
            variance, shapes, best.scale, best.shapes, body, sigma, anywhere
        )
        more = shapes - marginals.shapes
        hidden = np.asarray(leg_variance(body, best.shapes, more), float)
    # Smoothness of people's motion alone does not measure scale: if the camera follows
    # a person, the path becomes too short (0.57 of the truth, with a sigma of 0.32).
    metric = np.isfinite(prepared.scale.standard_error)
    scale_sigma = covariance_sigma(
        float(variance), moving=prepared.moving, metric=bool(metric)
    )
    return Uncertainty(
        scale_sigma,
        np.asarray(shapes),
        tuple(unobserved),
        statures,
        root_covariance=_root_covariance(prepared, best, marginals, hidden),
        marginals=marginals,
    )


def _root_covariance(
    prepared: Prepared,
    best: graph.State,
    marginals: solver.Marginals,
    hidden: Float[np.ndarray, " h"],
) -> Float[np.ndarray, "h t 3 3"] | None:
    """Returns the covariance of pelvis joints in the world, m²; `None` where it is not
    finite.

    Args:
        hidden: relative variance of each person's size that the tightened shape prior
            hides (`inflate_fitted_shapes`). The scale of the map follows people's size,
            so that it moves a person along the line from the first camera.
    """
    cameras = np.asarray(best.cameras, float)
    centre = cameras[:, :3, 3] * (float(best.scale) if prepared.moving else 1.0)
    to = np.einsum("tab,htb->hta", cameras[:, :3, :3], best.roots[..., :3, 3]) + centre
    more = hidden[:, None, None, None] * to[..., :, None] * to[..., None, :]
    found = np.asarray(marginals.people, float) + more
    found = np.where(prepared.roots.present[..., None, None], found, 0.0)
    return found if np.isfinite(found).all() else None


def _statures(
    prepared: Prepared,
    best: graph.State,
    covariance: Float[np.ndarray, "h 10 10"],
    body: BodyModel,
    config: Config,
) -> Float[np.ndarray, "h 4"] | None:
    """Returns given statures, and estimates without them, each with its sigma, m; NaN
    for people without a given stature, `None` without any."""
    crowd = prepared.crowd
    if crowd is None or not crowd.statures:
        return None
    found = np.full((len(covariance), 4), np.nan)
    for h, given in crowd.statures.items():
        present = crowd.roots.present[h]
        if not present.any():
            continue
        times = present.sum() if config.weights.shape_each_frame else 1
        sigma = config.weights.shape_sigma / float(times) ** 0.5
        without = people.stature_without(
            body,
            given,
            np.asarray(best.shapes[h], float),
            np.asarray(covariance[h], float),
            (crowd.roots.shape[h], sigma),
            crowd.unaided[h],
            float(crowd.unaided_sigma[h]),
        )
        found[h] = *given, without.value, without.sigma
    return found


def empty_estimate(cameras: SfmResult) -> JointEstimate:
    """Returns the estimate for a camera that does not move and sees nobody: the cameras
    of structure from motion, with scale 1 of unknown uncertainty."""
    frames = len(cameras.registered)
    return JointEstimate(
        scale=1.0,
        start=ScaleStart(),
        scale_sigma=float("nan"),
        shape_covariance=np.zeros((0, 10, 10)),
        unobserved=(),
        cameras=np.asarray(cameras.T_WC),
        roots=np.zeros((0, frames, 4, 4)),
        poses=np.zeros((0, frames, 23, 3)),
        shapes=np.zeros((0, 10)),
        landmarks=np.asarray(cameras.landmarks),
        intrinsics=np.asarray(cameras.intrinsics),
        present=np.zeros((0, frames), bool),
        status="converged",
        stages=(),
    )


def with_ground_of(
    state: graph.State,
    prepared: Prepared,
    registered: Bool[np.ndarray, " t"],
    keypoints: Keypoints | None,
    body: BodyModel,
    weights: GraphWeights,
    fps: float,
) -> Prepared:
    """Returns the problem with the ground estimated again from people and landmarks of
    `state`; `prepared` itself if there is no ground, or too little of it."""
    factors = prepared.problem.factors
    old = next((f for f in factors if isinstance(f, graph.GroundContact)), None)
    present = prepared.roots.present & registered
    if prepared.legs_shown is not None:
        present = present & prepared.legs_shown
    contact = initialisation.ground_contact(
        state, present, keypoints, body, weights, fps
    )
    if old is None or contact is None:
        return prepared
    contact = initialisation.with_elevation(contact, state, fps)
    changed = tuple(contact if factor is old else factor for factor in factors)
    return dataclasses.replace(
        prepared, problem=dataclasses.replace(prepared.problem, factors=changed)
    )


def is_uneven(problem: graph.Problem) -> bool:
    """Returns True if people stand on ground that is not one plane."""
    grounds = [f for f in problem.factors if isinstance(f, graph.GroundContact)]
    used = [np.asarray(f.offset)[np.isfinite(np.asarray(f.sigma))] for f in grounds]
    return any(len(offset) > 0 and np.ptp(offset) > 0 for offset in used)


def _misfit(name: str, factor: graph.Factor, state: graph.State) -> OwnFactor:
    """Returns the misfit of a factor; residuals of exactly 0 count as missing."""
    residual = np.asarray(graph.residual_of(factor, state))
    count = int(np.count_nonzero(residual))
    cost = float(factor.cost(state))
    return OwnFactor(name, count, cost, (2 * cost / count) ** 0.5 if count else 0.0)
