"""Simulates tracks of static points, with the errors of a feature tracker."""

import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax.simulation.room import Room, landmarks_on
from bodyslam_jax.simulation.sensor_noise import Noise, project
from bodyslam_jax.types import Tracks

_LIMB_CAPSULES = (
    *((0, 12, 0.19), (12, 15, 0.14), (15, 15, 0.17)),
    *((1, 4, 0.13), (4, 7, 0.10), (7, 10, 0.11), (2, 5, 0.13), (5, 8, 0.10)),
    *((8, 11, 0.11), (10, 10, 0.12), (11, 11, 0.12), (16, 18, 0.09), (18, 20, 0.08)),
    *((20, 22, 0.09), (22, 22, 0.13), (17, 19, 0.09), (19, 21, 0.08), (21, 23, 0.09)),
    *((23, 23, 0.13), (16, 17, 0.12), (1, 2, 0.17)),
)
"""Capsules that cover the body: two joints and a radius, m."""
_POINTS_PER_M2 = 9.0
"""Points per m² of all surfaces."""
_GRID_CELLS = (8, 6)
_MAX_CANDIDATES = 700
"""Number of candidate points per image that are tested for visibility at most, to bound
the run time."""
_BORDER_PX = 3.0
"""Distance from the image's edge at which tracks end, px."""


def track_points(
    room: Room,
    T_WC: Float[np.ndarray, "t 4 4"],
    joints_C: Float[np.ndarray, "h t 24 3"],
    intrinsics: Float[np.ndarray, "4"],
    size: tuple[int, int],
    noise: Noise,
    rng: np.random.Generator,
    *,
    life: float,
    wanted: int = 200,
) -> tuple[Tracks, Float[np.ndarray, "l 3"]]:
    """Returns about `wanted` tracks per frame, spread over the image, and their true
    points (m).

    A track ends when its point leaves the image or is occluded by furniture or a
    person, and at random after `life` frames on average; a point observed again starts
    a new track. Tracks of a single frame are dropped.
    """
    points, normals = landmarks_on(room.faces(), _POINTS_PER_M2, rng)
    strength = rng.random(len(points))
    frames, ids, pixels, places = [], [], [], []
    alive = np.empty((0, 2), int)  # track, point
    count = 0
    for k, T in enumerate(T_WC):
        eye = T[:3, 3]
        p_C = (points - eye) @ T[:3, :3]
        uv = project(p_C, intrinsics)
        low, high = _BORDER_PX, np.array(size) - 1 - _BORDER_PX
        visible = (p_C[:, 2] > 0.3) & ((uv > low) & (uv < high)).all(axis=1)
        visible &= ((eye - points) * normals).sum(axis=1) > 0.12 * p_C[:, 2]
        some = np.flatnonzero(visible)
        if len(some) > _MAX_CANDIDATES:
            some = np.union1d(
                rng.choice(some, _MAX_CANDIDATES, replace=False),
                alive[visible[alive[:, 1]], 1],
            )
        some = some[~room.is_hidden(eye, points[some])]
        for body in joints_C[:, k]:
            some = some[~_behind_person(uv[some], p_C[some, 2], body, intrinsics)]
        visible[:] = False
        visible[some] = True
        alive = alive[visible[alive[:, 1]] & (rng.random(len(alive)) > 1 / life)]
        if len(alive) < wanted:
            fresh = _spread(
                uv, some[~np.isin(some, alive[:, 1])], strength, alive[:, 1], size,
                wanted - len(alive),
            )  # fmt: skip
            new = np.stack([count + np.arange(len(fresh)), fresh], axis=1)
            alive = np.concatenate([alive, new])
            places.append(points[fresh])
            count += len(fresh)
        frames.append(np.full(len(alive), k))
        ids.append(alive[:, 0])
        pixels.append(uv[alive[:, 1]])
    frame, track, uv = map(np.concatenate, (frames, ids, pixels))
    uv = _disturb(frame, track, uv, size, noise, rng)
    lasting = np.bincount(track, minlength=count)[track] > 1
    kept, landmark = np.unique(track[lasting], return_inverse=True)
    tracks = Tracks(frame[lasting], landmark, uv[lasting])
    return tracks, np.concatenate(places)[kept]


def _spread(uv, candidates, strength, taken, size, wanted):
    """Returns the strongest points of the emptiest cells of a grid."""
    cell_of = lambda at: (at * _GRID_CELLS / size).astype(int) @ [1, _GRID_CELLS[0]]
    filled = np.bincount(cell_of(uv[taken]), minlength=_GRID_CELLS[0] * _GRID_CELLS[1])
    order = candidates[np.argsort(-strength[candidates])]
    cell = cell_of(uv[order])
    # Number of points that the cell would hold before this one is added.
    by_cell = np.argsort(cell, kind="stable")
    first = np.searchsorted(cell[by_cell], cell[by_cell])
    rank = np.empty(len(order), int)
    rank[by_cell] = np.arange(len(order)) - first
    return order[np.argsort(filled[cell] + rank, kind="stable")[:wanted]]


def is_behind(
    points_C: Float[np.ndarray, "t n 3"],
    joints_C: Float[np.ndarray, "t 24 3"],
    intrinsics: Float[np.ndarray, "4"],
) -> Bool[np.ndarray, "t n"]:
    """Returns whether a person with these joints hides points, all in the camera frame,
    m."""
    uv = project(points_C, intrinsics)
    return np.stack(
        [
            _behind_person(uv[k], points_C[k, :, 2], joints_C[k], intrinsics)
            for k in range(len(points_C))
        ]
    )


def _behind_person(uv, depth, joints_C, intrinsics) -> Bool[np.ndarray, " n"]:
    """Returns whether the body hides points that lie behind it."""
    hidden = np.zeros(len(uv), bool)
    if (joints_C[:, 2] < 0.2).any():
        return hidden
    at = project(joints_C, intrinsics)
    for a, b, radius in _LIMB_CAPSULES:
        way = at[b] - at[a]
        share = np.clip((uv - at[a]) @ way / max(way @ way, 1.0), 0, 1)
        z = joints_C[a, 2] * (1 - share) + joints_C[b, 2] * share
        away = np.linalg.norm(uv - at[a] - share[:, None] * way, axis=1)
        hidden |= (away < radius * intrinsics[0] / z) & (depth > z)
    return hidden


def _disturb(frame, track, uv, size, noise: Noise, rng):
    """Adds white noise with a standard deviation per track, and outliers.

    Half of the outliers are single wrong matches, half are tracks that drift with a
    moving object.
    """
    count = int(track.max()) + 1
    sigma = rng.uniform(*noise.track, count)
    uv = uv + sigma[track, None] * rng.standard_normal(uv.shape)
    single = rng.random(len(uv)) < noise.track_outliers / 2
    uv[single] += rng.laplace(0, 15.0, (int(single.sum()), 2))
    length = np.bincount(track, minlength=count)
    start = np.full(count, frame.max() + 1)
    np.minimum.at(start, track, frame)
    # A drifting track is wrong for half of its duration on average.
    stuck = rng.random(count) < noise.track_outliers
    onset = start + (rng.random(count) * length).astype(int)
    drift = rng.normal(0, 2.0, (count, 2))
    since = np.where(stuck[track], np.maximum(frame - onset[track] + 1, 0), 0)
    uv = uv + since[:, None] * drift[track]
    return np.clip(uv, 0, np.array(size) - 1.0)
