"""Reads a folder, video or images, and files about them, as one checked `Sequence`.

A sequence uses the frames of an interval of time, without repeats (`select_frames`).
"""

import dataclasses
import logging
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from bodyslam_jax.config import Association, Config, Known
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io import budget
from bodyslam_jax.io.bodies.reader import read_bodies
from bodyslam_jax.io.camera.calibration import guess_camera, read_camera, with_focal
from bodyslam_jax.io.camera.path import read_camera_path
from bodyslam_jax.io.camera.recognise import recognised
from bodyslam_jax.io.detected import detected_people, pair
from bodyslam_jax.io.frame_index import Warn, gap_among
from bodyslam_jax.io.keypoints.associate import associate
from bodyslam_jax.io.keypoints.reader import read_detections
from bodyslam_jax.io.masks import read_masks
from bodyslam_jax.io.parts import Parts, find_parts
from bodyslam_jax.io.tracks import read_tracks
from bodyslam_jax.io.video import (
    IMAGE_SUFFIXES,
    VIDEO_SUFFIXES,
    Footage,
    at_rate,
    list_images,
    look_at,
)
from bodyslam_jax.types import (
    DEFAULT_FPS,
    DetectedPeople,
    Intrinsics,
    Sequence,
    Tracks,
    mean_rate,
)

_log = logging.getLogger(__name__)
_MIN_RATE = 8.0
"""Least frame rate, 1/s; below it a step, which takes half a second, has fewer than
four frames."""
_RATE_TOLERANCE = 0.02
"""Relative difference of the frame rates of camera.json and of the video."""
_ASPECT_TOLERANCE = 0.01
"""Difference of an aspect ratio from 1 up to which it counts as 1."""
_TIME_TOLERANCE_S = 1e-6
"""Time by which a frame may be outside the interval, s."""


def read_sequence(
    path: str | Path,
    *,
    keypoints: str | Path | None = None,
    bodies: str | Path | None = None,
    camera: str | Path | None = None,
    tracks: str | Path | None = None,
    masks: str | Path | None = None,
    config: Association = Association(),
    known: Known = Known(),
) -> Sequence:
    """Reads a sequence folder, a video file or a folder of images.

    The options take the place of what a sequence folder holds under the usual names.

    Args:
        keypoints: folder of OpenPose files, or one file of another detector.
        bodies: bodies in the camera frame, `bodies.npz` or another tool's result.
        camera: `camera.json`; without one the intrinsics are guessed.
        tracks: point tracks, `.npz`; without them they come from the images.
        masks: folder of person masks, one image per frame, or an `.npz` with `masks`
            (t, height, width).
        known: what the user knows: focal length, camera path, frame rate, interval.

    **Raises:** `InputError`, one line that names the file, what was found and what was
    expected. All arrays of the result are finite and all indices in range.
    """
    limits = known.limits if isinstance(known, Config) else budget.current()
    given = {
        "keypoints": keypoints,
        "bodies": bodies,
        "camera": camera,
        "tracks": tracks,
        "masks": masks,
    }
    chosen = {k: Path(v) for k, v in given.items() if v is not None}
    parts = dataclasses.replace(find_parts(Path(path)), **chosen)
    if parts.footage is None and parts.tracks is None:
        raise InputError(
            f"{path}: no video.mp4, images/ or tracks.npz, nor one other video "
            f"({' '.join(VIDEO_SUFFIXES)}) or images ({' '.join(IMAGE_SUFFIXES)})."
        )
    with budget.granted(limits):
        return _read_parts(Path(path), parts, config, known)


def _read_parts(
    path: Path, parts: Parts, config: Association, known: Known
) -> Sequence:
    warnings: list[str] = []
    warn = warnings.append
    footage, calibrated, fps = _look_at_footage(parts, known)
    images: tuple[str, ...] = ()
    if footage:
        warnings += footage.warnings
        if footage.path.is_dir():
            images = tuple(p.name for p in list_images(footage.path))
            warnings += filter(None, [gap_among(images)])
    intrinsics = _intrinsics(path, parts, footage, calibrated, fps, images, known, warn)
    size = (intrinsics.width, intrinsics.height)
    tracks = None
    if parts.tracks:
        count = footage.num_read if footage else None
        tracks = read_tracks(parts.tracks, num_frames=count, size=size, warn=warn)
    if footage:
        timestamps, picks = footage.timestamps, footage.picks
        num_frames = footage.num_read
    else:
        if fps is None:
            fps = DEFAULT_FPS
            warn("camera.json has no fps: 30 frames/s assumed.")
        num_frames = _count_frames(parts, tracks, intrinsics, fps, config)
        timestamps, picks = np.arange(num_frames) / fps, None
    times = times_of_all_frames(timestamps, picks, num_frames)
    rate = mean_rate(timestamps)
    if rate < _MIN_RATE:
        warn(
            f"{rate:.3g} frames/s: the motion model, of 30 frames/s, is inaccurate for "
            "motion that is interpolated across such intervals."
        )
    people, detected = None, None
    if parts.keypoints:
        detections = read_detections(
            parts.keypoints,
            num_frames=num_frames,
            width=size[0],
            height=size[1],
            images=images,
            warn=warn,
        )
        people, more = associate(detections.points, config, rate, detections.person)
        definition = known.keypoint_definition or detections.definition
        people = dataclasses.replace(people, definition=definition)
        warnings += more
        detected = detected_people(detections.points)
    bodies = None
    if parts.bodies:
        bodies = read_bodies(
            parts.bodies,
            num_frames=num_frames,
            intrinsics=intrinsics,
            fps=rate,
            times=times,
            images=images,
            config=config,
            warn=warn,
        )
        if people is not None:
            people, bodies = pair(people, bodies, intrinsics)
    mask_use = None
    if parts.masks:
        mask_use = read_masks(
            parts.masks,
            num_frames=num_frames,
            intrinsics=intrinsics,
            images=images,
            people=people,
            bodies=bodies,
            warn=warn,
        )
    camera_path = None
    if known.camera_path is not None:
        camera_path = read_camera_path(
            Path(known.camera_path),
            timestamps=times,
            metric=known.camera_path_metric,
            images=images,
            warn=warn,
        )
    for text in warnings:
        _log.warning("%s: %s", parts.name, text)
    chosen = in_interval(parts.name, timestamps, known)
    if chosen is not None:
        timestamps = timestamps[chosen]
        picks = chosen if picks is None else picks[chosen]
    sequence = Sequence(
        name=parts.name,
        frames=parts.footage,
        timestamps=timestamps,
        intrinsics=intrinsics,
        keypoints=people,
        bodies=bodies,
        tracks=tracks,
        masks=parts.masks,
        mask_use=mask_use,
        groundtruth=parts.groundtruth,
        camera_path=camera_path,
        detected=detected,
        warnings=tuple(warnings),
    )
    return sequence if picks is None else select_frames(sequence, picks)


def _look_at_footage(
    parts: Parts, known: Known
) -> tuple[Footage | None, Intrinsics | None, float | None]:
    """Returns the video or images, the calibration, and the frame rate (1/s) that was
    given.

    The footage is looked at before the camera file, whose cameras are told apart by the
    images' size; a folder of images again after it, at the frame rate of the file.
    """
    footage, intrinsics, fps = None, None, None
    if parts.footage:
        footage = look_at(parts.footage, known.fps)
        if known.fps and not parts.footage.is_dir():
            footage = at_rate(footage, known.fps)
    if parts.camera:
        size = (footage.width, footage.height) if footage else None
        name = footage.path.stem if footage else parts.name
        intrinsics, fps = read_camera(parts.camera, size, name)
    if fps and not known.fps and parts.footage and parts.footage.is_dir():
        footage = look_at(parts.footage, fps)
    fps = known.fps or fps
    return footage, intrinsics, fps


def _intrinsics(
    path: Path,
    parts: Parts,
    footage: Footage | None,
    calibrated: Intrinsics | None,
    fps: float | None,
    images: tuple[str, ...],
    known: Known,
    warn: Warn,
) -> Intrinsics:
    """Returns the calibration at the size of the video, or a guess; with the user's
    focal length, if there is one.

    **Raises:** `InputError` if the calibration is of another size, or there is neither
    a calibration nor a video.
    """
    if calibrated is not None:
        intrinsics = calibrated
        if footage:
            intrinsics = _in_stored_pixels(intrinsics, footage)
            _check_size(parts, intrinsics, footage)
            if not known.fps:
                _check_rate(fps, footage, warn)
        intrinsics = recognised(str(parts.camera), intrinsics, warn)
    elif footage:
        first = footage.path / images[0] if images else None
        size = (footage.width, footage.height)
        intrinsics = guess_camera(*size, first, footage.pixel_aspect)
    else:
        raise InputError(f"{path}: tracks without a video need a camera.json.")
    if footage:
        for text in _aspect_warnings(intrinsics, footage):
            warn(text)
    if calibrated is None and known.focal is None and known.fov is None:
        warn(f"no camera.json: focal length guessed, {intrinsics.params[0]:.0f} px.")
    focal = known.focal_length(intrinsics.width)
    if focal is None:
        return intrinsics
    # Of the principal point the file was asked already, and a guess is in the middle.
    return recognised("focal", with_focal(intrinsics, *focal), lambda text: None)


def _in_stored_pixels(intrinsics: Intrinsics, footage: Footage) -> Intrinsics:
    """Returns the camera in stored pixels, if it was calibrated in images that a player
    has stretched to square pixels; unchanged otherwise.

    Images are never stretched: keypoints, masks and results are in the stored pixels,
    and fx differs from fy. `fy / fx` is the width of a pixel over its height.
    """
    shown = round(footage.width * footage.pixel_aspect), footage.height
    stored = footage.width, footage.height
    if shown == stored or (intrinsics.width, intrinsics.height) != shown:
        return intrinsics
    ratio = footage.width / shown[0]
    params = np.array(intrinsics.params, float)
    params[0] *= ratio
    params[2] = (params[2] + 0.5) * ratio - 0.5
    return dataclasses.replace(intrinsics, params=params, width=footage.width)


def _aspect_warnings(intrinsics: Intrinsics, footage: Footage) -> tuple[str, ...]:
    """Returns warnings about pixels that are not square."""
    declared = footage.pixel_aspect
    used = float(intrinsics.params[1] / intrinsics.params[0])
    if abs(declared - 1) < _ASPECT_TOLERANCE:
        return ()
    name = footage.path.name
    if abs(used / declared - 1) < _ASPECT_TOLERANCE:
        return (
            f"{name}: pixels {declared:.4g} times as wide as high, by the container: "
            "fx and fy differ by that.",
        )
    return (
        f"{name}: pixels {declared:.4g} times as wide as high, by the container, but "
        f"camera.json has fy/fx = {used:.4g}: camera.json used.",
    )


def _check_size(parts: Parts, intrinsics: Intrinsics, footage: Footage) -> None:
    if (intrinsics.width, intrinsics.height) != (footage.width, footage.height):
        raise InputError(
            f"{parts.camera}: for {intrinsics.width}x{intrinsics.height} px, but "
            f"{footage.path.name} has {footage.width}x{footage.height} px; expected a "
            "calibration of images of that size, as they are shown."
        )


def _check_rate(fps: float | None, footage: Footage, warn: Warn) -> None:
    if fps is None or len(footage.timestamps) < 2:
        return
    rate = mean_rate(footage.timestamps)
    if abs(rate - fps) > _RATE_TOLERANCE * fps:
        warn(f"camera.json has {fps:g} frames/s, the video {rate:.4g}: video used.")


def _count_frames(
    parts: Parts,
    tracks: Tracks | None,
    intrinsics: Intrinsics,
    fps: float,
    config: Association,
) -> int:
    """Returns the number of frames of a sequence without images: as many as any of its
    parts has."""
    found = [int(tracks.frame.max()) + 1] if tracks else []
    quiet = _log.debug  # the files are read again with their length, and warn then
    if parts.keypoints:
        detections = read_detections(
            parts.keypoints,
            num_frames=None,
            width=intrinsics.width,
            height=intrinsics.height,
            warn=quiet,
        )
        found.append(len(detections.points))
    if parts.bodies:
        bodies = read_bodies(
            parts.bodies,
            num_frames=None,
            intrinsics=intrinsics,
            fps=fps,
            config=config,
            warn=quiet,
        )
        found.append(bodies.present.shape[1])
    return max(found)


def in_interval(
    name: str, timestamps: Float[np.ndarray, " t"], known: Known
) -> Int[np.ndarray, " k"] | None:
    """Returns indices of the frames from `known.start` to `known.end` (s); `None` for
    all.

    **Raises:** `InputError`, naming the video, if there is no frame in the interval.
    """
    if known.start is None and known.end is None:
        return None
    start = 0.0 if known.start is None else known.start
    end = np.inf if known.end is None else known.end
    inside = (timestamps >= start - _TIME_TOLERANCE_S) & (
        timestamps <= end + _TIME_TOLERANCE_S
    )
    (chosen,) = np.nonzero(inside)
    if not len(chosen):
        raise InputError(
            f"{name}: no frame between {start:g} and {end:g} s, the video is "
            f"{timestamps[-1]:.2f} s long."
        )
    return chosen


def times_of_all_frames(
    timestamps: Float[np.ndarray, " t"],
    picks: Int[np.ndarray, " t"] | None,
    num_frames: int,
) -> Float[np.ndarray, " n"]:
    """Returns times (s) of all frames of a video, of which `timestamps` are those of
    `picks`.

    Frames that are left out get interpolated times.
    """
    if picks is None:
        return timestamps
    return np.interp(np.arange(num_frames), picks, timestamps)


def select_frames(sequence: Sequence, picks: Int[np.ndarray, " t"]) -> Sequence:
    """Returns the data that were read for all frames of a video, for the frames
    `picks`.

    `sequence.timestamps` are already those of `picks`.
    """
    path, tracks, detected = (
        sequence.camera_path,
        sequence.tracks,
        sequence.detected,
    )
    if path is not None:
        path = dataclasses.replace(path, T_WC=path.T_WC[picks], known=path.known[picks])
    if tracks is not None:
        kept = np.isin(tracks.frame, picks)
        _, landmark = np.unique(tracks.landmark[kept], return_inverse=True)
        frame = np.searchsorted(picks, tracks.frame[kept])
        tracks = Tracks(frame, landmark.astype(np.int64), tracks.uv[kept])
    if detected is not None:
        kept = np.isin(detected.frame, picks)
        frame = np.searchsorted(picks, detected.frame[kept])
        detected = DetectedPeople(frame, detected.keypoints[kept])
    return dataclasses.replace(
        sequence,
        keypoints=_cut(sequence.keypoints, picks),
        bodies=_cut(sequence.bodies, picks),
        tracks=tracks,
        detected=detected,
        picks=picks,
        camera_path=path,
    )


def _cut(people, picks: Int[np.ndarray, " t"]):
    """Returns keypoints or bodies, whose arrays have the axes (h, t, ...), at some
    frames."""
    if people is None:
        return None
    arrays = {k: v for k, v in vars(people).items() if isinstance(v, np.ndarray)}
    return dataclasses.replace(people, **{k: v[:, picks] for k, v in arrays.items()})
