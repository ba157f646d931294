"""Intrinsics from the tracks: pixel aspect ratio, radial distortion and zoom.

Reconstruction and self-calibration alternate. A deviation from the assumed camera is
applied where it is significant, and reported otherwise; values of camera.json are
overruled only where the tracks contradict them by many standard deviations and the
reprojection error falls clearly without them.
"""

import dataclasses
import logging

import numpy as np
from jaxtyping import Float

from bodyslam_jax.config import Structure
from bodyslam_jax.io.camera.calibration import as_opencv, rays
from bodyslam_jax.sfm.bundle import Scene, Views
from bodyslam_jax.sfm.burnt_in import noise_of
from bodyslam_jax.sfm.lens import Lens, examine_lens
from bodyslam_jax.sfm.sfm import TURNING_ERROR, Reconstruction, reconstruct
from bodyslam_jax.sfm.zoom import LEAST_ZOOM, tracks_without_zoom, turning_zoom
from bodyslam_jax.types import Intrinsics, Tracks

_log = logging.getLogger(__name__)

_ROUNDS = 2
_SIGMAS = 5.0
"""A deviation from an assumed camera is applied above this many standard deviations."""
_GIVEN_SIGMAS, _GIVEN_GAIN = 10.0, 0.1
"""The same for a camera given in camera.json, and the share by which the reprojection
error must fall as well."""
_ZOOM_SIGMAS = 10.0
"""The same for a zoom of a camera that translates: its errors are correlated over time
with the drift of the map, which a zoom absorbs (6 standard deviations on a walk of 600
frames without a zoom; 24 for a zoom by 1.1 over 60 frames)."""
_LEAST_ASPECT, _MOST_ASPECT_SIGMA = 0.06, 0.045
"""Least |log(fx / fy)| that is not explained by errors of the tracks, and the largest
standard deviation of its estimate with which it is used."""
_LEAST_BEND = 0.008
"""Least shift by radial distortion at the image's corner that is corrected, as a share
of half the diagonal."""


@dataclasses.dataclass(frozen=True)
class CameraModel:
    """The camera model estimated from the tracks, and the reconstruction with it."""

    intrinsics: Intrinsics
    zoom: Float[np.ndarray, " t"] | None
    """Logarithm of the focal length in each frame over that of `intrinsics`; None
    without a zoom."""
    tracks: Tracks
    """The tracks with the zoom undone."""
    found: Reconstruction
    warnings: tuple[str, ...]


def find_camera_model(
    tracks: Tracks, intrinsics: Intrinsics, num_frames: int, config: Structure
) -> CameraModel:
    """Corrects the given camera where the tracks significantly contradict it.

    Pixel aspect ratio, one radial coefficient and a zoom are estimated if the camera
    translates; only a zoom if it rotates.
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
        # A turning zoom supposes a camera that does not translate, and forward motion
        # scales images too: without a zoom the tracks must fit worse.
        unzoomed = reconstruct(tracks, intrinsics, num_frames, config)
        if _no_worse(unzoomed, found):
            zoom, plain, found = np.zeros(num_frames), tracks, unzoomed
    for turn in range(_ROUNDS):
        lens = _examine(plain, intrinsics, found)
        if lens is None:
            break
        _log.debug("lens: %s", lens)
        least = 0.01 if zoom.any() else LEAST_ZOOM
        better, more, doubts = _improved(
            lens, intrinsics, given, least, bool(zoom.any())
        )
        if turn == 0:
            warnings += doubts
        if better is None and more is None:
            break
        trial = zoom if more is None else zoom + more - np.median(more)
        camera = better or intrinsics
        again_plain = tracks_without_zoom(tracks, trial, centre)
        again = reconstruct(again_plain, camera, num_frames, config)
        if not _no_worse(again, found):
            warnings += [_doubt(lens)] if turn == 0 else []
            break
        zoom, plain, found, intrinsics = trial, again_plain, again, camera
    zooms = np.ptp(zoom) >= LEAST_ZOOM
    if zooms:
        warnings.insert(0, zoom_warning(zoom))
    elif zoom.any():
        zoom = np.zeros(num_frames)
        plain = tracks
        found = reconstruct(plain, intrinsics, num_frames, config)
    warnings += _changes(given, intrinsics)
    return CameraModel(
        intrinsics, zoom if zooms else None, plain, found, tuple(warnings)
    )


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
    # Errors of both views, whose length has a median of 1.18 standard deviations.
    limit = max(TURNING_ERROR, 2.0 * 1.18 * np.sqrt(2) * noise_of(tracks))
    return turning_zoom(views, num_frames, limit / K[0, 0])


def _examine(
    tracks: Tracks, intrinsics: Intrinsics, found: Reconstruction
) -> Lens | None:
    if found.kind != "moving":
        return None
    K, distortion = as_opencv(intrinsics.params)
    num = int(tracks.landmark.max()) + 1
    of = np.full(num, -1)
    of[found.landmark_ids] = np.arange(len(found.landmark_ids))
    # Outliers too: under a wrong lens model they carry the information.
    use = (of[tracks.landmark] >= 0) & found.registered[tracks.frame]
    xy = rays(tracks.uv[use], K, distortion)
    views = Views(tracks.frame[use], of[tracks.landmark[use]], xy)
    R_CW = np.swapaxes(found.T_WC[:, :3, :3], 1, 2)
    scene = Scene(R_CW, found.T_WC[:, :3, 3], found.landmarks)
    return examine_lens(scene, views, found.registered, pixel=1 / K[0, 0])


def _improved(
    lens: Lens,
    intrinsics: Intrinsics,
    given: Intrinsics,
    least_zoom: float,
    zooms_already: bool,
) -> tuple[Intrinsics | None, np.ndarray | None, list[str]]:
    """The corrected camera and the zoom to add, where significant (else `None`); and
    messages on deviations that are not applied."""
    params = np.asarray(intrinsics.params, float).copy()
    K = as_opencv(params)[0]
    corner = np.hypot(intrinsics.width / K[0, 0], intrinsics.height / K[1, 1]) / 2
    sigmas = _SIGMAS if given.is_guess else _GIVEN_SIGMAS
    may = given.is_guess or lens.gain > _GIVEN_GAIN
    doubts: list[str] = []
    changed = False
    ratio, zooms = params[0] / params[1], None
    needed = _SIGMAS if zooms_already else _ZOOM_SIGMAS
    if lens.zoom_range > max(least_zoom, needed * lens.zoom_sigma):
        zooms = lens.zoom
    elif lens.zoom_range > max(least_zoom, _SIGMAS * lens.zoom_sigma):
        doubts.append(
            f"the tracks indicate a zoom by {np.exp(lens.zoom_range):.2f} (logarithm "
            f"{lens.zoom_range:.2f} ± {lens.zoom_sigma:.2f}), which drift of the map "
            "explains as well: not used."
        )
    if abs(lens.aspect) > max(_LEAST_ASPECT, _SIGMAS * lens.aspect_sigma):
        sure = abs(lens.aspect) > sigmas * lens.aspect_sigma and may
        if sure and lens.aspect_sigma < _MOST_ASPECT_SIGMA:
            focal = lens.focal
            params[:2] *= np.exp(focal + np.array([0.5, -0.5]) * lens.aspect)
            changed = True
        else:
            shown = ratio * np.exp(lens.aspect)
            doubts.append(
                f"the tracks indicate that fx/fy is {shown:.2f} ± "
                f"{shown * lens.aspect_sigma:.2f}, not {ratio:.2f}: is the video "
                "stretched? Not used; give camera.json of the video as it is."
            )
    bend = abs(lens.radial) * corner**2
    if bend > _LEAST_BEND and abs(lens.radial) > _SIGMAS * lens.radial_sigma:
        if abs(lens.radial) > sigmas * lens.radial_sigma and may:
            params = np.concatenate([params, np.zeros(8 - len(params))])
            params[4] += lens.radial
            changed = True
        else:
            doubts.append(
                f"the tracks indicate a distorted lens, k1 = {lens.radial:.3f} ± "
                f"{lens.radial_sigma:.3f} ({100 * bend:.0f} % at the corners) beyond "
                "what is known of it: not used; give camera.json."
            )
    better = dataclasses.replace(intrinsics, params=params) if changed else None
    return better, zooms, doubts


def _no_worse(again: Reconstruction, found: Reconstruction) -> bool:
    """Whether reconstruction `again` is not worse than `found`.

    It must be of the same kind, register as many frames, and have about as many inlier
    observations and as small a reprojection error.
    """
    explained = lambda r: np.count_nonzero(r.inlier)
    return bool(
        again.kind == found.kind
        and again.registered.sum() >= found.registered.sum()
        and explained(again) >= 0.97 * explained(found)
        and again.error <= 1.05 * found.error + 0.02
    )


def _doubt(lens: Lens) -> str:
    return (
        "the tracks do not fit one camera as it is known: a zoom by "
        f"{np.exp(lens.zoom_range):.2f}, fx/fy times {np.exp(lens.aspect):.2f} and k1 "
        f"{lens.radial:+.2f} lower their error by {100 * lens.gain:.0f} %, but make no "
        "better map: not used."
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
    k1 = used.params[4] if len(used.params) == 8 else 0.0
    assumed = given.params[4] if len(given.params) == 8 else 0.0
    if abs(k1 - assumed) > 1e-6:
        text.append(
            f"the tracks indicate a distorted lens, k1 = {k1:.3f} where {source} "
            f"has {assumed:.3f}: used."
        )
    return text
