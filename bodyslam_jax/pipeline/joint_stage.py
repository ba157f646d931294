"""The joint estimate: cameras, people, map and scale in one problem (section 3.6).

Where people stand on uneven ground it is solved once more (`ground_stage.py`). Then
standing feet are held (`contact_stage.py`).
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from bodyslam_jax import graph, people, solver
from bodyslam_jax.body import BodyModel
from bodyslam_jax.config import Config
from bodyslam_jax.diagnostics.scale_uncertainty import (
    covariance_sigma,
    inflate_fitted_shapes,
)
from bodyslam_jax.geometry.vertical_edges import Edges
from bodyslam_jax.pipeline.contact_stage import hold_standing_feet
from bodyslam_jax.pipeline.ground_stage import is_uneven, with_ground_of
from bodyslam_jax.pipeline.joint_problem import Prepared, prepare
from bodyslam_jax.pipeline.own_terms import OwnTerms
from bodyslam_jax.pipeline.people_floor import people_on_floor
from bodyslam_jax.pipeline.solve_stage import solve_stage
from bodyslam_jax.types import Bodies, JointEstimate, ScaleStart, Sequence, SfmResult


@dataclasses.dataclass(frozen=True)
class Uncertainty:
    """Uncertainty of an optimum; NaN where it was not computed."""

    scale_sigma: float
    """m per unit of the map"""
    shape_covariance: Float[np.ndarray, "h 10 10"]
    unobserved: tuple[str, ...] = ()
    """Quantities that the measurements do not determine, a line each."""
    statures: Float[np.ndarray, "h 4"] | None = None
    """As in `JointEstimate`."""
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
    """The paper's graph: two steps, then the optimum of everything; with a user's `own`
    terms.

    **Raises:** as `prepare`, unless a detector looked at all images and found nobody;
    `InputError` where an own term does not fit.
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
    uncertainty = estimate_uncertainty(sequence, cameras, prepared, best, body, config)
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
    """The estimate that a state of the prepared problem is, `contacts` those of the
    contact stage."""
    return JointEstimate(
        # Before a camera that does not move it is the height of the floor.
        scale=float(state.scale) if prepared.moving else 1.0,
        start=prepared.scale,
        scale_sigma=uncertainty.scale_sigma,
        shape_covariance=uncertainty.shape_covariance,
        statures=uncertainty.statures,
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
    )


def estimate_uncertainty(
    sequence: Sequence,
    cameras: SfmResult,
    prepared: Prepared,
    best: graph.State,
    body: BodyModel,
    config: Config,
) -> Uncertainty:
    """Marginal covariances of scale and shapes at the optimum `best`, and what the
    measurements leave undetermined."""
    if not config.uncertainty:
        shapes = np.full((len(best.shapes), 10, 10), np.nan)
        return Uncertainty(np.nan, shapes)
    marginals = solver.marginals(prepared.problem, best)
    unobserved = solver.observability(prepared.problem, best, marginals)
    variance, shapes = marginals.scale, marginals.shapes
    statures = _statures(prepared, best, np.asarray(shapes), body, config)
    fitted = people.without_bodies(sequence)
    anywhere = np.any(prepared.roots.present, axis=1)
    if len(anywhere) and (fitted & anywhere).any():
        sigma = np.where(fitted, config.weights.shape_sigma, 1.0)
        variance, shapes = inflate_fitted_shapes(
            variance, shapes, best.scale, best.shapes, body, sigma, anywhere
        )
    # Smooth motion of people alone is no measurement of size: of a camera that follows
    # somebody it makes the path too short (0.57 of the truth, 0.32 its stated error).
    metric = np.isfinite(prepared.scale.standard_error)
    scale_sigma = covariance_sigma(
        float(variance), moving=prepared.moving, metric=bool(metric)
    )
    return Uncertainty(
        scale_sigma, np.asarray(shapes), tuple(unobserved), statures, marginals
    )


def _statures(
    prepared: Prepared,
    best: graph.State,
    covariance: Float[np.ndarray, "h 10 10"],
    body: BodyModel,
    config: Config,
) -> Float[np.ndarray, "h 4"] | None:
    """Given statures and those without them, with their sigma; NaN for people whose
    stature was not given."""
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
    """The estimate of a camera that does not move and sees nobody: the cameras as
    structure from motion has them, scale 1, of unknown size."""
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
