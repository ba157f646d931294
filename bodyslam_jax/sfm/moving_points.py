"""Detects a second rigid motion among the outliers: traffic, a crowd, reflections.

The reconstruction rejects such points as outliers. If they are many, it may have taken
them for the scene, and the camera path may be relative to them; so a warning is given.
"""

import numpy as np

from bodyslam_jax.geometry.triangulation import unit_rays
from bodyslam_jax.io.camera.calibration import as_opencv, rays
from bodyslam_jax.sfm.burnt_in import noise_of
from bodyslam_jax.sfm.multiview import essential, sampson
from bodyslam_jax.sfm.sfm import Reconstruction
from bodyslam_jax.types import Intrinsics, Tracks

_GAP_FRAMES = 8
"""Number of frames between the two of a pair."""
_MAX_PAIRS = 60
"""Largest number of pairs of frames."""
_MIN_DISTANCE_PX, _MIN_DISTANCE_SIGMAS = 2.0, 5.0
"""Distance from the epipolar line, in px and in standard deviations of the tracks,
beyond which a point moves independently; 2 px assume noise of up to 0.4 px at any image
size."""
_MAX_RELATIVE_DIFFERENCE = 0.3
"""Largest difference of the displacements of neighbours that move together, relative to
their size."""
_MIN_WARNING_SHARE = 0.15
"""Least share of the points for a warning."""
_MIN_POINTS = 6


def second_motion_warning(
    tracks: Tracks, found: Reconstruction, intrinsics: Intrinsics
) -> str | None:
    """Returns a warning if many points move together relative to
    the scene, or `None`."""
    if found.kind not in ("moving", "rotation", "static") or not len(tracks.frame):
        return None
    K, distortion = as_opencv(intrinsics.params)
    xy = rays(tracks.uv, K, distortion)
    focal = float(np.sqrt(K[0, 0] * K[1, 1]))
    limit = max(_MIN_DISTANCE_PX, _MIN_DISTANCE_SIGMAS * noise_of(tracks)) / focal
    num_frames = len(found.T_WC)
    order = np.argsort(tracks.frame, kind="stable")
    bounds = np.searchsorted(tracks.frame[order], np.arange(num_frames + 1))
    total, together = 0, 0
    step = max(2, -(-num_frames // _MAX_PAIRS))
    for a in range(0, num_frames - _GAP_FRAMES, step):
        b = a + _GAP_FRAMES
        if not (found.registered[a] and found.registered[b]):
            continue
        at_a, at_b = (order[bounds[k] : bounds[k + 1]] for k in (a, b))
        ids = tracks.landmark[at_a], tracks.landmark[at_b]
        _, i, j = np.intersect1d(*ids, return_indices=True)
        if len(i) < _MIN_POINTS:
            continue
        before, after = xy[at_a[i]], xy[at_b[j]]
        away = _distance(found, a, b, before, after)
        moves = away > limit
        total += len(i)
        together += _together(before[moves], (after - before)[moves])
    if not total or together < _MIN_WARNING_SHARE * total:
        return None
    return (
        f"{100 * together / total:.0f} % of the points move together against the rest "
        "(traffic, a crowd, a reflection?): they are left out, but look whether the "
        "camera's path is that of the camera; masks of what moves would help."
    )


def _distance(
    found: Reconstruction, a: int, b: int, before: np.ndarray, after: np.ndarray
) -> np.ndarray:
    """Returns the distance of each pair of points from the cameras' epipolar geometry,
    or from their rotation if that is less, at depth 1."""
    T = np.linalg.inv(found.T_WC[b]) @ found.T_WC[a]
    R, t = T[:3, :3], T[:3, 3]
    turned = unit_rays(before) @ R.T
    plain = np.linalg.norm(turned[:, :2] / turned[:, 2:] - after, axis=-1)
    length = np.linalg.norm(t)
    if found.kind != "moving" or length < 1e-9:
        return plain
    return np.minimum(sampson(essential(R, t / length), before, after), plain)


def _together(at: np.ndarray, step: np.ndarray) -> int:
    """Returns the number of points that move as their nearest neighbour does."""
    if len(at) < _MIN_POINTS:
        return 0
    apart = np.linalg.norm(at[:, None] - at, axis=-1)
    np.fill_diagonal(apart, np.inf)
    nearest = step[np.argmin(apart, axis=1)]
    size = np.linalg.norm(step, axis=-1)
    return int(
        (
            np.linalg.norm(nearest - step, axis=-1) < _MAX_RELATIVE_DIFFERENCE * size
        ).sum()
    )
