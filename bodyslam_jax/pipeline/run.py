"""Runs all stages: video -> people -> tracks -> cameras -> bodies -> graph -> result.

Each stage's result is kept in a `Cache` under a fingerprint of all that it depends on.
"""

import dataclasses
from collections.abc import Mapping

import numpy as np

from bodyslam_jax import diagnostics, graph, motion, people, sfm
from bodyslam_jax.body import BodyModel, load_body_model, rest_joints
from bodyslam_jax.config import Config
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.export.summary import summarise
from bodyslam_jax.geometry.lengths import padded_length
from bodyslam_jax.ground.vertical_edges import Edges
from bodyslam_jax.pipeline import joint_stage, people_stage, sfm_stage
from bodyslam_jax.pipeline.default_body import with_compatible_body
from bodyslam_jax.pipeline.intrinsics import with_intrinsics
from bodyslam_jax.pipeline.own_terms import Factors, OwnTerms
from bodyslam_jax.pipeline.people_stage import with_warnings
from bodyslam_jax.pipeline.progress import Counter, Stopwatch, compiling
from bodyslam_jax.pipeline.sfm_stage import find_edges
from bodyslam_jax.pipeline.stage_cache import Cache, body_model_file, fingerprint
from bodyslam_jax.pipeline.to_metric import to_metric
from bodyslam_jax.types import (
    Bodies,
    JointEstimate,
    Result,
    Sequence,
    SfmResult,
    Tracks,
)

_MIN_FRAMES = 3
"""Least number of frames of a sequence that can be estimated."""


def run(
    sequence: Sequence,
    config: Config = Config(),
    *,
    cache: Cache = Cache(None),
    factors: Factors = (),
    variables: Mapping[str, graph.Variable] | None = None,
) -> Result:
    """Estimates cameras, people and map in metres; `cache` keeps finished stages.

    Args:
        factors: user-defined factors, which are added to the joint problem; or a
            function that makes them from the initial state of the joint solve.
        variables: named globals that `factors` depend on, with their priors.
            `summary["own"]` has their values and sigmas, and how each factor fits; a
            factor that the optimum contradicts makes the result doubtful.

    **Raises:** `InputError`, in one line, if neither cameras nor people can be
    estimated from the sequence, or if a factor does not fit the problem.
    """
    gender = sequence.bodies.gender if sequence.bodies else None
    config, warnings = with_compatible_body(config, gender)
    own = OwnTerms(factors, variables or {})
    return run_stages(with_warnings(sequence, warnings), config, cache, own)[0]


def run_stages(
    sequence: Sequence, config: Config, cache: Cache, own: OwnTerms = OwnTerms()
) -> tuple[Result, SfmResult, Sequence]:
    """Does the work of `run`; returns also the cameras before the joint estimate, and
    the input as it was used: with the detected people, in the order of the result, and
    without zoom.

    **Raises:** as `run`.
    """
    _check_length(sequence)
    watch = Stopwatch()
    body = load_body_model(config.body_model)
    model = motion.load_motion_model(config.motion_model)
    if config.people:  # Checked before stages that take minutes and need no motion.
        motion.check_compatible(model, body, model.fps)
    sequence = people_stage.detect(sequence, config, cache, watch)
    sequence = diagnostics.reconcile(sequence, body)
    cameras, bodies = before_joint(sequence, body, config, cache, watch)
    key = fingerprint(sequence, config)
    everybody = sequence
    sequence = people.select_people(sequence, config.person)
    refined = with_intrinsics(sequence, cameras.intrinsics, cameras.zoom)
    files_body, body = body, _body_that_reaches(body, config)
    edges = None
    if cameras.kind != "moving":  # Edges determine the slope of the floor.
        with watch("edges"):
            edges = find_edges(everybody, cameras, cache=cache)
    with watch("joint"):
        given = refined, cameras, bodies, body, config, edges, own

        def compute() -> JointEstimate:
            with compiling("joint", _size(refined)):
                return joint_stage.estimate(*given)

        # The code of a user-defined factor has no fingerprint.
        joint = compute() if own else cache.stage("joint", key, JointEstimate, compute)
    if cameras.kind == "moving":
        with watch("edges"):
            edges = find_edges(everybody, cameras, joint, cache)
    with watch("verdict"):
        result = assemble(sequence, config, body, cameras, joint, watch.seconds, edges)
    return _with_shapes_of(files_body, body, result), cameras, refined


def _body_that_reaches(body: BodyModel, config: Config) -> BodyModel:
    """Returns the body model, with a size axis if a given stature is beyond its
    shapes."""
    heights = (height.value for height in config.heights().values())
    beyond = any(people.beyond_reach(body, height) for height in heights)
    return people.with_size_axis(body) if beyond else body


def _with_shapes_of(body: BodyModel, used: BodyModel, result: Result) -> Result:
    """Converts shapes with a size axis to those of the plain body model, which other
    programs know; joints remain those of the estimate."""
    if not used.sized:
        return result
    betas = [people.in_model(used, body, shape) for shape in result.betas]
    betas = np.stack(betas) if betas else result.betas
    pelvis = [np.asarray(rest_joints(used, shape))[0] for shape in result.betas]
    of_body = [np.asarray(rest_joints(body, shape))[0] for shape in betas]
    move = np.reshape(pelvis, (-1, 3)) - np.reshape(of_body, (-1, 3))
    trans = result.trans + move[:, None]
    return dataclasses.replace(result, betas=betas, trans=trans)


def before_joint(
    sequence: Sequence,
    body: BodyModel,
    config: Config,
    cache: Cache = Cache(None),
    watch: Stopwatch | None = None,
) -> tuple[SfmResult, Bodies]:
    """Estimates cameras and map up to scale, and bodies in the camera frame: the
    initial values of the graph.

    **Raises:** as `run`.
    """
    watch = watch or Stopwatch()
    key = fingerprint(sequence, config.tracking)
    with watch("tracks"):
        tracks = cache.stage("tracks", key, Tracks, lambda: _tracks(sequence, config))
    key = fingerprint(
        key, config.structure, config.weights.landmark_loss, config.static_camera
    )
    with watch("cameras"):
        cameras = cache.stage(
            "cameras",
            key,
            SfmResult,
            lambda: sfm_stage.estimate(sequence, tracks, config),
        )
    sequence = people.select_people(sequence, config.person)
    sequence = with_intrinsics(sequence, cameras.intrinsics, cameras.zoom)
    model = body_model_file(config.body_model)
    key = fingerprint(sequence, config.people_fit, config.people, model)

    def compute() -> Bodies:
        with compiling("people", _size(sequence)):
            return people_stage.estimate_bodies(sequence, body, config)

    with watch("people"):
        bodies = cache.stage("people", key, Bodies, compute)
    return cameras, bodies


def _size(sequence: Sequence) -> str:
    """Returns the sizes of arrays that determine which programs a sequence needs."""
    keypoints, bodies = sequence.keypoints, sequence.bodies
    number = 0 if keypoints is None else len(keypoints.uv)
    if bodies is not None:
        number = max(number, len(bodies.present))
    return f"{padded_length(sequence.num_frames)} frames, {number} people"


def assemble(
    sequence: Sequence,
    config: Config,
    body: BodyModel,
    cameras: SfmResult,
    joint: JointEstimate,
    seconds: dict[str, float],
    edges: Edges | None = None,
) -> Result:
    """Returns the joint estimate in metres, with its verdict and summary.

    `seconds` are the durations of the stages, for the summary; `edges` are straight
    edges in the images, for gravity.
    """
    result, up = to_metric(sequence, config, body, cameras, joint, edges)
    verdict = diagnostics.assess(sequence, body, cameras, joint, result, up, config)
    summary = summarise(sequence, config, cameras, joint, result, verdict, seconds)
    return dataclasses.replace(result, summary=summary, joint_sigma=verdict.joint_sigma)


def _check_length(sequence: Sequence) -> None:
    """**Raises:** `InputError` for a sequence that is too short."""
    if sequence.num_frames < _MIN_FRAMES:
        raise InputError(
            f"{sequence.name}: {sequence.num_frames} frames, expected at least "
            f"{_MIN_FRAMES}: size and motion come from what moves."
        )


def _tracks(sequence: Sequence, config: Config) -> Tracks:
    """Returns the given tracks, or tracks features through the images."""
    if sequence.tracks is not None:
        return sequence.tracks
    counter = Counter("tracks", sequence.num_frames)
    return sfm.track(sequence, config.tracking, lambda k, _: counter(k))
