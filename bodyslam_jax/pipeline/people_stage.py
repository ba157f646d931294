"""Detects people, if no keypoints are given, and estimates their bodies for the cameras
of structure from motion."""

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from bodyslam_jax import io, people
from bodyslam_jax.body import BodyModel
from bodyslam_jax.config import Config
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.geometry.lengths import padded_length
from bodyslam_jax.pipeline.progress import Counter, Stopwatch, compiling
from bodyslam_jax.pipeline.stage_cache import Cache, body_model_file, fingerprint
from bodyslam_jax.types import Bodies, Sequence, SfmResult


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
    counter = Counter("detection", sequence.num_frames)
    per_frame = config.detect == "yolox"
    used = (config.detection,) if per_frame else (config.detection, config.association)
    key = fingerprint(sequence, *used)
    if per_frame:
        # YOLOX and RTMPose in every frame; people are associated over time afterwards.
        def of_frames() -> Detections:
            found = people.detect_people(
                io.frames(sequence),
                config.detection,
                offline=config.offline,
                progress=counter,
            )
            count = np.array([len(points) for points in found])
            return Detections(count, np.concatenate(found))

        with watch("detection"):
            found = cache.stage("detection", key, Detections, of_frames)
        return io.with_detections(
            sequence, found.by_frame(), config.association, definition="coco"
        )

    # The networks of the package, which detect and track people in one pass.
    def of_video() -> people.Found:
        return people.find_people_tracked(
            io.frames(sequence),
            sequence.fps,
            config.detection,
            config.association,
            counter,
        )

    with watch("detection"):
        tracked = cache.stage("detection", key, people.Found, of_video)
    points, person = tracked.by_frame(sequence.num_frames)
    return io.with_detections(
        with_warnings(sequence, tracked.warnings),
        points,
        config.association,
        person=person,
        detected=tracked.detected(),
        definition="movenet-blazepose",
    )


def with_warnings(sequence: Sequence, warnings: tuple[str, ...]) -> Sequence:
    """Appends `warnings` to those of the sequence."""
    return dataclasses.replace(sequence, warnings=(*sequence.warnings, *warnings))


def bodies_in_camera(
    sequence: Sequence,
    cameras: SfmResult,
    body: BodyModel,
    config: Config,
    cache: Cache,
    watch: Stopwatch,
) -> tuple[Sequence, Bodies]:
    """Returns the sequence of the selected people, with the intrinsics of `cameras`,
    and their bodies in the camera frame; of zero people if none are to be estimated."""
    sequence = people.select_people(sequence, config.person)
    sequence = with_intrinsics(sequence, cameras.intrinsics, cameras.zoom)
    keypoints, regressed = sequence.keypoints, sequence.bodies
    number = 0 if keypoints is None else len(keypoints.uv)
    if regressed is not None:
        number = max(number, len(regressed.present))

    def compute() -> Bodies:
        if not config.people:
            return people.nobody(sequence.num_frames)
        with compiling("people", size_of(sequence.num_frames, number)):
            return people.estimate_bodies(sequence, body, config.people_fit)

    model = body_model_file(config.body_model)
    key = fingerprint(sequence, config.people_fit, config.people, model)
    with watch("people"):
        return sequence, cache.stage("people", key, Bodies, compute)


def size_of(num_frames: int, num_people: int) -> str:
    """Returns the sizes of arrays that determine which programs a problem needs."""
    return f"{padded_length(num_frames)} frames, {num_people} people"


def with_intrinsics(
    sequence: Sequence,
    intrinsics: Float[np.ndarray, " i"],
    zoom: Float[np.ndarray, " t"] | None = None,
) -> Sequence:
    """Returns the sequence with other intrinsics, and with bodies and keypoints to
    match.

    Regressed bodies keep their position and size in the image: a regressor infers depth
    from size, so depth is proportional to the focal length.

    Args:
        intrinsics: new intrinsics, px.
        zoom: logarithm of each frame's focal length over that of `intrinsics`. The
            returned keypoints and bodies are those of images without the zoom.
    """
    if zoom is not None:
        sequence = _without_zoom(sequence, zoom)
    given = sequence.intrinsics
    if np.array_equal(given.params, intrinsics):
        return sequence
    bodies = sequence.bodies
    if bodies is not None:
        # The model may have gained distortion, or pixels that are not square.
        focal = np.sqrt(intrinsics[0] * intrinsics[1])
        focal /= np.sqrt(given.params[0] * given.params[1])
        ratio = np.array([1.0, 1.0, focal])
        bodies = dataclasses.replace(bodies, trans=bodies.trans * ratio)
    return dataclasses.replace(
        sequence,
        intrinsics=dataclasses.replace(given, params=intrinsics),
        bodies=bodies,
    )


def _without_zoom(sequence: Sequence, zoom: Float[np.ndarray, " t"]) -> Sequence:
    """Returns the sequence with keypoints and bodies as seen without the zoom."""
    size = np.exp(zoom)
    keypoints, bodies = sequence.keypoints, sequence.bodies
    if keypoints is not None:
        centre = np.asarray(sequence.intrinsics.params[2:4], float)
        uv = centre + (keypoints.uv - centre) / size[:, None, None]
        uv = np.where(keypoints.confidence[..., None] > 0, uv, keypoints.uv)
        keypoints = dataclasses.replace(keypoints, uv=uv)
    if bodies is not None:
        # The offset from the optical axis is kept; depth is proportional to the zoom.
        trans = bodies.trans * np.stack([size * 0 + 1, size * 0 + 1, size], axis=-1)
        bodies = dataclasses.replace(bodies, trans=trans)
    return dataclasses.replace(sequence, keypoints=keypoints, bodies=bodies)
