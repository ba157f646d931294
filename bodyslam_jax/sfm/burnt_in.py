"""Detects overlays: tracks that stay at one pixel and are not part of the scene.

Text, logos and displays burnt into a video, dirt on the lens, and parts of the vehicle
or hand that carries the camera give long tracks with strong contrast. A scene point may
stay at its pixel too: far away, straight ahead of a camera that moves forward, or with
a static camera. So a rotation or an essential matrix is fitted to the points that move;
a still point that contradicts it in most pairs of frames is classified as burnt in.
Under pure translation a point at infinity stays still without contradiction, and is
kept.
"""

import dataclasses
from collections.abc import Iterator

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from bodyslam_jax.geometry.triangulation import unit_rays
from bodyslam_jax.io.camera.calibration import as_opencv, rays
from bodyslam_jax.sfm.bundle import rows_by
from bodyslam_jax.sfm.multiview import essential_matrix, fit_rotation, sampson
from bodyslam_jax.types import Intrinsics, Tracks

_TRACK_SIGMA_PX = 0.2
"""Tracking noise that is assumed, px (1 σ)."""
MAX_STILL_DISPLACEMENT_PX = 2.5 * _TRACK_SIGMA_PX
"""Largest displacement of a point that counts as still, px: 2.5 σ of the assumed noise,
scaled with larger images, or as many of noisier tracks."""
_PAIR_GAPS_FRAMES = (6, 15, 30, 60)
"""Distances, in frames, of the two frames of a pair."""
_MAX_ANCHORS = 300
"""Largest number of first frames of pairs."""
MIN_MOVING_RATIO = 4.0
"""Least ratio of the median displacement of moving points to the limit of still ones,
at which the two can be separated."""
MIN_MOVING_POINTS = 15
_MIN_INCONSISTENT_PAIRS = 2
_MIN_INFORMATIVE_PAIRS = (3, 0.1)
"""Least number of pairs in which a scene moves beside still points, and their share of
the pairs with still points: fewer may be an object that crosses before a static
camera."""
_MIN_INCONSISTENT_SHARE = 0.4
"""Least share of a still point's pairs that must contradict the motion; scene points
nearly always fit."""
_MIN_MEAN_PAIRS, _MIN_MEAN_DISTANCE = 6, 0.7
"""Least number of pairs, and least mean distance in the unit of `_MAX_MODEL_DISTANCE`,
at which a point is classified as burnt in as well."""
_MAX_MODEL_DISTANCE = 3.0
"""Distance from the motion model of the others, in units of their robust scatter or, if
larger, the limit of still points, beyond which a point contradicts the model."""
_NUM_CELLS = 8
"""Number of cells along the image's longer side. Camera motion
is visible all over it."""
_MIN_COVER_RATIO, _MIN_COVER_ROWS = 1.0, 3
"""Least ratio of moving to still cells, and least number of rows and columns of moving
cells: less may be traffic before a static camera."""
_MASKED_FRAMES = 15
"""Number of frames before and after a burnt-in point in which its place is masked."""


@dataclasses.dataclass(frozen=True)
class BurntIn:
    """Classification of the tracks that stay at their pixel."""

    of_landmark: Bool[np.ndarray, " l"]
    still: Bool[np.ndarray, " l"]
    """Tracks that stay at their pixel, of the scene or not."""

    @property
    def found(self) -> bool:
        return bool(self.of_landmark.any())


def find_burnt_in(tracks: Tracks, intrinsics: Intrinsics, num_frames: int) -> BurntIn:
    """Classifies tracks that stay at their pixel against the motion of all others.

    A point counts as still up to `still_limit` px, or 2.5 standard deviations of the
    tracks' noise, if that is more.
    """
    num = int(tracks.landmark.max()) + 1 if len(tracks.landmark) else 0
    tested, against = np.zeros(num, np.int64), np.zeros(num, np.int64)
    stays, pairs = np.zeros(num, np.int64), np.zeros(num, np.int64)
    total, telling, resting = np.zeros(num), 0, 0
    size = (intrinsics.width, intrinsics.height)
    noise = noise_of(tracks)
    limit = max(still_limit(size), MAX_STILL_DISPLACEMENT_PX / _TRACK_SIGMA_PX * noise)
    of_frame = rows_by(tracks.frame, num_frames)
    K, distortion = as_opencv(intrinsics.params)
    for a, b in _pairs(num_frames):
        in_a, in_b = of_frame[a], of_frame[b]
        ids, i, j = np.intersect1d(
            tracks.landmark[in_a], tracks.landmark[in_b], return_indices=True
        )
        at_a, at_b = tracks.uv[in_a[i]], tracks.uv[in_b[j]]
        moved = np.linalg.norm(at_b - at_a, axis=-1)
        still = moved < limit
        pairs[ids] += 1
        stays[ids[still]] += 1
        resting += int(still.any())
        movers = moved > 2 * limit
        if not still.any() or movers.sum() < MIN_MOVING_POINTS:
            continue
        if np.median(moved[movers]) < MIN_MOVING_RATIO * limit:
            continue
        away, fits = _contradiction(
            rays(at_a, K, distortion),
            rays(at_b, K, distortion),
            movers,
            limit / K[0, 0],
        )
        if away is None or not _covers(at_a, fits, still, size):
            continue
        telling += 1
        tested[ids[still]] += 1
        against[ids[still]] += away[still] > _MAX_MODEL_DISTANCE
        total[ids[still]] += np.minimum(away[still], _MAX_MODEL_DISTANCE)
    often = against >= np.maximum(
        _MIN_INCONSISTENT_PAIRS, _MIN_INCONSISTENT_SHARE * tested
    )
    # Or a smaller distance in nearly all pairs: a hand-held camera may rotate little.
    always = (tested >= _MIN_MEAN_PAIRS) & (total > _MIN_MEAN_DISTANCE * tested)
    burnt = often | always
    burnt &= telling >= max(
        _MIN_INFORMATIVE_PAIRS[0], _MIN_INFORMATIVE_PAIRS[1] * resting
    )
    # Tracks that are still for part of the time only, as at occlusions, are kept.
    burnt &= stays >= 0.5 * pairs
    return BurntIn(burnt, (stays >= 0.5 * pairs) & (pairs > 0))


def without_burnt_in(
    tracks: Tracks, intrinsics: Intrinsics, num_frames: int
) -> tuple[Tracks, float]:
    """Returns the tracks of the scene, and the share of observations removed."""
    found = find_burnt_in(tracks, intrinsics, num_frames)
    if not found.found:
        return tracks, 0.0
    kept = ~found.of_landmark[tracks.landmark]
    _, landmark = np.unique(tracks.landmark[kept], return_inverse=True)
    left = dataclasses.replace(
        tracks,
        frame=tracks.frame[kept],
        landmark=landmark.astype(np.int64),
        uv=tracks.uv[kept],
    )
    return left, float(1 - kept.mean())


def burnt_in_warning(share: float) -> str:
    return (
        f"{100 * share:.0f} % of the followed points stay at their pixel while the "
        "scene moves (text, a logo or a part of the vehicle?): left out."
    )


def still_limit(size: tuple[int, int]) -> float:
    """Returns the largest displacement (px) of a still point, which grows with the
    image as KLT's errors do."""
    return MAX_STILL_DISPLACEMENT_PX * max(1.0, max(size) / 1280)


def noise_of(tracks: Tracks) -> float:
    """Estimates the standard deviation (px) of an observation from second differences,
    by their lower quartile, so that camera motion has little influence."""
    order = np.lexsort((tracks.frame, tracks.landmark))
    frame, landmark, uv = (x[order] for x in (tracks.frame, tracks.landmark, tracks.uv))
    in_row = (landmark[2:] == landmark[:-2]) & (frame[2:] == frame[:-2] + 2)
    if not in_row.any():
        return 0.0
    bend = np.linalg.norm(uv[2:] - 2 * uv[1:-1] + uv[:-2], axis=-1)[in_row]
    # The lower quartile of a Rayleigh variable is 0.7585 of its parameter.
    return float(np.quantile(bend, 0.25) / 0.7585 / np.sqrt(6))


def masks_of(
    frame: Int[np.ndarray, " m"],
    uv: Float[np.ndarray, "m 2"],
    num_frames: int,
    size: tuple[int, int],
    radius: int,
) -> Iterator[UInt8[np.ndarray, "y x"]]:
    """Yields masks (255) around observations, from `_MASKED_FRAMES` frames before to as
    many after each.

    Args:
        size: width and height, px.
        radius: radius of the mask around a point, px.
    """
    # Nearby observations are merged: text persists while its tracks come and go.
    place = np.round(uv / max(1, radius // 3)).astype(np.int64)
    _, of = np.unique(place, axis=0, return_inverse=True)
    of = of.ravel()
    count = int(of.max()) + 1 if len(of) else 0
    counts = np.maximum(np.bincount(of, minlength=count), 1)
    centre = np.stack(
        [np.bincount(of, uv[:, i], count) / counts for i in range(2)], axis=-1
    )
    visible = np.zeros((count, num_frames), dtype=bool)
    visible[of, frame] = True
    width = np.ones(2 * _MASKED_FRAMES + 1, dtype=np.uint8)[None]
    shown = cv2.dilate(visible.astype(np.uint8), width) if count else visible
    for k in range(num_frames):
        mask = np.zeros((size[1], size[0]), dtype=np.uint8)
        for x, y in centre[shown[:, k] > 0]:
            cv2.circle(mask, (round(float(x)), round(float(y))), radius, 255, -1)
        yield mask


def _pairs(num_frames: int) -> Iterator[tuple[int, int]]:
    step = max(3, -(-num_frames // _MAX_ANCHORS))
    step = min(step, 10)
    for gap in _PAIR_GAPS_FRAMES:
        for a in range(0, num_frames - gap, step):
            yield a, a + gap


def _contradiction(
    xy_a: np.ndarray, xy_b: np.ndarray, movers: np.ndarray, limit: float
) -> tuple[np.ndarray | None, np.ndarray]:
    """Returns the distance of each pair from the motion model of the movers, in robust
    standard deviations (`None` without a model), and which movers are its inliers.

    A rotation is tried first: under pure rotation the essential matrix is undetermined.
    """
    a, b = xy_a[movers], xy_b[movers]
    R, away = fit_rotation(unit_rays(a), unit_rays(b), limit)
    fits = np.zeros(len(movers), dtype=bool)
    good = away < 3 * limit
    if good.mean() > 0.7:
        fits[movers] = good
        scatter = max(limit, 1.5 * float(np.median(away)))
        left = np.linalg.norm(unit_rays(xy_b) - unit_rays(xy_a) @ R.T, axis=-1)
        return left / scatter, fits
    E, inlier = essential_matrix(a, b, 2 * limit)
    if E is None or E.shape != (3, 3) or inlier is None or inlier.mean() < 0.5:
        return None, fits
    fits[movers] = inlier.ravel() > 0
    left = sampson(E, xy_a, xy_b)
    scatter = max(limit, 1.5 * float(np.median(left[fits])))
    return left / scatter, fits


def _covers(
    uv: np.ndarray, movers: np.ndarray, still: np.ndarray, size: tuple[int, int]
) -> bool:
    """Returns True if the moving points are spread over the image as a scene is."""
    cell = max(size) / _NUM_CELLS
    cells = lambda rows: {tuple(c) for c in (uv[rows] // cell).astype(int).tolist()}
    moving, staying = cells(movers), cells(still)
    if min(len({cell[i] for cell in moving}) for i in (0, 1)) < _MIN_COVER_ROWS:
        return False
    return len(moving) >= max(4, _MIN_COVER_RATIO * len(staying - moving))
