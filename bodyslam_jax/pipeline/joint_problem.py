"""Builds the joint problem and its first state: cameras, people, map and scale; and
solves it once, by the schedule of the paper."""

import dataclasses
import functools
import logging
import time

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax import graph, initialisation, motion, people, solver
from bodyslam_jax.body import BodyModel
from bodyslam_jax.config import PATH_SIGMA, Config, Measured
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.ground.vertical_edges import Edges
from bodyslam_jax.people import PersonState
from bodyslam_jax.pipeline.motion_prediction import (
    contact_predictor,
    contact_probability,
    motion_predictor,
    predict,
)
from bodyslam_jax.pipeline.people_floor import (
    View,
    on_floor,
    people_on_floor,
    without_floor,
)
from bodyslam_jax.types import Bodies, ScaleStart, Sequence, SfmResult

log = logging.getLogger(__name__)
_KINDS_WITHOUT_MAP = ("static", "rotation")
"""Kinds of camera motion without a map, where people alone determine the floor."""
_STATURE_SIGMA_M = 0.07
"""Standard deviation of the statures of adults of one sex, m (NCD-RisC, eLife 2016),
with which regressed statures hardly correlate."""
Passengers = dict[int, tuple[float, float]]
"""People whose steps do not measure scale, as a vehicle or treadmill moves them: a map
from their number to their speeds, m/s, as returned by `initialisation.carried`."""
COST_ATOL = 0.005
"""Decrease of the cost below which the solver stops. The cost is a negative
log-likelihood, in which one standard deviation of one residual is 0.5. Without this
bound, a few landmarks with little parallax keep moving for dozens of steps, with no
effect on the rest of the state."""


@dataclasses.dataclass(frozen=True)
class Prepared:
    """A joint problem and its first state."""

    problem: graph.Problem
    state: graph.State
    scale: ScaleStart
    roots: PersonState
    moving: bool
    """True if the camera moves, so that the scale of its path is to be estimated."""
    warnings: tuple[str, ...] = ()
    """Warnings for the report, a line each."""
    passengers: tuple[int, ...] = ()
    """People (rows) whose displacement is not caused by their steps."""
    crowd: "StartingPeople | None" = None
    """People before the joint solve."""
    legs_shown: Bool[np.ndarray, "h t"] | None = None
    """Frames in which people's legs are observed (`people.legs_shown`); `None` if all
    are."""


@dataclasses.dataclass(frozen=True)
class StartingPeople:
    """Initial values of `h` people, and what is known of them."""

    roots: PersonState
    """Initial values, with known statures applied; the shape prior is centred on their
    β."""
    unaided: Float[np.ndarray, "h 10"]
    """SMPL β as fitted or regressed, before known statures are applied."""
    unaided_sigma: Float[np.ndarray, " h"]
    """Standard deviation of the statures of `unaided`, m."""
    fitted: Bool[np.ndarray, " h"]
    """True for bodies fitted to keypoints, not regressed from images."""
    statures: dict[int, Measured]
    """Measured statures and their sigma, m, by person."""
    legs_shown: Bool[np.ndarray, "h t"]
    """Frames in which steps and feet are observed, whatever the source of the
    bodies."""


def prepare(
    sequence: Sequence,
    cameras: SfmResult,
    bodies: Bodies,
    body: BodyModel,
    config: Config,
    *,
    feet: bool = True,
    edges: Edges | None = None,
) -> Prepared:
    """Computes the first scale in closed form, then builds the graph; nothing is
    solved.

    Args:
        cameras: cameras and map up to scale.
        bodies: people in the camera frame, where the problem starts.
        feet: True to include the factor of standing feet, without weight, which
            `contact_stage.hold_standing_feet` replaces.
        edges: straight edges in the world of a camera that does not move, which
            determine the slope of the floor.

    **Raises:** `InputError` if there is neither a moving camera nor a person.
    """
    weights, moving = config.weights, cameras.kind == "moving"
    crowd = _starting_people(sequence, cameras, bodies, body, config)
    roots = crowd.roots
    state = initialisation.first_state(
        cameras.T_WC, cameras.landmarks, roots, cameras.intrinsics
    )
    predictor = motion_predictor(sequence, roots, body, config)
    anybody = len(roots.present) > 0
    make = functools.partial(
        _make_problem,
        cameras=cameras,
        predictor=predictor if anybody else None,
        free=None if moving else initialisation.free_people(state),
    )
    factors = _camera_factors(cameras, config) if moving else []
    floor = None
    if (
        cameras.kind in _KINDS_WITHOUT_MAP
        and anybody
        and weights.ground_sigma is not None
    ):
        floor = without_floor(body, roots.present)
        factors.append(floor)
    start, passengers, prediction = ScaleStart(), {}, None
    if anybody:
        prediction = predict(predictor, state)
        people_factors, contact = _people_factors(
            sequence, cameras, crowd, state, prediction, body, config
        )
        factors += people_factors
        stands = contact_predictor(sequence, roots, body, config)
        if feet and stands is not None:
            factors.append(
                initialisation.without_contacts(state, sequence.fps, body, weights)
            )
        present = roots.present & cameras.registered
        standing = present & crowd.legs_shown
        steps = initialisation.steps_shown(prediction, crowd.legs_shown, sequence.fps)
        if floor is not None:
            found = on_floor(
                state,
                stands and contact_probability(stands, state, sequence.fps),
                View(
                    standing,
                    sequence.keypoints,
                    crowd.fitted,
                    sequence.fps,
                    config.gravity,
                    edges,
                ),
                body,
                weights,
            )
            factors = [found if factor is floor else factor for factor in factors]
        if contact is not None:
            rough = initialisation.with_elevation(contact, state, sequence.fps)
            factors = [rough if factor is contact else factor for factor in factors]
            contact = rough
        start, passengers = _start_of_scale(
            sequence, cameras, crowd, state, steps, contact, present, config
        )
        factors.append(
            initialisation.motion_factor(
                steps,
                state.shapes,
                body,
                weights,
                shared_error=_shared_error(crowd.fitted, config),
                without=passengers,
            )
        )
    elif moving and np.isfinite(cameras.path_scale):
        start = ScaleStart(
            path=cameras.path_scale, path_error=PATH_SIGMA * cameras.path_scale
        )
    if moving and (anybody or np.isfinite(cameras.path_scale)):
        state = eqx.tree_at(lambda s: s.scale, state, jnp.asarray(start.value))
    if not factors:
        raise InputError(
            f"{sequence.name}: no landmarks and no people; expected a camera moving "
            "before a textured background, or people's keypoints."
        )
    problem = make(factors, state)
    if config.motion_coupling == "frozen":
        if prediction is not None and weights.posture_predicted:
            problem = problem.with_prediction({"body_pose": prediction.body_pose})
        problem = dataclasses.replace(problem, motion=None)
    warnings = initialisation.lines_of_carried(passengers)
    return Prepared(
        problem,
        state,
        start,
        roots,
        moving,
        warnings,
        tuple(passengers),
        crowd,
        crowd.legs_shown if anybody else None,
    )


def _starting_people(
    sequence: Sequence,
    cameras: SfmResult,
    bodies: Bodies,
    body: BodyModel,
    config: Config,
) -> StartingPeople:
    """Collects the initial values of people, with known statures applied."""
    bodies = dataclasses.replace(bodies, present=bodies.present & cameras.within)
    roots = people.roots_from_bodies(bodies, body)
    fitted = people.without_bodies(sequence)
    numbers = config.person or range(len(roots.present))
    statures = people.statures_of(config.heights(), list(dict.fromkeys(numbers)))
    unaided = roots.shape.copy()
    if body.sized:
        unaided[:, -1] = 0.0
    regressed = sequence.bodies is not None and sequence.bodies.shapes_regressed
    per_unit = float(np.linalg.norm(people.linear_stature(body).slope))
    # The prior of a fitted shape has a smaller sigma than its uncertainty
    # (`diagnostics.scale_uncertainty`); that of a regressed one describes its noise,
    # not its bias.
    unsure = np.where(
        fitted,
        1.0,
        np.maximum(
            config.weights.shape_sigma,
            _STATURE_SIGMA_M / per_unit if regressed else 0.0,
        ),
    )
    roots = people.with_statures(roots, statures, body, unsure)
    shown = people.shown_keypoints(sequence, body)
    legs = people.legs_shown(shown, roots.present, sequence.fps)
    return StartingPeople(roots, unaided, unsure * per_unit, fitted, statures, legs)


def _camera_factors(cameras: SfmResult, config: Config) -> list[graph.Factor]:
    """Returns the factors of a moving camera: map, loop closures and a given path."""
    weights = config.weights
    sigma = initialisation.landmark_sigma(cameras.pixel_sigma, weights)
    return [
        initialisation.map_factor(cameras.tracks, cameras.keep, sigma, weights),
        initialisation.revisit_factor(
            cameras.prior_mean, cameras.prior_information, sigma
        ),
        *initialisation.path_factors(
            cameras.path, cameras.path_known, cameras.path_scale
        ),
    ]


def _people_factors(
    sequence: Sequence,
    cameras: SfmResult,
    crowd: StartingPeople,
    state: graph.State,
    prediction: motion.Prediction,
    body: BodyModel,
    config: Config,
) -> tuple[list[graph.Factor], graph.GroundContact | None]:
    """Returns the factors of people except those of motion; and the ground contact
    factor, which is one of them, or `None`."""
    weights, roots = config.weights, crowd.roots
    predicted = prediction.valid if weights.posture_predicted else None
    factors = initialisation.people_factors(
        sequence, roots, weights, body, predicted=predicted
    )
    if crowd.statures:
        factors.append(
            initialisation.stature_factor(crowd.statures, roots.present, body)
        )
    contact = None
    if cameras.kind == "moving":
        contact = initialisation.ground_contact(
            state,
            roots.present & cameras.registered & crowd.legs_shown,
            sequence.keypoints,
            body,
            weights,
            sequence.fps,
        )
    if contact is not None:
        factors.append(contact)
    return factors, contact


def _start_of_scale(
    sequence: Sequence,
    cameras: SfmResult,
    crowd: StartingPeople,
    state: graph.State,
    prediction: motion.Prediction,
    contact: graph.GroundContact | None,
    present: Bool[np.ndarray, "h t"],
    config: Config,
) -> tuple[ScaleStart, Passengers]:
    """Returns the first scale from all cues, and the people whose steps it excludes.

    Passengers are detected by their speed at the scale of the other cues, and only if
    there are others; a camera that does not move has scale 1.
    """
    if cameras.kind != "moving":
        found = initialisation.carried(state, prediction, present, 1.0, sequence.fps)
        return ScaleStart(), found
    shared_error = _shared_error(crowd.fitted, config)
    somewhere = crowd.roots.present.any(axis=1)
    estimate = lambda without: initialisation.scale_start(
        state,
        prediction,
        contact,
        shared_error=float(
            (shared_error[somewhere] if somewhere.any() else shared_error).min()
        ),
        path=cameras.path_scale,
        without=without,
    )
    start, passengers = estimate(()), {}
    others = start.without_motion()
    if np.isfinite(others.standard_error):
        passengers = initialisation.carried(
            state, prediction, present, others.value, sequence.fps
        )
        start = estimate(passengers) if passengers else start
    log.info(
        "scale: %.4g ± %.2g (motion %.4g ± %.2g, ground %.4g ± %.2g)",
        *(start.value, start.standard_error),
        *(start.motion, start.motion_error),
        *(start.ground, start.ground_error),
    )
    return start, passengers


def _shared_error(
    fitted: Bool[np.ndarray, " h"], config: Config
) -> Float[np.ndarray, " h"]:
    """Returns the relative error common to all steps of a person."""
    weights = config.weights
    return np.where(fitted, weights.fitted_step_error, weights.step_error)


def _make_problem(
    factors: list[graph.Factor],
    state: graph.State,
    *,
    cameras: SfmResult,
    predictor: graph.MotionPredictor | None,
    free: graph.Step | None,
) -> graph.Problem:
    """Makes the problem, with cameras beyond a cut of the video held constant, as no
    factor determines them. For a camera that does not move, the scale is free if there
    is a floor."""
    if free is not None and any(isinstance(f, graph.GroundContact) for f in factors):
        free = dataclasses.replace(free, scale=jnp.ones_like(free.scale))
    problem = graph.make_problem(
        factors,
        state,
        motion=predictor,
        free=free,
        common_sizes=True,
        basis=people.posture_basis() if len(state.roots) else None,
    )
    if free is not None and people_on_floor(problem) is None:
        constant = graph.set_constant(problem.free, "scale")
        problem = dataclasses.replace(problem, free=constant)
    within = cameras.within
    if within.all() or cameras.kind != "moving":
        return problem
    mask = jnp.zeros_like(problem.free.cameras)
    mask = mask.at[within].set(graph.gauge(state.cameras[within]))
    return eqx.tree_at(lambda p: p.free.cameras, problem, mask)


def solve_stage(
    problem: graph.Problem, state: graph.State, config: Config, name: str
) -> tuple[solver.Solution, dict]:
    """Solves the problem and returns the solution and the stage's entry for the report.

    The stage named `joint` follows the schedule of the paper, any other only its last
    step.
    """
    start = time.perf_counter()
    schedule = schedule_of(config)
    schedule = schedule if name == "joint" else schedule[-1:]
    # Covariances that follow are of factors in double precision: one program is enough.
    solution = solver.solve(
        problem,
        state,
        solver=config.solver,
        schedule=schedule,
        mixed_precision=False,
    )
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


def schedule_of(config: Config) -> tuple[solver.Stage, ...]:
    """Returns the stages of the joint solve, which stop by `COST_ATOL`."""
    schedule = solver.paper_schedule(config.solver)
    return tuple(dataclasses.replace(stage, atol=COST_ATOL) for stage in schedule)
