"""Estimates cameras and map up to scale from tracks, and a guessed focal length.

The stage selects the camera model, runs structure from motion, and then bundle
adjustment of all frames and landmarks. Structure from motion is repeated if bundle
adjustment changes a guessed focal length. `find_edges` finds straight segments, which
show the vertical, in the images of these cameras.
"""

import dataclasses
import logging

import numpy as np
from jaxtyping import Float, Int

from bodyslam_jax import sfm
from bodyslam_jax.config import Config
from bodyslam_jax.ground.vertical_edges import Edges, make_edges
from bodyslam_jax.pipeline.bundle_adjustment import (
    HELD_FOCAL_SIGMA,
    adjust,
    clipped_sigma,
    self_calibrated,
)
from bodyslam_jax.pipeline.stage_cache import Cache, fingerprint
from bodyslam_jax.types import Intrinsics, JointEstimate, Sequence, SfmResult, Tracks

log = logging.getLogger(__name__)

_MAX_FOCAL_CHANGE = 0.02
"""Relative change of the focal length above which structure from motion is repeated."""
_MAX_ROTATION_ERROR_RATIO = 1.5
"""Ratio between the errors of a rotating and of a moving camera above which rotation
alone does not explain the images."""
_EDGE_IMAGES = 24
"""Number of images that are searched for edges, evenly spread over the clip."""


def estimate(sequence: Sequence, tracks: Tracks, config: Config) -> SfmResult:
    """Estimates cameras, map and intrinsics of a sequence, up to scale.

    The result's `kind` tells whether the camera moves, rotates or stands still; in the
    last two cases a guessed focal length is kept.
    """
    cameras = _estimate(sequence, tracks, config)
    for text in cameras.warnings:
        log.warning("%s", text)
    log.info(
        "cameras: %s, %d of %d frames located, %d landmarks%s",
        cameras.kind,
        cameras.registered.sum(),
        len(cameras.registered),
        len(cameras.landmarks),
        f", noise {cameras.pixel_sigma:.2f} px" if cameras.kind == "moving" else "",
    )
    if np.isfinite(cameras.focal_sigma):
        log.info(
            "focal length: %.0f ± %.0f px, guess %.0f px",
            cameras.focal,
            cameras.focal_sigma,
            sequence.intrinsics.params[0],
        )
    return cameras


def _estimate(sequence: Sequence, tracks: Tracks, config: Config) -> SfmResult:
    """Does the work of `estimate`, without its log lines."""
    num_frames = sequence.num_frames
    warnings = tracks.warnings
    tracks, share = sfm.without_burnt_in(tracks, sequence.intrinsics, num_frames)
    if share > 0 and sequence.tracks is not None:
        warnings = (*warnings, sfm.burnt_in_warning(share))
    if sequence.camera_path is not None:
        placed = sfm.place_in_time(
            sequence.camera_path, tracks, sequence.intrinsics, sequence.timestamps
        )
        warnings = (*warnings, *placed.warnings)
        sequence = dataclasses.replace(
            sequence, camera_path=placed.path, intrinsics=placed.intrinsics
        )
    if config.static_camera or sequence.camera_path is not None:
        found = reconstruct(sequence, tracks, sequence.intrinsics, config)
        model = sfm.CameraModel(sequence.intrinsics, None, tracks, found, ())
    else:
        model = sfm.find_camera_model(
            tracks,
            sequence.intrinsics,
            num_frames,
            config.structure,
            sequence.keypoints,
        )
    sequence = dataclasses.replace(sequence, intrinsics=model.intrinsics)
    cameras = _of_model(sequence, model, config)
    warnings = (*warnings, *model.warnings, *cameras.warnings)
    moved = sfm.second_motion_warning(model.tracks, model.found, model.intrinsics)
    if moved is not None:
        warnings = (*warnings, moved)
    if config.static_camera:
        wander = sfm.background_motion(model.tracks, model.intrinsics)
        cameras = dataclasses.replace(cameras, wander=wander)
    return dataclasses.replace(cameras, warnings=warnings, zoom=model.zoom)


def _of_model(sequence: Sequence, model: sfm.CameraModel, config: Config) -> SfmResult:
    """Returns the bundle-adjusted cameras of a sequence with the intrinsics of
    `model`."""
    guess, found = sequence.intrinsics, model.found
    cameras = _unadjusted(sequence, found, guess, config)
    if found.kind != "moving":
        return cameras
    if guess.is_refined:
        cameras = _with_focal(sequence, model.tracks, cameras, found.error, config)
    else:
        cameras = adjust(cameras, 1.0, config, None)
    if cameras.kind != "moving":
        return cameras
    if not guess.is_guess:
        found_by_tracks = self_calibrated(cameras, config)
        cameras = dataclasses.replace(cameras, from_tracks=found_by_tracks)
    # Last, because unsplit tracks determine path and focal length better.
    return _split_tracks(cameras, config.structure.landmark_span)


def _with_focal(
    sequence: Sequence, tracks: Tracks, cameras: SfmResult, error: float, config: Config
) -> SfmResult:
    """Returns cameras with an estimated focal length, or with the guess if the camera's
    path does not determine it."""
    guess = sequence.intrinsics
    sigma = clipped_sigma(error / sfm.ERROR_PER_SIGMA)
    adjusted = cameras
    for _ in range(3):
        adjusted = adjust(cameras, sigma, config, guess)
        if adjusted.focal_sigma > config.structure.focal_accuracy * adjusted.focal:
            return _with_guess(sequence, tracks, adjusted, config)
        if abs(adjusted.focal / cameras.focal - 1) < _MAX_FOCAL_CHANGE:
            break
        better = dataclasses.replace(guess, params=adjusted.intrinsics)
        again = reconstruct(sequence, tracks, better, config)
        cameras, sigma = (
            _unadjusted(sequence, again, better, config),
            adjusted.pixel_sigma,
        )
        if again.kind != "moving":
            if again.error > _MAX_ROTATION_ERROR_RATIO * sfm.ERROR_PER_SIGMA * sigma:
                return adjusted  # Rotation alone does not explain the small motion.
            # With a wrong focal length, a rotating camera appeared to move.
            return dataclasses.replace(cameras, focal_sigma=adjusted.focal_sigma)
    return adjusted


def _split_tracks(cameras: SfmResult, span: int) -> SfmResult:
    """Splits landmarks of long tracks into pieces of at most `span` frames, so that
    each is observed by few cameras; the information of other pieces becomes a prior."""
    tracks = cameras.tracks
    of, piece = sfm.split_tracks(tracks.frame, tracks.landmark, span)
    kept = cameras.keep
    information = sfm.information_from_other_pieces(
        cameras.T_WC, cameras.landmarks, tracks.frame[kept], piece[kept], of
    )
    count = np.bincount(of)[of]
    prior = cameras.prior_information[of] / count[:, None, None]
    prior_mean = cameras.landmarks[of]
    return dataclasses.replace(
        cameras,
        landmarks=prior_mean,
        tracks=Tracks(tracks.frame, piece, tracks.uv),
        prior_mean=prior_mean,
        prior_information=prior + cameras.focal**2 * information,
    )


def reconstruct(
    sequence: Sequence, tracks: Tracks, intrinsics: Intrinsics, config: Config
) -> sfm.Reconstruction:
    """Runs structure from motion with these intrinsics, and with a given camera
    path."""
    return sfm.reconstruct(
        tracks,
        intrinsics,
        sequence.num_frames,
        config.structure,
        path=sequence.camera_path,
        static=config.static_camera,
    )


def _unadjusted(
    sequence: Sequence,
    found: sfm.Reconstruction,
    intrinsics: Intrinsics,
    config: Config,
) -> SfmResult:
    """Converts a reconstruction to an `SfmResult`, before bundle adjustment."""
    path = sequence.camera_path if found.kind == "moving" else None
    return SfmResult(
        kind=found.kind,
        T_WC=found.T_WC,
        registered=found.registered,
        landmarks=found.landmarks,
        tracks=found.tracks,
        keep=np.ones(len(found.tracks.frame), bool),
        prior_information=found.prior_information,
        prior_mean=found.landmarks,
        pixel_sigma=config.weights.pixel_sigma or 1.0,
        intrinsics=np.asarray(intrinsics.params, float),
        focal_sigma=float("nan"),
        costs=(0.0, 0.0),
        warnings=tuple(found.warnings),
        path=None if path is None else found.T_WC,
        path_known=None if path is None else path.known,
        path_scale=found.unit if path and path.metric else float("nan"),
    )


def _with_guess(
    sequence: Sequence, tracks: Tracks, adjusted: SfmResult, config: Config
) -> SfmResult:
    """Returns cameras with the guessed focal length held constant, and a warning, for a
    path that does not determine it."""
    guess = sequence.intrinsics
    found = reconstruct(sequence, tracks, guess, config)
    held = dataclasses.replace(config.structure, focal_sigma=HELD_FOCAL_SIGMA)
    cameras = adjust(
        _unadjusted(sequence, found, guess, config),
        adjusted.pixel_sigma,
        dataclasses.replace(config, structure=held),
        guess,
    )
    text = (
        f"focal length not determined by the camera's path (± "
        f"{100 * adjusted.focal_sigma / adjusted.focal:.0f} %): the guess of "
        f"{guess.params[0]:.0f} px is kept; give camera.json if it is known."
    )
    return dataclasses.replace(
        cameras, focal_sigma=float("nan"), warnings=(*cameras.warnings, text)
    )


def find_edges(
    sequence: Sequence,
    cameras: SfmResult,
    joint: JointEstimate | None = None,
    cache: Cache = Cache(None),
) -> Edges | None:
    """Finds straight segments in images, outside people, in the world of the cameras.

    Returns `None` without images or cameras.

    Args:
        sequence: the input, with the zoom of its images.
        cameras: result of structure from motion.
        joint: its cameras and intrinsics are used instead, if given.

    **Raises:** `ValueError` if an image cannot be read.
    """
    if sequence.frames is None or cameras.kind == "failed":
        return None
    wanted = _images_with_edges(cameras)
    segments = cache.stage(
        "segments",
        fingerprint(sequence, wanted),
        sfm.Segments,
        lambda: sfm.find_segments(sequence, wanted),
    )
    ends = segments.ends
    T_WC, intrinsics = cameras.T_WC, cameras.intrinsics
    if joint is not None:
        T_WC, intrinsics = joint.cameras, joint.intrinsics
    if cameras.zoom is not None:
        centre = intrinsics[2:4]
        size = np.exp(cameras.zoom[segments.frame])[:, None, None]
        ends = centre + (ends - centre) / size
    return make_edges(segments.frame, ends, wanted, T_WC[:, :3, :3], intrinsics)


def _images_with_edges(cameras: SfmResult) -> Int[np.ndarray, " n"]:
    """Returns the indices of the images that are searched for segments."""
    frames = np.flatnonzero(cameras.within)
    places: Float[np.ndarray, " n"] = np.linspace(0, len(frames) - 1, _EDGE_IMAGES)
    return np.unique(frames[places.round().astype(int)])
