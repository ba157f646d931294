"""Tracks -> cameras and map up to scale, and the focal length if it was a guess.

Structure from motion, then bundle adjustment of all frames and landmarks. A guessed
focal length is a variable of that problem, with a wide prior around the guess: parallax
and turns that do not fit together give it away. Distortion is not sought.
"""

import dataclasses
import logging

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from bodyslam_jax import graph, initialisation, sfm, solver
from bodyslam_jax.config import Config, Structure
from bodyslam_jax.types import Intrinsics, Sequence, SfmResult, Tracks

log = logging.getLogger(__name__)

_PER_SIGMA = 1.18
"""The median of a two-dimensional normal error's length, in its sigma."""
_HELD = 1e-6
"""Prior's standard deviation, of the focal length, that holds it."""
_MOVED = 0.02
"""Change of the focal length after which structure from motion is done again."""
_SAME = 0.005
"""Change of the focal length up to which places seen again are where they were."""
_WORSE = 1.5
"""Times the error of a moving camera at which a turning one is no explanation."""
_SQUARE = 1e-4
"""How alike the pixels' sides are, of the focal length."""


def estimate(sequence: Sequence, tracks: Tracks, config: Config) -> SfmResult:
    """Cameras, map and intrinsics of a sequence, up to scale.

    A camera that does not move, or only turns, is said to be that, and keeps the guess.
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
    num_frames = sequence.num_frames
    warnings = tracks.warnings
    tracks, share = sfm.without_burnt_in(tracks, sequence.intrinsics, num_frames)
    if share > 0 and sequence.tracks is not None:
        warnings = (*warnings, sfm.burnt_in_warning(share))
    if config.static_camera or sequence.camera_path is not None:
        found = _reconstruct(sequence, tracks, sequence.intrinsics, config)
        model = sfm.CameraModel(sequence.intrinsics, None, tracks, found, ())
    else:
        model = sfm.find_camera_model(
            tracks, sequence.intrinsics, num_frames, config.structure
        )
    sequence = dataclasses.replace(sequence, intrinsics=model.intrinsics)
    cameras = _of_model(sequence, model, config)
    warnings = (*warnings, *model.warnings, *cameras.warnings)
    moved = sfm.second_motion_warning(model.tracks, model.found, model.intrinsics)
    if moved is not None:
        warnings = (*warnings, moved)
    return dataclasses.replace(cameras, warnings=warnings, zoom=model.zoom)


def _of_model(sequence: Sequence, model: sfm.CameraModel, config: Config) -> SfmResult:
    """Cameras of a sequence whose intrinsics are the model's, adjusted."""
    guess, found = sequence.intrinsics, model.found
    cameras = _unadjusted(sequence, found, guess, config)
    if found.kind != "moving":
        return cameras
    if guess.is_refined:
        cameras = _with_focal(sequence, model.tracks, cameras, found.error, config)
    else:
        cameras = _adjusted(cameras, 1.0, config, None)
    if cameras.kind != "moving":
        return cameras
    # Only now: whole tracks tell more of the path and the focal length.
    return _cut(cameras, config.structure.landmark_span)


def _with_focal(
    sequence: Sequence, tracks: Tracks, cameras: SfmResult, error: float, config: Config
) -> SfmResult:
    """The focal length as the camera's path tells it, where it does."""
    guess = sequence.intrinsics
    sigma = _clipped(error / _PER_SIGMA)
    for _ in range(3):
        adjusted = _adjusted(cameras, sigma, config, guess)
        if adjusted.focal_sigma > config.structure.focal_accuracy * adjusted.focal:
            return _with_guess(sequence, tracks, adjusted, config)
        if abs(adjusted.focal / cameras.focal - 1) < _MOVED:
            break
        better = dataclasses.replace(guess, params=adjusted.intrinsics)
        again = _reconstruct(sequence, tracks, better, config)
        cameras, sigma = (
            _unadjusted(sequence, again, better, config),
            adjusted.pixel_sigma,
        )
        if again.kind != "moving":
            if again.error > _WORSE * _PER_SIGMA * sigma:
                return adjusted  # little as it moves, turning alone does not explain it
            # With its focal length wrong, a camera that turns had seemed to move.
            return dataclasses.replace(cameras, focal_sigma=adjusted.focal_sigma)
    return adjusted


def _cut(cameras: SfmResult, span: int) -> SfmResult:
    """Long tracks in pieces, which know of each other by what is known of the map."""
    tracks = cameras.tracks
    of, piece = sfm.split_tracks(tracks.frame, tracks.landmark, span)
    kept = cameras.keep
    told = sfm.information_from_other_pieces(
        cameras.T_WC, cameras.landmarks, tracks.frame[kept], piece[kept], of
    )
    count = np.bincount(of)[of]
    known = cameras.prior_information[of] / count[:, None, None]
    prior_mean = cameras.landmarks[of]
    return dataclasses.replace(
        cameras,
        landmarks=prior_mean,
        tracks=Tracks(tracks.frame, piece, tracks.uv),
        prior_mean=prior_mean,
        prior_information=known + cameras.focal**2 * told,
    )


def with_intrinsics(
    sequence: Sequence,
    intrinsics: Float[np.ndarray, " i"],
    zoom: Float[np.ndarray, " t"] | None = None,
) -> Sequence:
    """The sequence as another focal length has it.

    Regressed bodies stay where they are in the image, and as large: their depth was
    read off their size, and is proportional to the focal length.

    Args:
        zoom: logarithm of each frame's focal length, over that of `intrinsics`:
            keypoints and bodies are those of the images with the zoom undone.
    """
    if zoom is not None:
        sequence = _without_zoom(sequence, zoom)
    known = sequence.intrinsics
    if np.array_equal(known.params, intrinsics):
        return sequence
    bodies = sequence.bodies
    if bodies is not None:
        # The camera may have got distortion, or pixels that are not square.
        focal = np.sqrt(intrinsics[0] * intrinsics[1])
        focal /= np.sqrt(known.params[0] * known.params[1])
        ratio = np.array([1.0, 1.0, focal])
        bodies = dataclasses.replace(bodies, trans=bodies.trans * ratio)
    return dataclasses.replace(
        sequence,
        intrinsics=dataclasses.replace(known, params=intrinsics),
        bodies=bodies,
    )


def _without_zoom(sequence: Sequence, zoom: Float[np.ndarray, " t"]) -> Sequence:
    size = np.exp(zoom)
    keypoints, bodies = sequence.keypoints, sequence.bodies
    if keypoints is not None:
        centre = np.asarray(sequence.intrinsics.params[2:4], float)
        uv = centre + (keypoints.uv - centre) / size[:, None, None]
        uv = np.where(keypoints.confidence[..., None] > 0, uv, keypoints.uv)
        keypoints = dataclasses.replace(keypoints, uv=uv)
    if bodies is not None:
        # As far from the axis, and as much farther as the image is larger.
        trans = bodies.trans * np.stack([size * 0 + 1, size * 0 + 1, size], axis=-1)
        bodies = dataclasses.replace(bodies, trans=trans)
    return dataclasses.replace(sequence, keypoints=keypoints, bodies=bodies)


def _reconstruct(
    sequence: Sequence, tracks: Tracks, intrinsics: Intrinsics, config: Config
) -> sfm.Reconstruction:
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
    """The guess as it was, for a camera whose path does not tell the focal length."""
    guess = sequence.intrinsics
    found = _reconstruct(sequence, tracks, guess, config)
    held = dataclasses.replace(config.structure, focal_sigma=_HELD)
    cameras = _adjusted(
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


def _adjusted(
    cameras: SfmResult, sigma: float, config: Config, guess: Intrinsics | None
) -> SfmResult:
    """Bundle adjustment; with a `guess` the focal length is free."""
    nobody = initialisation.no_people(len(cameras.T_WC))
    state = initialisation.first_state(
        cameras.T_WC, cameras.landmarks, nobody, cameras.intrinsics
    )
    # What the joint graph is to take for the noise does not change what it is.
    weights = dataclasses.replace(config.weights, pixel_sigma=None)
    factor = initialisation.map_factor(cameras.tracks, cameras.keep, sigma, weights)
    again = initialisation.revisit_factor(
        cameras.prior_mean, cameras.prior_information, sigma
    )
    if guess is not None and config.structure.focal_sigma > _HELD:
        # Places are those of the focal length that was thought so far.
        again = dataclasses.replace(again, whitening=0 * again.whitening)
    path = initialisation.path_factors(cameras.path, cameras.path_known)
    problem = _problem([factor, again, *path], state, config.structure, guess)
    solution = solver.solve(problem, state)
    before = float(solution.first_cost)
    log.info("bundle adjustment: cost %.4g -> %.4g", before, float(solution.cost))
    state = solution.state
    focal_sigma = float("nan")
    prior_information = cameras.prior_information
    if abs(float(state.intrinsics[0]) / cameras.focal - 1) > _SAME:
        prior_information = np.zeros_like(prior_information)
    if guess is not None:
        spread = solver.marginals(problem, state).intrinsics
        focal_sigma = float(np.sqrt(config.structure.focal_runs * spread[0, 0]))
    error = sigma * np.linalg.norm(np.asarray(_residual(factor, state)), axis=-1)
    keep = cameras.keep
    found = _clipped(np.median(error[keep]) / _PER_SIGMA) if keep.any() else 1.0
    return dataclasses.replace(
        cameras,
        T_WC=np.asarray(state.cameras),
        landmarks=np.asarray(state.landmarks),
        intrinsics=np.asarray(state.intrinsics),
        focal_sigma=focal_sigma,
        keep=keep & (error < 10 * found),
        prior_information=prior_information,
        pixel_sigma=found,
        costs=(before, float(solution.cost)),
    )


_residual = eqx.filter_jit(lambda factor, state: factor.residual(state))


def _problem(
    factors: list[graph.Factor],
    state: graph.State,
    structure: Structure,
    guess: Intrinsics | None,
) -> graph.Problem:
    if guess is None:
        return graph.make_problem(factors, state)
    known = np.asarray(guess.params, float)
    focal = known[0]
    # Errors of a track last, so `focal_runs` observations count for one: here the
    # prior's weight is multiplied, which is the same as dividing theirs.
    sigma = np.full(len(known), _HELD * focal)
    error = guess.focal_sigma or structure.focal_sigma * focal
    sigma[:2] = min(error, structure.focal_sigma * focal) / np.sqrt(
        structure.focal_runs
    )
    factors = [
        *factors,
        graph.IntrinsicsPrior(jnp.asarray(known)[None], jnp.asarray(sigma)[None]),
        graph.AspectRatioPrior(
            jnp.asarray([_SQUARE * focal]), ratio=float(focal / known[1])
        ),
    ]
    return graph.make_problem(factors, state, free_intrinsics=True)


def _clipped(sigma: float) -> float:
    low, high = initialisation.PIXEL_SIGMA_RANGE
    return float(np.clip(sigma, low, high))
