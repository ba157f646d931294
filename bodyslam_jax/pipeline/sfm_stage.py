"""Estimates cameras and map up to scale from tracks, and a guessed focal length.

The stage selects the camera model, runs structure from motion, and then bundle
adjustment of all frames and landmarks. Structure from motion is repeated if bundle
adjustment changes a guessed focal length.

A guessed focal length is a variable of bundle adjustment with a wide prior around the
guess. Inconsistency between parallax and rotation determines it. Distortion is not
estimated here.
"""

import dataclasses
import logging

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from bodyslam_jax import graph, initialisation, sfm, solver
from bodyslam_jax.config import Config, Structure
from bodyslam_jax.geometry.camera import project_rows
from bodyslam_jax.pipeline.progress import Counter, Stopwatch
from bodyslam_jax.pipeline.stage_cache import Cache, fingerprint
from bodyslam_jax.types import Intrinsics, Sequence, SfmResult, Tracks

log = logging.getLogger(__name__)

_MAX_FOCAL_CHANGE = 0.02
"""Relative change of the focal length above which structure from motion is repeated."""
_MAX_ROTATION_ERROR_RATIO = 1.5
"""Ratio between the errors of a rotating and of a moving camera above which rotation
alone does not explain the images."""
_HELD_FOCAL_SIGMA = 1e-6
"""Relative sigma of a prior that holds the focal length constant."""
_MAX_PRIOR_FOCAL_CHANGE = 0.005
"""Relative change of the focal length above which the priors of landmarks, which were
triangulated with the previous one, are dropped."""
_ASPECT_SIGMA = 1e-4
"""Sigma of the difference of fx and fy, relative to the focal length."""
_FOCAL_PRIOR_SIGMA, _CENTRE_PRIOR_SIGMA = 0.5, 0.2
"""Standard deviations of focal length and principal point, relative to the focal
length, of priors that only prevent self-calibration from diverging."""
_MAX_RESIDUAL_SIGMAS = 10.0
"""Residual, in sigmas, above which an observation is an outlier."""


def cameras_and_map(
    sequence: Sequence, config: Config, cache: Cache, watch: Stopwatch
) -> SfmResult:
    """Returns the result of `estimate` for the given tracks, or for tracks of features
    through the images; both are kept in the cache."""
    key = fingerprint(sequence, config.tracking)

    def find_tracks() -> Tracks:
        if sequence.tracks is not None:
            return sequence.tracks
        return sfm.track(sequence, config.tracking, Counter("tracks"))

    with watch("tracks"):
        tracks = cache.stage("tracks", key, Tracks, find_tracks)
    key = fingerprint(
        key, config.structure, config.weights.landmark_loss, config.static_camera
    )

    def find_cameras() -> SfmResult:
        return estimate(sequence, tracks, config)

    with watch("cameras"):
        return cache.stage("cameras", key, SfmResult, find_cameras)


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
    sigma = _clipped_sigma(error / sfm.ERROR_PER_SIGMA)
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
    held = dataclasses.replace(config.structure, focal_sigma=_HELD_FOCAL_SIGMA)
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


def adjust(
    cameras: SfmResult, sigma: float, config: Config, guess: Intrinsics | None
) -> SfmResult:
    """Adjusts cameras and map, and determines inliers and pixel noise again.

    Args:
        sigma: standard deviation of the observations, px.
        guess: the intrinsics that the focal length's prior is centred on; `None` holds
            all intrinsics constant.
    """
    state = _first_state(cameras)
    free = guess is not None and config.structure.focal_sigma > _HELD_FOCAL_SIGMA
    factors = _factors(cameras, sigma, config, free)
    problem = _problem(factors, state, config.structure, guess)
    # Covariances are of factors in double precision: one program is enough.
    mixed = None if guess is None else False
    solution = solver.solve(problem, state, mixed_precision=mixed)
    before = float(solution.first_cost)
    log.info("bundle adjustment: cost %.4g -> %.4g", before, float(solution.cost))
    state = solution.state
    focal_sigma = float("nan")
    prior_information = cameras.prior_information
    if abs(float(state.intrinsics[0]) / cameras.focal - 1) > _MAX_PRIOR_FOCAL_CHANGE:
        prior_information = np.zeros_like(prior_information)
    if guess is not None:
        covariance = solver.marginals(problem, state).intrinsics
        focal_sigma = float(np.sqrt(config.structure.focal_runs * covariance[0, 0]))
    error = np.linalg.norm(_pixel_errors(cameras.tracks, state), axis=-1)
    keep = cameras.keep
    noise = (
        _clipped_sigma(np.median(error[keep]) / sfm.ERROR_PER_SIGMA)
        if keep.any()
        else 1.0
    )
    return dataclasses.replace(
        cameras,
        T_WC=np.asarray(state.cameras),
        landmarks=np.asarray(state.landmarks),
        intrinsics=np.asarray(state.intrinsics),
        focal_sigma=focal_sigma,
        keep=keep & (error < _MAX_RESIDUAL_SIGMAS * noise),
        prior_information=prior_information,
        pixel_sigma=noise,
        costs=(before, float(solution.cost)),
    )


def self_calibrated(
    cameras: SfmResult, config: Config
) -> Float[np.ndarray, "3 2"] | None:
    """Estimates fx, cx and cy from the tracks alone, each with its standard deviation,
    px.

    They are variables near the intrinsics of `cameras`, with a wide prior whose
    information is subtracted from the result. Returns `None` if there are no tracks or
    they do not determine the intrinsics.
    """
    if not cameras.keep.any():
        return None
    state, sigma = _first_state(cameras), cameras.pixel_sigma
    intrinsics = np.asarray(cameras.intrinsics, float)
    focal, runs = float(intrinsics[0]), config.structure.focal_runs
    prior = np.full(len(intrinsics), _HELD_FOCAL_SIGMA * focal)
    prior[:2] = _FOCAL_PRIOR_SIGMA * focal / np.sqrt(runs)
    prior[2:4] = _CENTRE_PRIOR_SIGMA * focal / np.sqrt(runs)
    problem = _with_free_intrinsics(
        _factors(cameras, sigma, config, free=True), state, intrinsics, prior
    )
    solution = solver.solve(problem, state)
    at = [0, 2, 3]
    covariance = runs * np.asarray(solver.marginals(problem, solution.state).intrinsics)
    information = np.linalg.inv(covariance[np.ix_(at, at)])
    moved = np.asarray(solution.state.intrinsics)[at] - intrinsics[at]
    moment = information @ moved
    # fy is tied to fx, so that its prior is a second one on fx.
    information -= np.diag(np.array([2.0, 1.0, 1.0]) * prior[at] ** -2.0) / runs
    strength = np.linalg.eigvalsh(information)
    if not np.isfinite(moment).all() or strength[0] <= 1e-6 * strength[-1]:
        return None
    own = np.linalg.inv(information)
    return np.stack([intrinsics[at] + own @ moment, np.sqrt(np.diag(own))], axis=1)


def _first_state(cameras: SfmResult) -> graph.State:
    """Returns the state of cameras and landmarks, without people."""
    nobody = initialisation.no_people(len(cameras.T_WC))
    return initialisation.first_state(
        cameras.T_WC, cameras.landmarks, nobody, cameras.intrinsics
    )


def _factors(
    cameras: SfmResult, sigma: float, config: Config, free: bool
) -> list[graph.Factor]:
    """Returns the factors of cameras and map; `free` is True if intrinsics are
    variables."""
    # The noise set for the joint graph is not that of the observations.
    weights = dataclasses.replace(config.weights, pixel_sigma=None)
    factor = initialisation.map_factor(cameras.tracks, cameras.keep, sigma, weights)
    prior = initialisation.revisit_factor(
        cameras.prior_mean, cameras.prior_information, sigma
    )
    if free:
        # Prior means were triangulated with the focal length that is now a variable.
        prior = dataclasses.replace(prior, whitening=0 * prior.whitening)
    path = initialisation.path_factors(cameras.path, cameras.path_known)
    return [factor, prior, *path]


def _clipped_sigma(sigma: float) -> float:
    """Clips a measured noise, px, to the range that the graph allows."""
    low, high = initialisation.PIXEL_SIGMA_RANGE
    return float(np.clip(sigma, low, high))


def _pixel_errors(tracks: Tracks, state: graph.State) -> Float[np.ndarray, "m 2"]:
    """Returns the reprojection errors of the landmarks, predicted minus observed,
    px."""
    T_WC = np.asarray(state.cameras)[tracks.frame]
    offset = np.asarray(state.landmarks)[tracks.landmark] - T_WC[:, :3, 3]
    p_C = np.einsum("mji,mj->mi", T_WC[:, :3, :3], offset)
    return project_rows(state.intrinsics, p_C) - tracks.uv


def _problem(
    factors: list[graph.Factor],
    state: graph.State,
    structure: Structure,
    guess: Intrinsics | None,
) -> graph.Problem:
    """Returns the problem, with the focal length as a variable if a guess is given."""
    if guess is None:
        return graph.make_problem(factors, state, common_sizes=True)
    params = np.asarray(guess.params, float)
    focal = params[0]
    # Errors of a track are temporally correlated, so that `focal_runs` observations
    # count as one. Multiplying the prior's information by that number has the same
    # effect on the focal length as dividing that of the observations.
    sigma = np.full(len(params), _HELD_FOCAL_SIGMA * focal)
    error = guess.focal_sigma or structure.focal_sigma * focal
    sigma[:2] = min(error, structure.focal_sigma * focal) / np.sqrt(
        structure.focal_runs
    )
    return _with_free_intrinsics(factors, state, params, sigma)


def _with_free_intrinsics(
    factors: list[graph.Factor],
    state: graph.State,
    params: Float[np.ndarray, " i"],
    sigma: Float[np.ndarray, " i"],
) -> graph.Problem:
    """Returns the problem with intrinsics as variables near `params`, px, and with
    their aspect ratio held."""
    focal = float(params[0])
    factors = [
        *factors,
        graph.IntrinsicsPrior(jnp.asarray(params)[None], jnp.asarray(sigma)[None]),
        graph.AspectRatioPrior(
            jnp.asarray([_ASPECT_SIGMA * focal]), ratio=float(focal / params[1])
        ),
    ]
    return graph.make_problem(factors, state, free_intrinsics=True, common_sizes=True)
