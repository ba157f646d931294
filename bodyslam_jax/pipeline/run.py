"""Runs all stages: video -> people -> tracks -> cameras -> bodies -> graph -> result.

Each stage's result is kept in a `Cache` under a fingerprint of all that it depends on.
"""

import dataclasses
import functools
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from bodyslam_jax import diagnostics, graph, motion, people, sfm
from bodyslam_jax.body import (
    DEFAULT,
    BodyModel,
    load_body_model,
    rest_joints,
    search_paths,
)
from bodyslam_jax.body.files import candidates, named_gender
from bodyslam_jax.config import Config
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.export.summary import summarise
from bodyslam_jax.ground.vertical_edges import Edges, make_edges
from bodyslam_jax.pipeline import joint_stage, people_stage, sfm_stage
from bodyslam_jax.pipeline.joint_stage import Factors, OwnTerms
from bodyslam_jax.pipeline.people_stage import with_warnings
from bodyslam_jax.pipeline.progress import Stopwatch, compiling
from bodyslam_jax.pipeline.stage_cache import Cache, body_model_file, fingerprint
from bodyslam_jax.pipeline.to_metric import to_metric
from bodyslam_jax.types import Bodies, JointEstimate, Result, Sequence, SfmResult

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
    files_body = load_body_model(config.body_model)
    model = motion.load_motion_model(config.motion_model)
    if config.people:  # Checked before stages that take minutes and need no motion.
        motion.check_compatible(model, files_body, model.fps)
    sequence = people_stage.detect(sequence, config, cache, watch)
    sequence = diagnostics.reconcile(sequence, files_body)
    used, cameras, bodies = before_joint(sequence, files_body, config, cache, watch)
    body = _body_that_reaches(files_body, config)
    key = fingerprint(sequence)
    segments = None  # Edges determine the slope of the floor and the direction of up.
    if sequence.frames is not None and cameras.kind != "failed":
        seen = cameras.within
        with watch("edges"):
            find = functools.partial(sfm.find_segments, sequence, seen)
            key_of_segments = fingerprint(key, seen)
            segments = cache.stage("segments", key_of_segments, sfm.Segments, find)
    edges = _edges(segments, cameras.zoom, cameras.T_WC, cameras.intrinsics)
    of_floor = None if cameras.kind == "moving" else edges

    def solve() -> JointEstimate:
        number, num_frames = bodies.present.shape
        with compiling("joint", people_stage.size_of(num_frames, number)):
            return joint_stage.estimate(
                used, cameras, bodies, body, config, of_floor, own
            )

    with watch("joint"):
        # The code of a user-defined factor has no fingerprint.
        kept = Cache(None) if own else cache
        key = fingerprint(key, config)
        joint = kept.stage("joint", key, JointEstimate, solve)
    if cameras.kind == "moving":
        edges = _edges(segments, cameras.zoom, joint.cameras, joint.intrinsics)
    with watch("verdict"):
        sequence = people.select_people(sequence, config.person)
        result = assemble(sequence, config, body, cameras, joint, watch.seconds, edges)
    return _with_shapes_of(files_body, body, result), cameras, used


def _edges(
    segments: sfm.Segments | None,
    zoom: Float[np.ndarray, " t"] | None,
    T_WC: Float[np.ndarray, "t 4 4"],
    intrinsics: Float[np.ndarray, " i"],
) -> Edges | None:
    """Returns straight segments of zoomed images as edges in the world of the cameras;
    `None` if no images were searched."""
    if segments is None:
        return None
    ends = segments.ends
    if zoom is not None:
        centre = intrinsics[2:4]
        size = np.exp(zoom[segments.frame])[:, None, None]
        ends = centre + (ends - centre) / size
    R_WC = T_WC[:, :3, :3]
    return make_edges(segments.frame, ends, segments.searched, R_WC, intrinsics)


def with_compatible_body(
    config: Config, gender: str | None = None
) -> tuple[Config, tuple[str, ...]]:
    """Returns settings with a body that the motion model was trained on, and warnings.

    Args:
        gender: gender of the body model that given bodies belong to, if stated. The
            model of that gender is taken from the folder in the settings, or from the
            installed ones; if there is none, a warning says so.

    A body model that was found on this machine, not named by the user, is replaced by
    the default body if the motion model belongs to that one; a warning says so. A body
    model that the user names is kept: a mismatch is rejected later.
    """
    config, warnings = _with_default_body(config)
    if gender is None or not config.people:
        return config, warnings
    named = None if config.body_model is None else Path(config.body_model)

    def fits(file: Path) -> bool:
        """Returns True for an installed model of the gender, and of the motion model's
        kind unless the user named its folder."""
        if not file.is_file() or file == DEFAULT:
            return False
        if named_gender(file) not in (gender, None):
            return False
        if named is not None:
            return True
        kind = motion.load_motion_model(config.motion_model).body
        return load_body_model(file).kind == kind

    files = search_paths(gender) if named is None else candidates(named, gender)
    fitting = next(filter(fits, files), None)
    if fitting is not None:
        return dataclasses.replace(config, body_model=str(fitting)), warnings
    if gender == "neutral" and (named is None or named == DEFAULT or named.is_dir()):
        return config, warnings
    used = "the default body" if named in (None, DEFAULT) else str(named)
    text = (
        f"the given bodies belong to the {gender} model, but {used} is used, in which "
        "their β mean another shape: name a folder with the model of that gender "
        "(--body-model)."
    )
    return config, (*warnings, text)


def _with_default_body(config: Config) -> tuple[Config, tuple[str, ...]]:
    """Replaces a body model that was found on this machine but does not match the
    motion model by the default body; returns settings and warnings."""
    file = body_model_file(config.body_model)
    if config.body_model is not None or file is None or not config.people:
        return config, ()
    model = motion.load_motion_model(config.motion_model)
    found = load_body_model(file)
    if found.kind == model.body or model.body != load_body_model(DEFAULT).kind:
        return config, ()
    text = (
        f"{file} is not used: the motion model was trained on the default body; "
        "name both, --body-model and a --motion-model of `bodyslam train-motion`."
    )
    return dataclasses.replace(config, body_model=str(DEFAULT)), (text,)


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
) -> tuple[Sequence, SfmResult, Bodies]:
    """Estimates cameras and map up to scale, and bodies in the camera frame: the
    initial values of the graph.

    Returns first the input as the joint estimate uses it: with the selected people, the
    estimated intrinsics, and without zoom.

    **Raises:** as `run`.
    """
    watch = watch or Stopwatch()
    cameras = sfm_stage.cameras_and_map(sequence, config, cache, watch)
    used, bodies = people_stage.bodies_in_camera(
        sequence, cameras, body, config, cache, watch
    )
    return used, cameras, bodies


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
    return dataclasses.replace(
        result,
        summary=summary,
        joint_sigma=verdict.joint_sigma,
        root_sigma=None if verdict.places is None else verdict.places.root_sigma,
    )


def _check_length(sequence: Sequence) -> None:
    """**Raises:** `InputError` for a sequence that is too short."""
    if sequence.num_frames < _MIN_FRAMES:
        raise InputError(
            f"{sequence.name}: {sequence.num_frames} frames, expected at least "
            f"{_MIN_FRAMES}: size and motion come from what moves."
        )
