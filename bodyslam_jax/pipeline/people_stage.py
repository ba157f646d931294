"""Detects people, if no keypoints are given, and estimates their bodies."""

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from bodyslam_jax import io, people
from bodyslam_jax.body import BodyModel
from bodyslam_jax.config import Config
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.pipeline.progress import Counter, Stopwatch
from bodyslam_jax.pipeline.stage_cache import Cache, fingerprint
from bodyslam_jax.types import Bodies, Sequence


@dataclasses.dataclass(frozen=True)
class Detections:
    """People detected in all images, concatenated over frames."""

    count: Int[np.ndarray, " t"]
    """Number of people in each frame."""
    points: Float[np.ndarray, "p 25 3"]
    """BODY_25 keypoints: u (px), v (px), confidence."""

    def by_frame(self) -> list[np.ndarray]:
        """Splits the people by frame."""
        return np.split(self.points, np.cumsum(self.count)[:-1])


def check_people(sequence: Sequence, config: Config) -> None:
    """Rejects an input in which nobody can be found, before anything is computed.

    **Raises:** `InputError` if people are to be estimated, but there are neither
    keypoints nor bodies, nor images to find them in.
    """
    given = sequence.keypoints is not None or sequence.bodies is not None
    if not config.people or given:
        return
    if sequence.frames is not None and config.detect != "none":
        return
    raise InputError(
        f"{sequence.name}: neither keypoints nor bodies, nor images to find people "
        "in (or --detect none), so nobody to estimate; give one of them, or leave "
        "people out with --no-people."
    )


def find_people(
    sequence: Sequence, config: Config = Config(), cache: Cache = Cache(None)
) -> Sequence:
    """Returns the sequence with people detected in its images, as in `run`.

    **Raises:** as `run`.
    """
    return detect(sequence, config, cache, Stopwatch())


def detect(
    sequence: Sequence, config: Config, cache: Cache, watch: Stopwatch
) -> Sequence:
    """Returns the sequence with keypoints of the people in its images.

    It is returned unchanged if it has keypoints or no images, or if people are not to
    be estimated and given masks or tracks already exclude them from the map.
    """
    if config.detect == "none" or sequence.keypoints is not None:
        return sequence
    masked = sequence.masks is not None or sequence.tracks is not None
    if sequence.frames is None or (masked and not config.people):
        return sequence
    if config.detect == "yolox":
        return _detect_per_frame(sequence, config, cache, watch)
    return _detect_and_track(sequence, config, cache, watch)


def _detect_per_frame(
    sequence: Sequence, config: Config, cache: Cache, watch: Stopwatch
) -> Sequence:
    """Detects people in every frame with YOLOX and RTMPose, then associates them over
    time."""

    def compute() -> Detections:
        found = people.detect_people(
            io.frames(sequence),
            config.detection,
            offline=config.offline,
            progress=Counter("detection", sequence.num_frames),
        )
        count = np.array([len(points) for points in found])
        return Detections(count, np.concatenate(found))

    key = fingerprint(sequence, config.detection)
    with watch("detection"):
        found = cache.stage("detection", key, Detections, compute)
    return io.with_detections(
        sequence, found.by_frame(), config.association, definition="coco"
    )


def _detect_and_track(
    sequence: Sequence, config: Config, cache: Cache, watch: Stopwatch
) -> Sequence:
    """Detects and tracks people in one pass with the networks of the package."""
    compute = lambda: people.find_people_tracked(
        io.frames(sequence),
        sequence.fps,
        config.detection,
        config.association,
        Counter("detection", sequence.num_frames),
    )
    with watch("detection"):
        key = fingerprint(sequence, config.detection, config.association)
        found = cache.stage("detection", key, people.Found, compute)
    points, person = found.by_frame(sequence.num_frames)
    return io.with_detections(
        with_warnings(sequence, found.warnings),
        points,
        config.association,
        person=person,
        detected=found.detected(),
        definition="movenet-blazepose",
    )


def estimate_bodies(sequence: Sequence, body: BodyModel, config: Config) -> Bodies:
    """Returns bodies in the camera frame; of zero people if none are to be
    estimated."""
    if not config.people:
        return people.nobody(sequence.num_frames)
    return people.estimate_bodies(sequence, body, config.people_fit)


def with_warnings(sequence: Sequence, warnings: tuple[str, ...]) -> Sequence:
    """Appends `warnings` to those of the sequence."""
    return dataclasses.replace(sequence, warnings=(*sequence.warnings, *warnings))
