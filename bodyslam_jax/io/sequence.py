"""A folder, video or images, and what is known about them -> one checked `Sequence`."""

import dataclasses
import logging
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from bodyslam_jax.config import Association, Known
from bodyslam_jax.io.aspect import aspect_warnings, at_size_of
from bodyslam_jax.io.bodies.reader import read_bodies
from bodyslam_jax.io.camera.calibration import guess_camera, read_camera, with_focal
from bodyslam_jax.io.camera.path import read_camera_path
from bodyslam_jax.io.frame_index import gap_among
from bodyslam_jax.io.keypoints.associate import associate
from bodyslam_jax.io.keypoints.reader import Detections, read_detections
from bodyslam_jax.io.masks import read_masks
from bodyslam_jax.io.match_people import pair
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
    Bodies,
    Intrinsics,
    Keypoints,
    Seen,
    Sequence,
    Tracks,
)

_log = logging.getLogger(__name__)

_FEWEST_A_SECOND = 8.0
"""Frames in which a step is still seen: it takes half a second."""
_FPS_TOLERANCE = 0.02


@dataclasses.dataclass(frozen=True)
class _Parts:
    """Where each part of a sequence lies; None where there is none."""

    name: str
    footage: Path | None = None
    keypoints: Path | None = None
    bodies: Path | None = None
    camera: Path | None = None
    tracks: Path | None = None
    masks: Path | None = None
    groundtruth: Path | None = None


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
        masks: folder of person masks, one image per frame.
        known: what a user knows: focal length, camera path, frame rate, where to begin
            and to end.

    **Raises:** `ValueError`, one line that names the file, what was found and what was
    expected; nothing that is not finite and in range gets past here.
    """
    given = {
        "keypoints": keypoints,
        "bodies": bodies,
        "camera": camera,
        "tracks": tracks,
        "masks": masks,
    }
    chosen = {k: Path(v) for k, v in given.items() if v is not None}
    parts = dataclasses.replace(_find_parts(Path(path)), **chosen)
    if parts.footage is None and parts.tracks is None:
        raise ValueError(
            f"{path}: no video.mp4, images/ or tracks.npz, nor one other video "
            f"({' '.join(VIDEO_SUFFIXES)}) or images ({' '.join(IMAGE_SUFFIXES)})."
        )
    return _read_parts(Path(path), parts, config, known)


def with_detections(
    sequence: Sequence,
    detections: Detections,
    config: Association = Association(),
    *,
    person: list[np.ndarray] | None = None,
    seen: Seen | None = None,
) -> Sequence:
    """The sequence with people made of what a detector found in each of its frames.

    Where bodies are given, they say who is estimated: keypoints of others only keep
    them out of the map.

    Args:
        person: for each frame who each detection is, where the detector says so.
        seen: everybody, also whom `detections` leaves out; by default who is in it.
    """
    seen = seen or _seen(detections)
    sequence = dataclasses.replace(sequence, seen=seen)
    if not any(len(found) for found in detections):
        text = "nobody was found in the images"
        if sequence.bodies is None:
            text += ": cameras and map only, and these without a unit"
        return _warned(sequence, (f"{text}.",))
    people, warnings = associate(detections, config, sequence.fps, person)
    bodies = sequence.bodies
    if bodies is not None:
        count = len(bodies.present)
        people, bodies = pair(people, bodies, sequence.intrinsics)
        people, bodies, others = _with_body(people, bodies)
        if others:
            warnings = (*warnings, _OTHERS.format(others, count))
    sequence = dataclasses.replace(sequence, keypoints=people, bodies=bodies)
    return _warned(sequence, warnings)


_OTHERS = "{} more people were found than the {} whose bodies are given: not estimated."


def _warned(sequence: Sequence, warnings: tuple[str, ...]) -> Sequence:
    return dataclasses.replace(sequence, warnings=(*sequence.warnings, *warnings))


def _seen(detections: Detections) -> Seen:
    count = [len(found) for found in detections]
    points = np.concatenate([np.zeros((0, 25, 3)), *detections])
    return Seen(np.repeat(np.arange(len(count)), count), points)


def _with_body(people: Keypoints, bodies: Bodies) -> tuple[Keypoints, Bodies, int]:
    """Only people with a body, in the order of `pair`, and how many had none."""
    kept = bodies.present.any(axis=1)
    if not kept.any():
        return people, bodies, 0
    cut = dataclasses.replace(
        bodies,
        **{
            n: getattr(bodies, n)[kept] for n in ("present", "poses", "shapes", "trans")
        },
    )
    return Keypoints(people.uv[kept], people.confidence[kept]), cut, int((~kept).sum())


def _find_parts(path: Path) -> _Parts:
    """What lies where in a sequence folder, or that it is just a video or images."""
    if not path.exists():
        raise ValueError(f"{path}: no such file or folder.")
    if path.is_file():
        return _Parts(name=path.stem, footage=path)
    within = lambda name: path / name if (path / name).exists() else None
    footage = within("video.mp4") or within("images")
    if footage is None:
        # Not what a run writes, where its folder is the input's.
        videos = sorted(
            p
            for p in path.iterdir()
            if p.suffix.lower() in VIDEO_SUFFIXES
            and p.name != "overlay.webm"
            and not p.name.startswith(".")
            and p.is_file()
        )
        named = [p for p in videos if p.stem == "video"]
        if len(named or videos) > 1:
            names = ", ".join(p.name for p in (named or videos)[:4])
            raise ValueError(f"{path}: which video? {names}; give the file itself.")
        footage = (named or videos or [None])[0]
    if footage is None and list_images(path):
        footage = path
    return _Parts(
        name=path.resolve().name,
        footage=footage,
        keypoints=within("keypoints") or within("keypoints.npz"),
        bodies=within("bodies.npz"),
        camera=within("camera.json"),
        tracks=within("tracks.npz"),
        masks=within("masks"),
        groundtruth=within("groundtruth"),
    )


def _read_parts(
    path: Path, parts: _Parts, config: Association, known: Known
) -> Sequence:
    footage, calibrated = None, None
    if parts.footage and not parts.footage.is_dir():
        footage = look_at(parts.footage)
        footage = at_rate(footage, known.fps) if known.fps else footage
    if parts.camera:
        size = (footage.width, footage.height) if footage else None
        calibrated = read_camera(parts.camera, size)
    fps = known.fps or (calibrated[1] if calibrated else None)
    if parts.footage and footage is None:
        footage = look_at(parts.footage, fps)
    warnings = list(footage.warnings) if footage else []
    images: tuple[str, ...] = ()
    if footage and footage.path.is_dir():
        images = tuple(p.name for p in list_images(footage.path))
        gap = gap_among(images)
        warnings += [gap] if gap else []
    if calibrated:
        intrinsics = calibrated[0]
        if footage:
            intrinsics = at_size_of(intrinsics, footage)
            rate = None if known.fps else fps
            warnings += _check_camera(parts, intrinsics, rate, footage)
            warnings += aspect_warnings(intrinsics, footage)
    elif footage:
        first = footage.path / images[0] if images else None
        intrinsics = guess_camera(
            footage.width, footage.height, first, footage.pixel_aspect
        )
        warnings += aspect_warnings(intrinsics, footage)
        if known.focal is None and known.fov is None:
            warnings.append(
                f"no camera.json: focal length guessed, {intrinsics.params[0]:.0f} px."
            )
    else:
        raise ValueError(f"{path}: tracks without a video need a camera.json.")
    focal = known.focal_length(intrinsics.width)
    if focal is not None:
        intrinsics = with_focal(intrinsics, *focal)
    size = (intrinsics.width, intrinsics.height)

    found_tracks = None
    if parts.tracks:
        count = footage.num_read if footage else None
        found_tracks = read_tracks(
            parts.tracks, num_frames=count, size=size, warn=warnings.append
        )
    if footage:
        stamps, num_frames, picks = footage.timestamps, footage.num_read, footage.picks
    else:
        if fps is None:
            fps = 30.0
            warnings.append("camera.json has no fps: 30 frames/s assumed.")
        num_frames, picks = (
            _count_frames(parts, found_tracks, intrinsics, fps, config),
            None,
        )
        stamps = np.arange(num_frames) / fps
    rate = (len(stamps) - 1) / (stamps[-1] - stamps[0]) if len(stamps) > 1 else 30.0
    if rate < _FEWEST_A_SECOND:
        warnings.append(
            f"{rate:.3g} frames/s: people do not move as straight between frames as "
            "the motion model, of 30, has to take them to."
        )

    people, seen = None, None
    if parts.keypoints:
        detected = read_detections(
            parts.keypoints,
            num_frames=num_frames,
            width=size[0],
            height=size[1],
            images=images,
            warn=warnings.append,
        )
        people, more = associate(detected.points, config, rate, detected.person)
        warnings += more
        seen = _seen(detected.points)
    regressed = None
    if parts.bodies:
        regressed = read_bodies(
            parts.bodies,
            num_frames=num_frames,
            intrinsics=intrinsics,
            fps=rate,
            times=stamps if picks is None else _times_of_all(stamps, picks, num_frames),
            images=images,
            config=config,
            warn=warnings.append,
        )
        if people is not None:
            people, regressed = pair(people, regressed, intrinsics)
    mask_use = None
    if parts.masks:
        mask_use = read_masks(
            parts.masks,
            num_frames=num_frames,
            intrinsics=intrinsics,
            images=images,
            people=people,
            bodies=regressed,
            warn=warnings.append,
        )
    path_ = None
    if known.camera_path is not None:
        times = stamps if picks is None else _times_of_all(stamps, picks, num_frames)
        path_ = read_camera_path(
            Path(known.camera_path),
            timestamps=times,
            metric=known.camera_path_metric,
            images=images,
            warn=warnings.append,
        )
    for text in warnings:
        _log.warning("%s: %s", parts.name, text)
    chosen = _between(parts.name, stamps, known)
    if chosen is not None:
        stamps = stamps[chosen]
        picks = chosen if picks is None else picks[chosen]
    sequence = Sequence(
        name=parts.name,
        frames=parts.footage,
        timestamps=stamps,
        intrinsics=intrinsics,
        keypoints=people,
        bodies=regressed,
        tracks=found_tracks,
        masks=parts.masks,
        mask_use=mask_use,
        groundtruth=parts.groundtruth,
        camera_path=path_,
        seen=seen,
        warnings=tuple(warnings),
    )
    return sequence if picks is None else _thinned(sequence, picks)


def _between(
    name: str, stamps: Float[np.ndarray, " t"], known: Known
) -> Int[np.ndarray, " k"] | None:
    """Which of the frames at `stamps` (s) are asked for; `None` for all.

    **Raises:** `ValueError` if there are none.
    """
    if known.start is None and known.end is None:
        return None
    start = 0.0 if known.start is None else known.start
    end = np.inf if known.end is None else known.end
    (chosen,) = np.nonzero((stamps >= start - 1e-6) & (stamps <= end + 1e-6))
    if not len(chosen):
        raise ValueError(
            f"{name}: no frame between {start:g} and {end:g} s, the video is "
            f"{stamps[-1]:.2f} s long."
        )
    return chosen


def _count_frames(
    parts: _Parts,
    tracks: Tracks | None,
    intrinsics: Intrinsics,
    fps: float,
    config: Association,
) -> int:
    """Frames of a sequence without images: as many as any of its parts has."""
    found = [int(tracks.frame.max()) + 1] if tracks else []
    quiet = _log.debug  # it is all read again, and said then
    if parts.keypoints:
        detected = read_detections(
            parts.keypoints,
            num_frames=None,
            width=intrinsics.width,
            height=intrinsics.height,
            warn=quiet,
        )
        found.append(len(detected.points))
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


def _times_of_all(stamps: np.ndarray, picks: np.ndarray, num_frames: int) -> np.ndarray:
    """Times also of frames that are left out, where they hardly matter."""
    return np.interp(np.arange(num_frames), picks, stamps)


def _thinned(sequence: Sequence, picks: np.ndarray) -> Sequence:
    """Only these frames of what was read for all of them; times are theirs already."""

    def cut(bundle):
        if bundle is None:
            return None
        arrays = {k: v for k, v in vars(bundle).items() if isinstance(v, np.ndarray)}
        return dataclasses.replace(
            bundle, **{k: v[:, picks] for k, v in arrays.items()}
        )

    path = sequence.camera_path
    if path is not None:
        path = dataclasses.replace(path, T_WC=path.T_WC[picks], known=path.known[picks])
    tracks = sequence.tracks
    if tracks is not None:
        kept = np.isin(tracks.frame, picks)
        _, landmark = np.unique(tracks.landmark[kept], return_inverse=True)
        frame = np.searchsorted(picks, tracks.frame[kept])
        tracks = Tracks(frame, landmark.astype(np.int64), tracks.uv[kept])
    seen = sequence.seen
    if seen is not None:
        kept = np.isin(seen.frame, picks)
        seen = Seen(np.searchsorted(picks, seen.frame[kept]), seen.points[kept])
    return dataclasses.replace(
        sequence,
        keypoints=cut(sequence.keypoints),
        bodies=cut(sequence.bodies),
        tracks=tracks,
        seen=seen,
        picks=picks,
        camera_path=path,
    )


def _check_camera(
    parts: _Parts, intrinsics: Intrinsics, fps: float | None, footage: Footage
) -> tuple[str, ...]:
    if (intrinsics.width, intrinsics.height) != (footage.width, footage.height):
        raise ValueError(
            f"{parts.camera}: for {intrinsics.width}x{intrinsics.height} px, but "
            f"{footage.path.name} has {footage.width}x{footage.height} px."
        )
    stamps = footage.timestamps
    if fps is None or len(stamps) < 2:
        return ()
    rate = (len(stamps) - 1) / (stamps[-1] - stamps[0])
    if abs(rate - fps) > _FPS_TOLERANCE * fps:
        return (
            f"camera.json says {fps:g} frames/s, the video {rate:.4g}: video used.",
        )
    return ()
