"""Classification of the camera motion: none, pure rotation, translation, or a cut."""

import numpy as np
from jaxtyping import Bool, Float, Int

from bodyslam_jax.geometry.triangulation import unit_rays
from bodyslam_jax.io.camera.calibration import as_opencv, rays
from bodyslam_jax.sfm.bundle import Views, rows_by
from bodyslam_jax.sfm.multiview import fit_rotation
from bodyslam_jax.types import Intrinsics, Tracks

KEYFRAME_MOTION_SHARE = 0.03
"""Motion of points between keyframes, as a share of the image's longer side."""
_MIN_FOLLOWED_SHARE = 0.05
"""Least share of points that are tracked from frame to frame, however quick the
motion."""
_LOW_FOLLOWED_SHARE = 0.3
"""Share of tracked points below which a displacement half as large is a cut."""
_WINDOW_FRAMES = 10
"""Number of frames over which a place is averaged by its median."""
_JUMP_LIMITS = 10.0, 0.08
"""A displacement between frames is a cut beyond this multiple of the median
displacement, if it is also beyond this distance at depth 1."""


def find_cuts(views: Views, num_frames: int, min_shared: int) -> list[int]:
    """Returns the first frames of shots: 0, and those that share fewer than
    `min_shared` points with the frame before."""
    ordered = np.lexsort((views.frame, views.landmark))
    frame, landmark = views.frame[ordered], views.landmark[ordered]
    same = landmark[1:] == landmark[:-1]
    # A point observed before and after a frame links both, also if it is not observed
    # in the frame itself.
    links = np.zeros(num_frames + 1)
    np.add.at(links, frame[:-1][same] + 1, 1)
    np.add.at(links, frame[1:][same] + 1, -1)
    shared = np.cumsum(links)[:num_frames]
    return [0] + [k for k in range(1, num_frames) if shared[k] < min_shared]


def find_jumps(views: Views, num_frames: int, min_shared: int) -> list[int]:
    """Returns the frames of cuts beyond which the same points are found again.

    At a cut almost no point is tracked from the frame before, although both have many,
    or all points move many times as far as between other frames.
    """
    followed = np.zeros(num_frames, dtype=np.int64)
    ordered = np.lexsort((views.frame, views.landmark))
    frame, landmark = views.frame[ordered], views.landmark[ordered]
    on = (landmark[1:] == landmark[:-1]) & (frame[1:] == frame[:-1] + 1)
    np.add.at(followed, frame[1:][on], 1)
    count = np.bincount(frame, minlength=num_frames)
    fewest = np.minimum(count[1:], count[:-1])
    lost = (fewest >= 2 * min_shared) & (followed[1:] < _MIN_FOLLOWED_SHARE * fewest)
    xy = views.xy[ordered]
    step = np.linalg.norm(xy[1:] - xy[:-1], axis=-1)[on]
    into = frame[1:][on]
    typical = [
        np.median(step[into == k]) if followed[k] else 0.0 for k in range(1, num_frames)
    ]
    leap = _JUMP_LIMITS[0] * np.median(typical) if typical else 0.0
    far = np.asarray(typical) / max(leap, _JUMP_LIMITS[1])
    # Half the displacement suffices where most points are lost as well.
    lost |= (far > 1) | ((far > 0.5) & (followed[1:] < _LOW_FOLLOWED_SHARE * fewest))
    return (np.flatnonzero(lost) + 1).tolist()


def choose_keyframes(
    views: Views, first: int, last: int, motion: float, min_shared: int
) -> Int[np.ndarray, " k"]:
    """Returns frames between which points moved by `motion` (at depth 1), or many of
    which are new."""
    by_frame = _by_frame(views, last + 1)
    chosen = [first]
    ids, xy = by_frame[first]
    for k in range(first + 1, last + 1):
        ids_k, xy_k = by_frame[k]
        _, a, b = np.intersect1d(ids, ids_k, return_indices=True)
        if len(ids_k) < min_shared:
            continue
        moved = (
            np.median(np.linalg.norm(xy_k[b] - xy[a], axis=-1)) if len(a) else np.inf
        )
        if (
            moved > motion
            or len(a) < 0.6 * len(ids)
            or k == last
            or k - chosen[-1] > 30
        ):
            chosen.append(k)
            ids, xy = ids_k, xy_k
    return np.asarray(chosen)


def stillness(views: Views) -> float:
    """Returns the image motion of points at depth 1: the median of the largest distance
    between their median position in the first ten frames and in any later ones.

    Medians over windows suppress tracking noise, so that noise of 0.5 px at 640x480
    stays below the limit of a static camera.
    """
    ordered = np.lexsort((views.frame, views.landmark))
    landmark, xy = views.landmark[ordered], views.xy[ordered]
    starts = np.flatnonzero(np.diff(landmark, prepend=-1))
    lengths = np.diff(np.append(starts, len(landmark)))
    long = lengths >= max(2, 0.5 * np.percentile(lengths, 90))
    wander = []
    for start, length in zip(starts[long], lengths[long], strict=True):
        points = xy[start : start + length]
        parts = np.array_split(points, max(2, length // _WINDOW_FRAMES))
        medians = np.array([np.median(part, axis=0) for part in parts])
        wander.append(np.linalg.norm(medians - medians[0], axis=-1).max())
    return float(np.median(wander)) if wander else np.inf


def background_motion(tracks: Tracks, intrinsics: Intrinsics) -> float:
    """Returns the image motion of the tracks, px (`stillness`); NaN without any."""
    if not len(tracks.frame):
        return float("nan")
    K, distortion = as_opencv(intrinsics.params)
    xy = rays(tracks.uv, K, distortion)
    still = stillness(Views(tracks.frame, tracks.landmark, xy))
    return float(still * np.sqrt(K[0, 0] * K[1, 1]))


def rotation_error(
    views: Views, keyframes: Int[np.ndarray, " k"], scale: float
) -> Float[np.ndarray, "p 4"]:
    """Returns the residuals of a pure rotation between pairs of keyframes.

    Rows are of pairs that share 30 points or more: first and second frame, the median
    residual angle (rad) of the best rotation, and the number of shared points.
    """
    by_frame = _by_frame(views, int(max(keyframes, default=0)) + 1)
    rows = []
    for i, a in enumerate(keyframes):
        for b in keyframes[i + 1 :]:
            _, at_a, at_b = np.intersect1d(
                by_frame[a][0], by_frame[b][0], return_indices=True
            )
            if len(at_a) < 30:
                continue
            rays = unit_rays(by_frame[a][1][at_a]), unit_rays(by_frame[b][1][at_b])
            _, away = fit_rotation(*rays, scale)
            rows.append((a, b, np.median(away), len(at_a)))
    return np.asarray(rows, dtype=np.float64).reshape(-1, 4)


def rotations_only(
    views: Views,
    num_frames: int,
    num_landmarks: int,
    scale: float,
    *,
    turns: bool = True,
) -> tuple[
    Float[np.ndarray, "t 3 3"], Float[np.ndarray, "l 3"], Bool[np.ndarray, " t"]
]:
    """Estimates rotations R_CW of a camera that only turns, and directions to points.

    It begins frame by frame, then alternates between all directions, each the robust
    mean of its rays, and all rotations, each the best for its directions. Without
    `turns` the rotations are the identity. Returns rotations, directions, and which
    frames were solved.
    """
    by_frame = _by_frame(views, num_frames)
    R = np.tile(np.eye(3), (num_frames, 1, 1))
    direction = np.zeros((num_landmarks, 3))
    has_direction = np.zeros(num_landmarks, dtype=bool)
    solved = np.zeros(num_frames, dtype=bool)
    for k in range(num_frames):
        ids, xy = by_frame[k]
        ray = unit_rays(xy)
        at = has_direction[ids]
        if solved.any():
            R[k] = R[k - 1]
        if at.sum() >= 6 and turns:
            R[k] = fit_rotation(direction[ids[at]], ray[at], scale)[0]
        if at.sum() >= 6 or (not solved.any() and len(ids) >= 6):
            solved[k] = True
            new = ids[~at]
            direction[new] = ray[~at] @ R[k]
            has_direction[new] = True
    for _ in range(20):
        ray_W = np.einsum("mji,mj->mi", R[views.frame], unit_rays(views.xy))
        away = np.linalg.norm(ray_W - direction[views.landmark], axis=-1)
        weight = 1 / (1 + (away / scale) ** 2)
        total = np.zeros_like(direction)
        np.add.at(total, views.landmark, weight[:, None] * ray_W)
        length = np.linalg.norm(total, axis=-1, keepdims=True)
        direction = np.where(length > 0, total / np.maximum(length, 1e-12), direction)
        for k in np.flatnonzero(solved & turns):
            ids, xy = by_frame[int(k)]
            R[k] = fit_rotation(direction[ids], unit_rays(xy), scale)[0]
    return R, direction, solved


def _by_frame(
    views: Views, num: int
) -> list[tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 2"]]]:
    """Returns landmarks and places at depth 1 in each of `num` frames."""
    rows = rows_by(views.frame, num)
    return [(views.landmark[of], views.xy[of]) for of in rows]
