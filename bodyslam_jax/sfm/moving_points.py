"""A second rigid motion among the outliers: traffic, a crowd, reflections.

The reconstruction rejects such points as outliers. If they are many, the roles may be
exchanged and the camera path may be relative to them; so a warning is given.
"""

import numpy as np

from bodyslam_jax.geometry.triangulation import unit_rays
from bodyslam_jax.io.camera.calibration import as_opencv, rays
from bodyslam_jax.sfm.burnt_in import noise_of, sampson
from bodyslam_jax.sfm.sfm import Reconstruction
from bodyslam_jax.types import Intrinsics, Tracks

_GAP = 8
_MOST_PAIRS = 60
_FAR, _SIGMAS = 2.0, 5.0
"""Distance from the epipolar line, px and in standard deviations of the tracks, beyond
which a point moves by itself; 2 px assume noise of up to 0.4 px at any image size."""
_ALIKE = 0.3
"""Difference of the displacements of neighbours that move together, of their size."""
_MANY = 0.15
"""Share of the points from which a warning is given."""
_FEWEST = 6


def second_motion_warning(
    tracks: Tracks, found: Reconstruction, intrinsics: Intrinsics
) -> str | None:
    """A warning where many points move together against the scene that was found."""
    if found.kind not in ("moving", "rotation", "static") or not len(tracks.frame):
        return None
    K, distortion = as_opencv(intrinsics.params)
    xy = rays(tracks.uv, K, distortion)
    focal = float(np.sqrt(K[0, 0] * K[1, 1]))
    limit = max(_FAR, _SIGMAS * noise_of(tracks)) / focal
    num_frames = len(found.T_WC)
    order = np.argsort(tracks.frame, kind="stable")
    bounds = np.searchsorted(tracks.frame[order], np.arange(num_frames + 1))
    total, together = 0, 0
    step = max(2, -(-num_frames // _MOST_PAIRS))
    for a in range(0, num_frames - _GAP, step):
        b = a + _GAP
        if not (found.registered[a] and found.registered[b]):
            continue
        at_a, at_b = (order[bounds[k] : bounds[k + 1]] for k in (a, b))
        ids = tracks.landmark[at_a], tracks.landmark[at_b]
        _, i, j = np.intersect1d(*ids, return_indices=True)
        if len(i) < _FEWEST:
            continue
        before, after = xy[at_a[i]], xy[at_b[j]]
        away = _distance(found, a, b, before, after)
        moves = away > limit
        total += len(i)
        together += _together(before[moves], (after - before)[moves])
    if not total or together < _MANY * total:
        return None
    return (
        f"{100 * together / total:.0f} % of the points move together against the rest "
        "(traffic, a crowd, a reflection?): they are left out, but look whether the "
        "camera's path is that of the camera; masks of what moves would help."
    )


def _distance(
    found: Reconstruction, a: int, b: int, before: np.ndarray, after: np.ndarray
) -> np.ndarray:
    """Of each pair of points from what the cameras' motion allows, at depth 1."""
    T = np.linalg.inv(found.T_WC[b]) @ found.T_WC[a]
    R, t = T[:3, :3], T[:3, 3]
    turned = unit_rays(before) @ R.T
    plain = np.linalg.norm(turned[:, :2] / turned[:, 2:] - after, axis=-1)
    length = np.linalg.norm(t)
    if found.kind != "moving" or length < 1e-9:
        return plain
    x, y, z = t / length
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.minimum(sampson(cross @ R, before, after), plain)


def _together(at: np.ndarray, step: np.ndarray) -> int:
    """How many of the points move as the nearest other does."""
    if len(at) < _FEWEST:
        return 0
    apart = np.linalg.norm(at[:, None] - at, axis=-1)
    np.fill_diagonal(apart, np.inf)
    nearest = step[np.argmin(apart, axis=1)]
    size = np.linalg.norm(step, axis=-1)
    return int((np.linalg.norm(nearest - step, axis=-1) < _ALIKE * size).sum())
