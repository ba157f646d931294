"""The whole flow: video -> tracks -> cameras -> people -> graph -> result."""

import contextlib
import dataclasses
import logging
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from bodyslam_jax import body as body_
from bodyslam_jax import (
    diagnostics,
    evaluation,
    export,
    io,
    motion,
    people,
    sfm,
    simulation,
    view,
)
from bodyslam_jax.body import DEFAULT
from bodyslam_jax.config import Config
from bodyslam_jax.evaluation import before_after
from bodyslam_jax.export.summary import describe
from bodyslam_jax.pipeline import joint_stage, sfm_stage
from bodyslam_jax.pipeline.stage_cache import Cache, body_model_file, fingerprint
from bodyslam_jax.pipeline.to_metric import assemble
from bodyslam_jax.types import (
    Bodies,
    JointEstimate,
    Result,
    Sequence,
    SfmResult,
    Tracks,
)

log = logging.getLogger(__name__)

_FEWEST_FRAMES = 3
_SCENE = "scene"
"""Where a demonstration's input lies in its run folder."""
_SECONDS_BETWEEN_LINES = 5.0


class Stopwatch:
    """Seconds by stage, and a log line at the end of each."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextlib.contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        log.info("%s ...", stage)
        start = time.perf_counter()
        yield
        self.seconds[stage] = round(time.perf_counter() - start, 2)
        log.info("%s: %.1f s", stage, self.seconds[stage])


class Counter:
    """A log line every few seconds: how many frames are done."""

    def __init__(self, name: str, total: int) -> None:
        self.name, self.total = name, total
        self.told = time.perf_counter()

    def __call__(self, done: int) -> None:
        now = time.perf_counter()
        if now - self.told > _SECONDS_BETWEEN_LINES:
            log.info("%s: frame %d of %d", self.name, done, self.total)
            self.told = now


def run(
    sequence: Sequence, config: Config = Config(), *, cache: Cache = Cache(None)
) -> Result:
    """Estimates cameras, people and map in metres; `cache` keeps finished stages.

    **Raises:** `ValueError` if there is nothing to be estimated from, in one line.
    """
    config, warnings = _with_body(config)
    return _run(_warned(sequence, warnings), config, cache)[0]


def _with_body(config: Config) -> tuple[Config, tuple[str, ...]]:
    """The settings with the body that ships, and a line that says so, where a body
    model that nobody named was found for which the motion model is none."""
    file = body_model_file(config.body_model)
    if config.body_model is not None or file is None or not config.people:
        return config, ()
    model = motion.load_motion_model(config.motion_model)
    found = body_.load_body_model(file)
    if found.kind == model.body or model.body != body_.load_body_model(DEFAULT).kind:
        return config, ()
    text = (
        f"{file} is not used: the motion model was trained on the body that ships; "
        "name both, --body-model and a --motion-model of `bodyslam train-motion`."
    )
    return dataclasses.replace(config, body_model=str(DEFAULT)), (text,)


def _warned(sequence: Sequence, warnings: tuple[str, ...]) -> Sequence:
    return dataclasses.replace(sequence, warnings=(*sequence.warnings, *warnings))


def _run(
    sequence: Sequence,
    config: Config,
    cache: Cache,
) -> tuple[Result, SfmResult]:
    """`run`, and the cameras before the joint estimate."""
    _check_length(sequence)
    watch = Stopwatch()
    body = body_.load_body_model(config.body_model)
    model = motion.load_motion_model(config.motion_model)
    if config.people:  # now, before minutes are spent
        motion.check_compatible(model, body, model.fps)
    sequence = diagnostics.reconcile(_detected(sequence, config, cache, watch), body)
    cameras, bodies = before_joint(sequence, body, config, cache, watch)
    key = fingerprint(sequence, config)
    sequence = people.select_people(sequence, config.person)
    seen = sfm_stage.with_intrinsics(sequence, cameras.intrinsics, cameras.zoom)
    with watch("joint"):
        joint = cache.stage(
            "joint",
            key,
            JointEstimate,
            lambda: joint_stage.estimate(seen, cameras, bodies, body, config),
        )
    return assemble(sequence, config, body, cameras, joint, watch.seconds), cameras


def before_joint(
    sequence: Sequence,
    body: body_.BodyModel,
    config: Config,
    cache: Cache = Cache(None),
    watch: Stopwatch | None = None,
) -> tuple[SfmResult, Bodies]:
    """Cameras and map up to scale, bodies in the camera: what the graph starts from.

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
    sequence = sfm_stage.with_intrinsics(sequence, cameras.intrinsics, cameras.zoom)
    model = body_model_file(config.body_model)
    key = fingerprint(sequence, config.people_fit, config.people, model)
    with watch("people"):
        bodies = cache.stage(
            "people", key, Bodies, lambda: _people(sequence, body, config)
        )
    return cameras, bodies


def _check_people(sequence: Sequence, config: Config) -> None:
    """Says at once that nothing tells where people are.

    **Raises:** `ValueError` if people are to be estimated, but there are neither
    keypoints nor bodies, nor images to find them in.
    """
    given = sequence.keypoints is not None or sequence.bodies is not None
    if not config.people or given:
        return
    if sequence.frames is not None and config.detect != "none":
        return
    raise ValueError(
        f"{sequence.name}: neither keypoints nor bodies, nor images to find people "
        "in (or --detect none), so nobody to estimate; give one of them, or leave "
        "people out with --no-people."
    )


def _check_length(sequence: Sequence) -> None:
    if sequence.num_frames < _FEWEST_FRAMES:
        raise ValueError(
            f"{sequence.name}: {sequence.num_frames} frames, expected at least "
            f"{_FEWEST_FRAMES}: size and motion come from what moves."
        )


def find_people(
    sequence: Sequence, config: Config = Config(), cache: Cache = Cache(None)
) -> Sequence:
    """The sequence with people found in its images, as `run` finds them.

    **Raises:** as `run`.
    """
    return _detected(sequence, config, cache, Stopwatch())


def _detected(
    sequence: Sequence, config: Config, cache: Cache, watch: Stopwatch
) -> Sequence:
    """The sequence with people found in its images, if none of its keypoints are given.

    Not where there are no images, nor where nobody is to be estimated and masks, or
    tracks that are given, keep people out of the map.
    """
    if config.detect == "none" or sequence.keypoints is not None:
        return sequence
    masked = sequence.masks is not None or sequence.tracks is not None
    if sequence.frames is None or (masked and not config.people):
        return sequence
    if config.detect != "yolox":
        return _tracked(sequence, config, cache, watch)
    key = fingerprint(sequence, config.detection)
    with watch("detection"):
        found = cache.stage(
            "detection", key, Detections, lambda: _detections(sequence, config)
        )
    return io.with_detections(sequence, found.split(), config.association)


def _tracked(
    sequence: Sequence, config: Config, cache: Cache, watch: Stopwatch
) -> Sequence:
    """The same by the networks that ship."""
    counter = Counter("detection", sequence.num_frames)
    find = lambda: people.find_people_tracked(
        io.frames(sequence),
        sequence.fps,
        config.detection,
        config.association,
        counter,
    )
    with watch("detection"):
        key = fingerprint(sequence, config.detection, config.association)
        found = cache.stage("detection", key, people.Found, find)
    points, person = found.by_frame(sequence.num_frames)
    sequence = io.with_detections(
        _warned(sequence, found.warnings),
        points,
        config.association,
        person=person,
        detected=found.detected(),
    )
    if sequence.keypoints is None:
        return sequence
    keypoints = people.with_depths(sequence.keypoints, found, sequence.intrinsics)
    return dataclasses.replace(sequence, keypoints=keypoints)


@dataclasses.dataclass(frozen=True)
class Detections:
    """People found in all images, one after the other."""

    count: Int[np.ndarray, " t"]
    """People in each frame."""
    points: Float[np.ndarray, "p 25 3"]
    """u px, v px, confidence"""

    def split(self) -> list[np.ndarray]:
        """The people of each frame."""
        return np.split(self.points, np.cumsum(self.count)[:-1])


def _detections(sequence: Sequence, config: Config) -> Detections:
    found = people.detect_people(
        io.frames(sequence),
        config.detection,
        offline=config.offline,
        progress=Counter("detection", sequence.num_frames),
    )
    count = np.array([len(points) for points in found])
    return Detections(count, np.concatenate(found))


def _tracks(sequence: Sequence, config: Config) -> Tracks:
    if sequence.tracks is not None:
        return sequence.tracks
    counter = Counter("tracks", sequence.num_frames)
    return sfm.track(sequence, config.tracking, lambda k, _: counter(k))


def _people(sequence: Sequence, body: body_.BodyModel, config: Config) -> Bodies:
    if not config.people:
        return people.nobody(sequence.num_frames)
    return people.estimate_bodies(sequence, body, config.people_fit)


def run_to_folder(sequence: Sequence, out: Path, config: Config = Config()) -> Result:
    """`run`, with finished stages kept in `out` and everything of the contract written.

    Where the sequence has a ground truth, the report says how far off the result is.

    **Raises:** `ValueError` if `out` cannot be written or holds something else.
    """
    config, warnings = _with_body(config)
    sequence = _warned(sequence, warnings)
    cache = Cache(out / ".cache", describe(sequence))
    _check_people(sequence, config)
    export.check_folder(out, cache.source, cache.owner())
    with export.locked(out):
        return _to_folder(sequence, out, config, cache)


def _to_folder(sequence: Sequence, out: Path, config: Config, cache: Cache) -> Result:
    body = body_.load_body_model(config.body_model)
    result, cameras = _run(sequence, config, cache)
    if sequence.groundtruth is not None:
        truth = evaluation.read_groundtruth(sequence.groundtruth, body)
        result.summary["errors"] = found = before_after.errors(
            result, cameras, truth, body
        )
        result.summary["headline"] += before_after.headline(found)
    watch = Stopwatch()
    with export.run_folder(out) as partial:
        if config.overlay and sequence.frames is not None:
            with watch("overlay"):
                view.write_overlay(
                    partial / "overlay.webm",
                    _images(sequence, cameras),
                    result,
                    body,
                    _seen(cameras),
                )
        result.summary["durations_s"] |= watch.seconds
        export.write_files(partial, result, config)
        export.write_report(partial / "report.html", result, body)
    return result


def _images(sequence: Sequence, cameras: SfmResult) -> Iterator[np.ndarray]:
    """The images, with the zoom undone where there is one."""
    images = io.frames(sequence)
    if cameras.zoom is None:
        return images
    return sfm.without_zoom(images, cameras.zoom, cameras.intrinsics[2:4])


def _seen(cameras: SfmResult) -> Tracks:
    """The points of the map as they were seen."""
    tracks, keep = cameras.tracks, cameras.keep
    return Tracks(tracks.frame[keep], tracks.landmark[keep], tracks.uv[keep])


def demo(
    out: Path,
    config: Config = Config(),
    *,
    from_pixels: bool = False,
) -> Result:
    """Renders a walker whom a moving camera films, and runs everything on the images.

    The scene is written to `out/scene`, a sequence folder with its ground truth.

    Args:
        from_pixels: whether people are found in the images, in place of the keypoints
            and bodies that are simulated.

    **Raises:** `ValueError` if `out` cannot be written.
    """
    config, warnings = _with_body(config)
    cache = Cache(out / ".cache", {"name": _SCENE})
    export.check_folder(out, cache.source, cache.owner())
    with export.locked(out):
        return _demo(out, config, warnings, from_pixels)


def _demo(
    out: Path,
    config: Config,
    warnings: tuple[str, ...],
    from_pixels: bool,
) -> Result:
    folder, watch = out / _SCENE, Stopwatch()
    with watch("rendering"):
        simulation.demo_scene(folder, people=not from_pixels)
        sequence = _warned(io.read_sequence(folder), warnings)
    cache = Cache(out / ".cache", describe(sequence))
    export.check_folder(out, cache.source, cache.owner())
    return _to_folder(sequence, out, config, cache)
