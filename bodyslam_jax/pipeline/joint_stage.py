"""The joint estimate: cameras, people, map and scale in one problem (section 3.6)."""

import dataclasses
import logging
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax import body as body_
from bodyslam_jax import graph, initialisation, motion, people, solver
from bodyslam_jax.config import PATH_SIGMA, Config
from bodyslam_jax.people import PersonState
from bodyslam_jax.types import Bodies, JointEstimate, ScaleStart, Sequence, SfmResult

log = logging.getLogger(__name__)

COST_ATOL = 0.005
"""Decrease of the cost that is not worth a step: the cost is a negative log-likelihood,
in which a standard deviation is a half. Without it, a few landmarks that are seen from
one place creep for dozens of steps, to no effect on anything else."""


@dataclasses.dataclass(frozen=True)
class Prepared:
    """A joint problem and where its solution starts."""

    problem: graph.Problem
    state: graph.State
    scale: ScaleStart
    roots: PersonState
    moving: bool
    """Whether the camera's path has a scale to be found."""
    stages: tuple[dict, ...]
    """What was solved on the way, for the report."""
    warnings: tuple[str, ...] = ()
    """Lines for the report."""


def prepare(
    sequence: Sequence,
    cameras: SfmResult,
    bodies: Bodies,
    body: body_.BodyModel,
    config: Config,
    *,
    body_only_solve: bool = True,
) -> Prepared:
    """People by themselves, the first scale in closed form, then the whole graph.

    Without `body_only_solve` nothing is solved: people start as their bodies are given.

    Postures are settled from keypoints before the motion model reads them: errors of a
    regressor's orientations bias the displacements that it predicts.

    **Raises:** `ValueError` if there is neither a moving camera nor a person.
    """
    within = cameras.within
    bodies = dataclasses.replace(bodies, present=bodies.present & within)
    roots = people.roots_from_bodies(bodies, body)
    fitted = people.without_bodies(sequence)
    numbers = config.person or range(len(roots.present))
    statures = people.statures_of(config.heights(), list(dict.fromkeys(numbers)))
    measured = roots.shape
    if statures:
        unsure = np.where(fitted, 1.0, config.weights.shape_sigma)
        roots = people.with_statures(roots, statures, body, unsure)
        # The graph holds fitted shapes tighter than they are known.
        measured = np.where(fitted[:, None], roots.shape, measured)
    state = initialisation.first_state(
        cameras.T_WC, cameras.landmarks, roots, cameras.intrinsics
    )
    predictor = motion_predictor(sequence, roots, body, config)
    moving = cameras.kind == "moving"
    start = ScaleStart()
    contact = None
    weights = config.weights
    shared = np.where(fitted, weights.fitted_step_error, weights.step_error)
    told = shared[roots.present.any(axis=1)] if roots.present.any() else shared
    stages = []
    carried: dict[int, tuple[float, float]] = {}
    factors = []
    if moving:
        sigma = initialisation.landmark_sigma(cameras.pixel_sigma, weights)
        factors.append(
            initialisation.map_factor(cameras.tracks, cameras.keep, sigma, weights)
        )
        factors.append(
            initialisation.revisit_factor(
                cameras.prior_mean, cameras.prior_information, sigma
            )
        )
        factors += initialisation.path_factors(
            cameras.path, cameras.path_known, cameras.path_scale
        )
    anybody = len(roots.present) > 0
    free = None if moving else initialisation.free_people(state)

    def make(factors, state):
        with_motion = predictor if anybody else None
        problem = graph.make_problem(factors, state, motion=with_motion, free=free)
        if within.all() or not moving:
            return problem
        # Nothing says where cameras beyond a cut are.
        mask = jnp.zeros_like(problem.free.cameras)
        mask = mask.at[within].set(graph.gauge(state.cameras[within]))
        return eqx.tree_at(lambda p: p.free.cameras, problem, mask)

    if anybody:
        seen = predict(predictor, state)
        known = seen.valid if weights.posture_predicted else None
        factors += initialisation.people_factors(
            sequence, roots, weights, body, shape=measured, predicted=known
        )
        if statures:
            factors.append(initialisation.stature_factor(statures, roots.present, body))
        there = roots.present & cameras.registered
        walked = lambda seen, state: [
            initialisation.motion_factor(
                seen,
                state.shapes,
                body,
                weights,
                shared_error=shared,
                without=carried,
            ),
            *initialisation.optional_factors(seen, sequence.fps, weights),
        ]
        if moving:
            contact = initialisation.ground_contact(
                state,
                roots,
                cameras.registered,
                sequence.keypoints,
                body,
                weights,
            )
        if contact is not None:
            factors.append(contact)
        upright = initialisation.upright_factor(state, there, sequence.fps, weights)
        if upright is not None:
            factors.append(upright)
        if body_only_solve:
            problem = make([*factors, *walked(seen, state)], state)
            state, stage = _settle_people(problem, state, config)
            stages.append(stage)
            seen = predict(predictor, state)
        if moving:
            start_of = lambda without: initialisation.scale_start(
                state,
                seen,
                contact,
                shared_error=float(told.min()),
                path=cameras.path_scale,
                without=without,
            )
            start = start_of(())
            others = start.without_motion()
            if np.isfinite(others.standard_error):
                carried = initialisation.carried(
                    state, seen, there, others.value, sequence.fps
                )
                start = start_of(carried) if carried else start
            log.info(
                "scale: %.4g ± %.2g (motion %.4g ± %.2g, ground %.4g ± %.2g)",
                *(start.value, start.standard_error),
                *(start.motion, start.motion_error),
                *(start.ground, start.ground_error),
            )
            state = eqx.tree_at(lambda s: s.scale, state, jnp.asarray(start.value))
        else:
            carried = initialisation.carried(state, seen, there, 1.0, sequence.fps)
        factors += walked(seen, state)
    elif moving and np.isfinite(cameras.path_scale):
        start = ScaleStart(
            path=cameras.path_scale, path_error=PATH_SIGMA * cameras.path_scale
        )
        state = eqx.tree_at(lambda s: s.scale, state, jnp.asarray(start.value))
    if not factors:
        raise ValueError(
            f"{sequence.name}: no landmarks and no people; expected a camera moving "
            "before a textured background, or people's keypoints."
        )
    problem = make(factors, state)
    if config.motion_coupling == "frozen":
        if anybody and weights.posture_predicted:
            problem = problem.with_prediction({"body_pose": seen.body_pose})
        problem = dataclasses.replace(problem, motion=None)
    warnings = initialisation.lines_of_carried(carried)
    return Prepared(problem, state, start, roots, moving, tuple(stages), warnings)


def motion_predictor(
    sequence: Sequence, roots: PersonState, body: body_.BodyModel, config: Config
) -> graph.MotionPredictor:
    """The motion model, at the times of these frames."""
    model = motion.load_motion_model(config.motion_model)
    clock = motion.make_clock(sequence.timestamps, model.fps)
    present = jnp.asarray(roots.present)
    return graph.MotionPredictor(motion.predict_between, (model, clock), body, present)


def predict(predictor: graph.MotionPredictor, state: graph.State) -> motion.Prediction:
    """What the motion model says of a state's people."""
    # The map has no part in it, and its size, which every video has of its own, would
    # have the program compiled once more.
    none = jnp.zeros((0, 3), state.landmarks.dtype)
    return _predict(predictor, eqx.tree_at(lambda s: s.landmarks, state, none))


_predict = eqx.filter_jit(lambda predictor, state: predictor(state))


def _settle_people(
    problem: graph.Problem, state: graph.State, config: Config
) -> tuple[graph.State, dict]:
    """People alone in the camera's frame: the same program with all else held."""
    alone = graph.disable(
        problem,
        graph.Reprojection,
        graph.HumanMotion,
        graph.RelativeOrientation,
        graph.RootSmoothness,
        graph.GroundContact,
    )
    rest = ("scale", "cameras", "landmarks", "intrinsics")
    alone = dataclasses.replace(alone, free=graph.set_constant(alone.free, *rest))
    solution, stage = solve_stage(alone, state, config, "people alone")
    return solution.state, stage


def estimate(
    sequence: Sequence,
    cameras: SfmResult,
    bodies: Bodies,
    body: body_.BodyModel,
    config: Config,
) -> JointEstimate:
    """The paper's graph: two steps, then the optimum of everything.

    **Raises:** as `prepare`, unless a detector looked at all images and found nobody.
    """
    looked = sequence.detected is not None and sequence.keypoints is None
    if looked and cameras.kind != "moving" and not len(bodies.present):
        return without_anything(cameras)
    prepared = prepare(sequence, cameras, bodies, body, config)
    problem = prepared.problem
    solution, stage = solve_stage(problem, prepared.state, config, "joint")
    best = solution.state
    spread, unobserved = None, ()
    if config.uncertainty:
        spread = solver.marginals(problem, best)
        unobserved = solver.observability(problem, best, spread)
        fitted = people.without_bodies(sequence)
        there = prepared.roots.present.any(axis=1)
        if len(there) and (fitted & there).any():
            sigma = np.where(fitted, config.weights.shape_sigma, 1.0)
            spread = of_fitted_sizes(spread, best, body, sigma, there)
    return JointEstimate(
        scale=float(best.scale),
        start=prepared.scale,
        scale_sigma=_scale_sigma(
            float(spread.scale) if spread else np.nan,
            moving=prepared.moving,
            told=bool(prepared.roots.present.any())
            or bool(np.isfinite(cameras.path_scale)),
        ),
        shape_covariance=(
            np.full((len(best.shapes), 10, 10), np.nan)
            if spread is None
            else np.asarray(spread.shapes)
        ),
        unobserved=(
            *prepared.warnings,
            *(f"not well determined: {line}" for line in unobserved),
        ),
        cameras=np.asarray(best.cameras),
        roots=np.asarray(best.roots),
        poses=np.asarray(best.poses),
        shapes=np.asarray(best.shapes),
        landmarks=np.asarray(best.landmarks),
        intrinsics=np.asarray(best.intrinsics),
        present=prepared.roots.present,
        status=solution.status,
        stages=(*prepared.stages, stage),
    )


def without_anything(cameras: SfmResult) -> JointEstimate:
    """The estimate where the camera did not move and nobody was found: cameras stay
    where they are, and nothing has a size."""
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


def _scale_sigma(variance: float, *, moving: bool, told: bool) -> float:
    """m per unit of the map; infinite where neither people nor a metric path tell
    metres, and NaN where it was not computed or there is no map."""
    if np.isnan(variance) or not moving:
        return np.nan
    return variance**0.5 if told else np.inf


def of_fitted_sizes(
    spread: solver.Marginals,
    state: graph.State,
    body: body_.BodyModel,
    shape_sigma: Float[np.ndarray, " h"],
    there: Bool[np.ndarray, " h"],
) -> solver.Marginals:
    """Covariances of shapes and scale where bodies were fitted to keypoints.

    Nobody measured these people. A detector's errors last, so that keypoints of many
    frames say hardly more of a shape than those of a few; the graph, which counts
    them all, holds β by `shape_sigma` in place of 1 in return. That keeps estimates
    where they belong, and makes variances as much too small. What is given back goes
    to the scale by the length of legs, which is the metre of all that moves.
    """
    # Of weight w in place of 1: the variance of the estimate is Σ (Σ⁻¹ - w + w²) Σ.
    weight = np.maximum(shape_sigma**-2.0, 1.0)
    more = weight * (weight - 1)
    extra = more[:, None, None] * (spread.shapes @ spread.shapes)
    log_leg = lambda shape: jnp.log(motion.leg_length(body, shape))
    slope = jax.vmap(jax.grad(log_leg))(state.shapes)
    legs = jnp.einsum("hi,hij,hj->h", slope, extra, slope)
    # The mean of the people there are, who differ independently of each other.
    scale = (
        spread.scale + state.scale**2 * jnp.sum(legs[there]) / float(there.sum()) ** 2
    )
    return dataclasses.replace(spread, scale=scale, shapes=spread.shapes + extra)


def solve_stage(
    problem: graph.Problem, state: graph.State, config: Config, name: str
) -> tuple[solver.Solution, dict]:
    """`solver.solve` with a line for the log and what the report says of it.

    The `joint` problem takes the steps of the paper, any other the last of them.
    """
    start = time.perf_counter()
    schedule = solver.paper_schedule(config.solver)
    schedule = schedule if name == "joint" else schedule[-1:]
    schedule = tuple(dataclasses.replace(stage, atol=COST_ATOL) for stage in schedule)
    solution = solver.solve(problem, state, solver=config.solver, schedule=schedule)
    before, after = float(solution.first_cost), float(solution.cost)
    steps = sum(int(n) for n in solution.num_steps)
    status = solution.status
    log.info(
        "%s: cost %.4g -> %.4g in %d steps, %s", name, before, after, steps, status
    )
    return solution, {
        "name": name,
        "cost_before": before,
        "cost_after": after,
        "iterations": steps,
        "seconds": round(time.perf_counter() - start, 2),
        "status": status,
    }
