"""Intrinsics from the tracks: pixel aspect ratio, radial distortion and zoom.

An ordinary camera has square pixels, little distortion and one focal length. A
deviating camera model is used only if its posterior odds are high: prior odds, times
the likelihood ratio by held-out tracks (`sfm.lens`). Then the map must be no worse with
it, and people no less plausible (`sfm.upright_people`).
"""

import dataclasses
import logging

import numpy as np
from jaxtyping import Float

from bodyslam_jax.config import Structure
from bodyslam_jax.io.camera.calibration import as_opencv, rays
from bodyslam_jax.sfm.bundle import ERROR_PER_SIGMA, Scene, Views, errors
from bodyslam_jax.sfm.burnt_in import noise_of
from bodyslam_jax.sfm.lens import (
    MIN_SIGMA_PX,
    OTHER_FOCAL_MODEL,
    Lens,
    LensPrior,
    examine_lens,
)
from bodyslam_jax.sfm.sfm import MAX_ROTATION_ERROR_PX, Reconstruction, reconstruct
from bodyslam_jax.sfm.upright_people import plausibility
from bodyslam_jax.sfm.zoom import MIN_LOG_ZOOM, tracks_without_zoom, turning_zoom
from bodyslam_jax.types import Intrinsics, Keypoints, Tracks

_log = logging.getLogger(__name__)

DECISIVE_LOG_ODDS = np.log(100.0)
"""Logarithm of the posterior odds above which a deviation is used: with prior odds ten
times smaller it would still be ten times as probable as an ordinary camera."""
_PRIOR_ODDS = {"aspect": 1e-3, "radial": 1 / 20, "zoom": 1 / 50}
"""Prior odds, among all videos, of pixels that are not square although the container
does not say so, of distortion beyond |k1| 0.05, and of a zoom."""
_CALIBRATED_PRIOR_ODDS = {"focal": 1e-3, "aspect": 1e-3, "radial": 1e-3, "zoom": 1 / 50}
"""Prior odds for a video with a calibration: one in a thousand is of another lens. A
different focal length is never used, as the calibration is held, but reported by
`diagnostics.facts`."""
_ASPECT_SIGMAS = (0.003, 0.25)
"""Standard deviations of log(fx / fy) of an ordinary camera and of a deviating one:
sensors have square pixels to some parts in a thousand, as calibrations show; a
stretched video has one of the ratios of video standards (ITU-R BT.601 and 709: 0.91,
1.09, 1.21, 1.33, 1.46), whose spread this is."""
_RADIAL_SIGMAS, _CALIBRATED_RADIAL_SIGMAS = (0.02, 0.2), (0.01, 0.2)
"""Standard deviations of k1, likewise: an ordinary lens has at most 0.05 (2.5 standard
deviations), one with a calibration is corrected to some parts in a hundred; action
cameras and wide angles of phones have 0.1 to 0.35."""
_ZOOM_SIGMAS = (0.01, 0.4)
"""Standard deviations of the logarithm of the focal length over time, likewise: focus
breathing changes it by a hundredth or two, a zoom by a factor of 1.1 to 2."""
_CALIBRATED_FOCAL_SIGMA = 0.01
"""Standard deviation of the logarithm of a calibrated focal length."""
_READOUT_SIGMA_FRAMES = 0.3
"""Standard deviation of the delay of a rolling shutter's last row, in frames: phones
read an image in 5 to 20 ms, a frame lasts 17 to 40 ms; it may also be none."""
_OTHER_FOCAL_FACTORS = (0.63, 0.8, 1.25)
"""Factors on a guessed focal length with which the ordinary camera is tried again: they
cover two standard deviations of the guess downwards, where wide lenses are, and one
upwards."""
_UNEXPLAINED_COST = 9.21
"""Cost of an unexplained observation: the squared error, in variances, that is exceeded
by 1 % of observations (chi-square of two degrees of freedom)."""
_MIN_PLAUSIBILITY_CHANGE = -1.0
"""Logarithm of the likelihood ratio of people below which a camera model makes them
less plausible."""


@dataclasses.dataclass(frozen=True)
class CameraModel:
    """The camera model estimated from the tracks, and the reconstruction with it."""

    intrinsics: Intrinsics
    zoom: Float[np.ndarray, " t"] | None
    """Logarithm of the ratio of each frame's focal length to that of `intrinsics`; None
    without a zoom."""
    tracks: Tracks
    """The tracks with the zoom undone."""
    found: Reconstruction
    warnings: tuple[str, ...]
    alternatives: tuple[Lens, ...] = ()
    """The ordinary camera and others that were compared, with their evidence."""


def find_camera_model(
    tracks: Tracks,
    intrinsics: Intrinsics,
    num_frames: int,
    config: Structure,
    people: Keypoints | None = None,
) -> CameraModel:
    """Reconstructs the scene, with the given camera corrected where
    the tracks contradict it.

    Pixel aspect ratio, one radial coefficient and a zoom are estimated if the camera
    translates; only a zoom if it rotates.

    Args:
        people: keypoints of the people in the images.
    """
    given, zoom = intrinsics, np.zeros(num_frames)
    warnings: list[str] = []
    turning = _turning_zoom(tracks, intrinsics, num_frames)
    if turning is not None:
        zoom = turning - np.median(turning)
    centre = np.asarray(intrinsics.params[2:4], float)
    plain = tracks_without_zoom(tracks, zoom, centre) if zoom.any() else tracks
    found = reconstruct(plain, intrinsics, num_frames, config)
    if zoom.any() and found.kind == "moving":
        # `turning_zoom` assumes a camera that does not translate, but forward motion
        # scales images, too: without a zoom the tracks must fit worse.
        unzoomed = reconstruct(tracks, intrinsics, num_frames, config)
        if _no_worse(unzoomed, found):
            zoom, plain, found = np.zeros(num_frames), tracks, unzoomed
    prior = prior_of(intrinsics, config)
    lenses = _examine(plain, intrinsics, found, prior)
    lens = _most_probable(lenses)
    if lens is not None and lens.log_odds > 0 and intrinsics.is_guess:
        # An ordinary camera of another focal length may explain the tracks.
        better = _other_focal(plain, intrinsics, found, config)
        if better is not None:
            intrinsics, found = better
            lenses = _examine(plain, intrinsics, found, prior)
            lens = _most_probable(lenses)
    why = "too rare"
    decisive = [
        other
        for other in lenses[1:]
        if other.model != OTHER_FOCAL_MODEL and is_decisive(other, lenses)
    ]
    before = plausibility(found, intrinsics, people, zoom) if decisive else 0.0
    for other in sorted(decisive, key=lambda other: -other.log_odds):
        trial, camera = _with_lens(other, intrinsics, zoom)
        again_plain = tracks_without_zoom(tracks, trial, centre)
        again = reconstruct(again_plain, camera, num_frames, config)
        if not _no_worse(again, found):
            why = "makes no better map"
        elif (
            plausibility(again, camera, people, trial)
            < before + _MIN_PLAUSIBILITY_CHANGE
        ):
            why = "makes people lean or change in size"
        else:
            zoom, plain, found, intrinsics = trial, again_plain, again, camera
            why = ""
            break
    deviates = lens is not None and lens.model != OTHER_FOCAL_MODEL
    if lens is not None and deviates and lens.log_odds > 0 and why:
        warnings.append(_doubt(lens, intrinsics, why))
    zooms = np.ptp(zoom) >= MIN_LOG_ZOOM
    if zooms:
        warnings.insert(0, zoom_warning(zoom))
    elif zoom.any():
        zoom = np.zeros(num_frames)
        plain = tracks
        found = reconstruct(plain, intrinsics, num_frames, config)
    warnings += _changes(given, intrinsics)
    return CameraModel(
        intrinsics, zoom if zooms else None, plain, found, tuple(warnings), lenses
    )


def prior_of(given: Intrinsics, config: Structure) -> LensPrior:
    """Returns the prior on the lens of a camera.

    A guess, a focal length given by the user and a calibration differ in their standard
    deviations. If a calibration is of another camera, its focal length is a guess.
    """
    focal = config.focal_sigma
    if given.focal_sigma is not None:
        focal = min(given.focal_sigma / float(given.params[0]), focal)
    calibrated = not given.is_refined
    odds = _CALIBRATED_PRIOR_ODDS if calibrated else _PRIOR_ODDS
    return LensPrior(
        focal=(_CALIBRATED_FOCAL_SIGMA if calibrated else focal, focal),
        aspect=_ASPECT_SIGMAS,
        radial=_CALIBRATED_RADIAL_SIGMAS if calibrated else _RADIAL_SIGMAS,
        zoom=_ZOOM_SIGMAS,
        readout=_READOUT_SIGMA_FRAMES,
        runs=config.focal_runs,
        odds=tuple(odds.items()),
    )


def is_decisive(lens: Lens, lenses: tuple[Lens, ...]) -> bool:
    """Returns True if a model has decisive odds over all simpler `lenses` it contains.

    Any deviation frees a calibrated focal length, and contains `OTHER_FOCAL_MODEL`.
    """
    contained = {*lens.model, *OTHER_FOCAL_MODEL}
    simpler = [o for o in lenses if o is not lens and set(o.model) <= contained]
    return all(lens.log_odds - other.log_odds > DECISIVE_LOG_ODDS for other in simpler)


def _most_probable(lenses: tuple[Lens, ...]) -> Lens | None:
    """Returns the most probable deviation from the ordinary camera, if there is any."""
    for lens in lenses:
        _log.debug("lens: %s", lens)
    return max(lenses[1:], key=lambda lens: lens.log_odds, default=None)


def _other_focal(
    tracks: Tracks, guess: Intrinsics, found: Reconstruction, config: Structure
) -> tuple[Intrinsics, Reconstruction] | None:
    """Returns a better map by an ordinary camera of another focal length, or `None`.

    Its posterior odds over the guess must be decisive: where depth and focal length
    trade off, as before a wall, maps of all focal lengths differ by noise alone.
    """
    focal_sigma = prior_of(guess, config).focal[0]
    best, least = None, DECISIVE_LOG_ODDS
    for factor in _OTHER_FOCAL_FACTORS:
        params = np.asarray(guess.params, float).copy()
        params[:2] *= factor
        camera = dataclasses.replace(guess, params=params)
        again = reconstruct(tracks, camera, len(found.registered), config)
        if not _locates_as_many(again, found):
            continue
        sigma = max(again.error / ERROR_PER_SIGMA, MIN_SIGMA_PX)
        gain = _misfit(tracks, guess, found, sigma)
        gain -= _misfit(tracks, camera, again, sigma)
        # Errors of a track are correlated: `focal_runs` observations count as one.
        odds = gain / config.focal_runs / 2 - (np.log(factor) / focal_sigma) ** 2 / 2
        if odds > least:
            best, least = (camera, again), odds
    return best


def _misfit(
    tracks: Tracks, camera: Intrinsics, found: Reconstruction, sigma: float
) -> float:
    """Returns twice the negative log-likelihood of all tracks given a reconstruction
    and a noise of `sigma` px; an unexplained observation costs `_UNEXPLAINED_COST`."""
    scene, views = _scene(tracks, camera, found)
    error = errors(scene, views) * float(np.sqrt(np.prod(camera.params[:2])))
    cost = np.minimum((error / sigma) ** 2, _UNEXPLAINED_COST)
    return float(cost.sum() + _UNEXPLAINED_COST * (len(tracks.frame) - len(error)))


def _with_lens(
    lens: Lens, intrinsics: Intrinsics, zoom: Float[np.ndarray, " t"]
) -> tuple[Float[np.ndarray, " t"], Intrinsics]:
    """Returns the zoom and the intrinsics with the deviations that a model allows."""
    params = np.asarray(intrinsics.params, float).copy()
    aspect, focal = 0.0, lens.focal
    if "zoom" in lens.model:
        focal += float(np.median(lens.zoom))
        zoom = zoom + lens.zoom - np.median(lens.zoom)
    if "aspect" in lens.model:
        aspect = lens.aspect
    params[:2] *= np.exp(focal + np.array([0.5, -0.5]) * aspect)
    if "radial" in lens.model:
        params = np.concatenate([params, np.zeros(8 - len(params))])
        params[4] += lens.radial
    return zoom, dataclasses.replace(intrinsics, params=params)


def zoom_warning(zoom: Float[np.ndarray, " t"]) -> str:
    low, high = int(np.argmin(zoom)), int(np.argmax(zoom))
    ratio = np.exp(zoom[high] - zoom[low])
    return (
        f"the camera zooms: the focal length of frame {high} is {ratio:.2f} times that "
        f"of frame {low}, as the tracks have it; undone in points and keypoints, and "
        "intrinsics are those of the images with the zoom undone."
    )


def _turning_zoom(
    tracks: Tracks, intrinsics: Intrinsics, num_frames: int
) -> np.ndarray | None:
    if not len(tracks.frame):
        return None
    K, distortion = as_opencv(intrinsics.params)
    views = Views(tracks.frame, tracks.landmark, rays(tracks.uv, K, distortion))
    # The variances of both views' errors add up.
    limit = max(
        MAX_ROTATION_ERROR_PX, 2.0 * ERROR_PER_SIGMA * np.sqrt(2) * noise_of(tracks)
    )
    return turning_zoom(views, num_frames, limit / K[0, 0])


def _examine(
    tracks: Tracks, intrinsics: Intrinsics, found: Reconstruction, prior: LensPrior
) -> tuple[Lens, ...]:
    """Returns the ordinary camera and its alternatives; none unless the camera
    translates."""
    if found.kind != "moving":
        return ()
    K, _ = as_opencv(intrinsics.params)
    # Outliers are included: under a wrong lens model they carry the information.
    scene, views = _scene(tracks, intrinsics, found)
    return examine_lens(
        scene,
        views,
        found.registered,
        pixel=1 / K[0, 0],
        rows=intrinsics.height / K[1, 1],
        prior=prior,
    )


def _scene(
    tracks: Tracks, intrinsics: Intrinsics, found: Reconstruction
) -> tuple[Scene, Views]:
    """Returns the cameras and points of a reconstruction, and all observations of these
    points in registered frames."""
    K, distortion = as_opencv(intrinsics.params)
    of = np.full(int(tracks.landmark.max()) + 1, -1)
    of[found.landmark_ids] = np.arange(len(found.landmark_ids))
    use = (of[tracks.landmark] >= 0) & found.registered[tracks.frame]
    xy = rays(tracks.uv[use], K, distortion)
    views = Views(tracks.frame[use], of[tracks.landmark[use]], xy)
    R_CW = np.swapaxes(found.T_WC[:, :3, :3], 1, 2)
    return Scene(R_CW, found.T_WC[:, :3, 3], found.landmarks), views


def _locates_as_many(again: Reconstruction, found: Reconstruction) -> bool:
    """Returns True if both are of one kind, and `again` registers as many frames."""
    return bool(
        again.kind == found.kind and again.registered.sum() >= found.registered.sum()
    )


def _no_worse(again: Reconstruction, found: Reconstruction) -> bool:
    """Returns True if reconstruction `again` is not worse than `found`.

    It must be of the same kind, register as many frames, and have about as many inlier
    observations and as small a reprojection error.
    """
    explained = lambda r: np.count_nonzero(r.inlier)
    return bool(
        _locates_as_many(again, found)
        and explained(again) >= 0.97 * explained(found)
        and again.error <= 1.05 * found.error + 0.02
    )


def _doubt(lens: Lens, intrinsics: Intrinsics, why: str) -> str:
    """Returns the warning about a probable camera model that is not used."""
    said = []
    if "aspect" in lens.model:
        ratio = intrinsics.params[0] / intrinsics.params[1]
        shown = ratio * np.exp(lens.aspect)
        sigma = shown * lens.aspect_sigma
        said.append(f"fx/fy = {shown:.2f} ± {sigma:.2f}, not {ratio:.2f}")
    if "radial" in lens.model:
        said.append(
            f"a distorted lens, k1 {lens.radial:+.2f} ± {lens.radial_sigma:.2f}"
        )
    if "zoom" in lens.model:
        said.append(
            f"a zoom by {np.exp(lens.zoom_range):.2f} (logarithm "
            f"{lens.zoom_range:.2f} ± {lens.zoom_sigma:.2f})"
        )
    odds = np.exp(min(lens.log_odds, np.log(1e6)))
    return (
        f"the tracks indicate {' and '.join(said)} (odds {odds:.0f} to 1): {why}, not "
        "used; give camera.json of the video as it is."
    )


def _changes(given: Intrinsics, used: Intrinsics) -> list[str]:
    if given is used:
        return []
    source = "the guess" if given.is_guess else "camera.json"
    text = []
    before, after = (c.params[0] / c.params[1] for c in (given, used))
    if abs(np.log(after / before)) > 1e-3:
        text.append(
            f"the tracks indicate fx/fy = {after:.3f} where {source} has {before:.3f} "
            "(pixels that are not square: a stretched video): used."
        )
    k1 = used.params[4] if len(used.params) > 4 else 0.0
    assumed = given.params[4] if len(given.params) > 4 else 0.0
    if abs(k1 - assumed) > 1e-6:
        text.append(
            f"the tracks indicate a distorted lens, k1 = {k1:.3f} where {source} "
            f"has {assumed:.3f}: used."
        )
    return text
