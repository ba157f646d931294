"""Structure from motion: a camera pose for every frame and a map, up to scale."""

import dataclasses
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from bodyslam_jax.config import Structure
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.io.camera.calibration import as_opencv, rays
from bodyslam_jax.sfm.bundle import Scene, Views, errors
from bodyslam_jax.sfm.camera_motion import (
    KEYFRAME_MOTION_SHARE,
    choose_keyframes,
    find_cuts,
    find_jumps,
    rotation_error,
    rotations_only,
    stillness,
)
from bodyslam_jax.sfm.given_path import (
    MIN_TESTED_OBSERVATIONS,
    PathTest,
    what_would_fit,
)
from bodyslam_jax.sfm.incremental import MIN_SHARED_POINTS, Builder
from bodyslam_jax.sfm.partial_map import PartialMap
from bodyslam_jax.sfm.track_splitting import information_from_other_tracks
from bodyslam_jax.types import CameraPath, Intrinsics, Tracks

Kind = Literal["moving", "rotation", "static", "failed"]

MAX_STATIC_MOTION_PX = 0.6
"""Motion of points below which the camera is static, px: assumes that medians over
10 frames of tracks with 0.5 px noise at 640x480 drift by less; not scaled with the
image."""
MAX_ROTATION_ERROR_PX = 1.0
"""Residual of a pure rotation below which there is no usable parallax, px: 2 σ of an
assumed tracking noise of 0.5 px at 640x480; not scaled with the image."""
_MIN_BASELINE = 0.08
"""Extent of the camera path, relative to the median distance of landmarks, below which
the camera only rotates: assumes that a wrong focal length makes a rotating camera
appear to move by less than this."""
_MIN_MAPPED_SHARE = 0.3
"""Share of observations that triangulated points explain, below which the images may
show no parallax along a given path."""

_MIN_CERTAIN_PARALLAX = 6.0
"""Residual of a pure rotation, in `MAX_ROTATION_ERROR_PX`, beyond which the camera
certainly translates: 6 px, assuming that tracking noise (0.5 px at
640x480) and a wrong focal length together stay below it."""


@dataclasses.dataclass(frozen=True)
class Reconstruction:
    """Cameras and map of `t` frames and `l` landmarks, up to scale."""

    kind: Kind
    """`moving`: the camera translates. `rotation`: it only turns, its centre is 0 and
    the landmarks are directions (distance 1). `static`: it does not even turn.
    `failed`: no estimate; poses are the identity."""
    T_WC: Float[np.ndarray, "t 4 4"]
    """Camera to world. The world is the first registered camera, its unit the median
    distance of landmarks from it."""
    registered: Bool[np.ndarray, " t"]
    """Frames whose pose was estimated; the other poses are interpolated or held."""
    landmarks: Float[np.ndarray, "l 3"]
    tracks: Tracks
    """Inlier observations of these landmarks."""
    inlier: Bool[np.ndarray, " m"]
    """Which of the `m` given observations are inliers."""
    landmark_ids: Int[np.ndarray, " l"]
    """Index of each landmark among the given ones; a long track
    is several landmarks."""
    prior_information: Float[np.ndarray, "l 3 3"]
    """Information of other tracks of the same point on each landmark's position, px²
    per squared unit of the map: to be divided by the variance of a pixel."""
    error: float
    """Median reprojection error of the inliers, px."""
    unit: float = 1.0
    """The map's unit, in units of a given camera path."""
    warnings: tuple[str, ...] = ()


def reconstruct(
    tracks: Tracks,
    intrinsics: Intrinsics,
    num_frames: int,
    config: Structure = Structure(),
    *,
    path: CameraPath | None = None,
    static: bool = False,
) -> Reconstruction:
    """Reconstructs cameras and points, and classifies the camera motion.

    After a cut only the longest shot is reconstructed; the other frames hold the
    nearest pose and are not registered. Every frame gets a pose.

    Args:
        path: given camera poses, from which points are triangulated.
        static: whether the camera is known not to move.

    **Raises:** `InputError` if the points do not fit a given path.
    """
    K, distortion = as_opencv(intrinsics.params)
    focal = float(np.sqrt(K[0, 0] * K[1, 1]))
    xy = rays(tracks.uv, K, distortion)
    views = Views(tracks.frame, tracks.landmark, xy)
    num_landmarks = int(tracks.landmark.max()) + 1 if len(tracks.landmark) else 0
    problem = _Problem(
        tracks,
        views,
        intrinsics,
        num_frames,
        num_landmarks,
        focal,
    )

    if path is not None:
        return _along(problem, path, config)
    if static:
        return _on_a_tripod(problem)
    first, last, warnings = _longest_shot(views, num_frames, MIN_SHARED_POINTS)
    within = (views.frame >= first) & (views.frame <= last)
    shot = views[np.flatnonzero(within)]
    if len(np.unique(shot.frame)) < 2:
        per_frame = np.bincount(views.frame, minlength=num_frames) if len(xy) else [0]
        text = f"too few background points: {np.median(per_frame):.0f} a frame."
        if num_frames < 2:
            text = "one frame shows no motion."
        return _nothing(problem, "failed", (*warnings, text))
    still = stillness(shot) * focal
    if still < MAX_STATIC_MOTION_PX:
        text = f"the camera stands still (points wander {still:.2f} px)."
        return _fixed(problem, within, "static", None, (*warnings, text))
    motion = KEYFRAME_MOTION_SHARE * max(intrinsics.width, intrinsics.height) / focal
    keyframes = choose_keyframes(shot, first, last, motion, MIN_SHARED_POINTS)
    pairs = rotation_error(shot, keyframes, 1 / focal)
    away = _turning_error(pairs) * focal / MAX_ROTATION_ERROR_PX
    builder = Builder(shot, num_frames, num_landmarks, focal, config)
    grown = builder.build(keyframes, pairs) if away > 1 else None
    if grown is not None:
        builder.complete(grown, np.arange(first, last + 1))
        inlier = np.zeros(len(tracks.frame), dtype=bool)
        inlier[within] = grown.inlier
        found = _moving(problem, grown, inlier, (first, last), warnings)
        extent = np.linalg.norm(np.ptp(found.T_WC[found.registered, :3, 3], axis=0))
        # A wrong focal length makes even a rotating camera appear to move a little.
        if away > _MIN_CERTAIN_PARALLAX or extent > _MIN_BASELINE:
            return found
    elif away > _MIN_CERTAIN_PARALLAX:
        text = "no pair of frames has enough parallax to start a map."
        return _nothing(problem, "failed", (*warnings, text))
    text = (
        "the camera turns but hardly moves: no depth from parallax, the scale rests on "
        "the body alone."
    )
    return _fixed(problem, within, "rotation", 1 / focal, (*warnings, text))


@dataclasses.dataclass(frozen=True)
class _Problem:
    """The input of a reconstruction."""

    tracks: Tracks
    views: Views
    intrinsics: Intrinsics
    num_frames: int
    num_landmarks: int
    focal: float


def _on_a_tripod(problem: _Problem) -> Reconstruction:
    """Returns the reconstruction of a camera that the user states to be static: the
    identity in every frame."""
    if len(np.unique(problem.views.frame)) > 1:
        every = np.ones(len(problem.views.frame), bool)
        found = _fixed(problem, every, "static", None, ())
    else:
        found = _nothing(problem, "static", ())
    return dataclasses.replace(
        found,
        T_WC=np.tile(np.eye(4), (problem.num_frames, 1, 1)),
        registered=np.ones(problem.num_frames, bool),
    )


def _along(problem: _Problem, path: CameraPath, config: Structure) -> Reconstruction:
    """Returns the map along a given camera path, and poses of frames that it lacks.

    **Raises:** `InputError` if too few points fit the path.
    """
    size = (problem.num_frames, problem.num_landmarks)
    builder = Builder(problem.views, *size, problem.focal, config)
    grown = builder.begin(path)
    builder.complete(grown, np.arange(problem.num_frames))
    num_seen = len(problem.views.frame)
    if not num_seen or (
        not grown.has_point.any() and num_seen < MIN_TESTED_OBSERVATIONS
    ):
        text = (
            f"camera path: {num_seen} observations of background points, of which no "
            "map can be made: the given path is used as it is and was not compared "
            "with the images."
        )
        nothing = np.zeros(num_seen, dtype=bool)
        last = problem.num_frames - 1
        return _moving(problem, grown, nothing, (0, last), (text,))
    test = PathTest(problem.tracks, problem.intrinsics, problem.num_frames)
    fit = test.fit(path.T_WC, path.known)
    mapped, tested = builder.share_explained(grown, np.flatnonzero(path.known))
    if (
        tested >= MIN_TESTED_OBSERVATIONS
        and mapped < _MIN_MAPPED_SHARE
        and _only_turns(problem)
    ):
        text = (
            "the images show no parallax along the given path: the camera only turns."
        )
        every = np.ones(num_seen, bool)
        return _fixed(problem, every, "rotation", 1 / problem.focal, (text,))
    if fit.fits:
        warnings: tuple[str, ...] = ()
        if fit.is_tested and fit.share < fit.doubtful:
            warnings = (
                f"camera path: {100 * fit.share:.0f} % of the points fit it within "
                f"{fit.threshold:.1f} px, where a right path has "
                f"{100 * fit.expected:.0f} %: less exact than poses usually are, or of "
                "a slightly different focal length or clock.",
            )
        last = problem.num_frames - 1
        return _moving(problem, grown, grown.inlier, (0, last), warnings)
    reading = what_would_fit(test, path.T_WC, path.known)
    why = (
        f": {reading}."
        if reading
        else ": poses of another video, from world to camera, with other axes, on "
        "another clock, or another focal length?"
    )
    raise InputError(
        f"camera path: {100 * fit.share:.0f} % of the points in the images fit it "
        f"within {fit.threshold:.1f} px, expected {100 * fit.required:.0f} % or more "
        f"({100 * fit.expected:.0f} % under a right path with this noise){why}"
    )


def _only_turns(problem: _Problem) -> bool:
    """Returns True if a rotation explains the images of all keyframes."""
    shot = problem.views
    motion = KEYFRAME_MOTION_SHARE * max(
        problem.intrinsics.width, problem.intrinsics.height
    )
    keyframes = choose_keyframes(
        shot,
        int(shot.frame.min()),
        int(shot.frame.max()),
        motion / problem.focal,
        MIN_SHARED_POINTS,
    )
    pairs = rotation_error(shot, keyframes, 1 / problem.focal)
    return _turning_error(pairs) * problem.focal < MAX_ROTATION_ERROR_PX


def _longest_shot(
    views: Views, num_frames: int, min_shared: int
) -> tuple[int, int, tuple[str, ...]]:
    starts = find_cuts(views, num_frames, min_shared)
    ends = [*starts[1:], num_frames]
    lengths = np.subtract(ends, starts)
    best = int(np.argmax(lengths))
    if len(starts) == 1:
        jumps = find_jumps(views, num_frames, min_shared)
        if not jumps:
            return 0, num_frames - 1, ()
        at = ", ".join(str(k) for k in jumps[:4])
        text = (
            f"a cut at frame {at}, beyond which the same scene is seen again: cameras "
            "are located on both sides, but people are not followed across it."
        )
        return 0, num_frames - 1, (text,)
    first, last = starts[best], ends[best] - 1
    if first == last:
        return first, last, ()
    at = ", ".join(str(k) for k in starts[1:5]) + (", ..." if len(starts) > 5 else "")
    text = (
        f"cut or lost tracking at frame {at}: only frames {first} to {last} are used."
    )
    return first, last, (text,)


def _turning_error(pairs: np.ndarray) -> float:
    """Returns the residual (rad) of a pure rotation for the worst pairs."""
    if not len(pairs):
        return np.inf
    telling = pairs[:, 2] * np.minimum(pairs[:, 3], 80)
    return float(np.median(pairs[np.argsort(-telling)[:5], 2]))


def _moving(
    problem: _Problem,
    grown: PartialMap,
    inlier: np.ndarray,
    shot: tuple[int, int],
    warnings: tuple[str, ...],
) -> Reconstruction:
    """Moves the world to the first camera, and the unit to the median distance."""
    lost = np.arange(shot[0], shot[1] + 1)
    lost = lost[~grown.registered[lost]]
    if len(lost):
        text = f"{len(lost)} frames not located (from {lost[0]}): poses interpolated."
        warnings = (*warnings, text)
    registered = grown.registered
    k0 = int(np.argmax(registered))
    R0, c0 = grown.scene.R_CW[k0].copy(), grown.scene.centre[k0].copy()
    views = problem.views[np.flatnonzero(inlier)]
    ids, of = np.unique(views.landmark, return_inverse=True)
    points = (grown.scene.points[grown.shown[ids]] - c0) @ R0.T
    unit = float(np.median(np.linalg.norm(points, axis=-1))) if len(ids) else 1.0
    T_WC = np.tile(np.eye(4), (problem.num_frames, 1, 1))
    T_WC[:, :3, :3] = np.einsum("ij,tkj->tik", R0, grown.scene.R_CW)
    T_WC[:, :3, 3] = (grown.scene.centre - c0) @ R0.T / unit
    T_WC = fill_missing_poses(T_WC, registered)
    views = Views(views.frame, of, views.xy)
    prior_information = information_from_other_tracks(
        grown.scene, views, grown.shown[ids]
    )
    prior_information = (problem.focal * unit) ** 2 * (R0 @ prior_information @ R0.T)
    return _pack(
        problem,
        "moving",
        T_WC,
        registered,
        points / unit,
        (ids, of),
        inlier,
        warnings,
        prior_information=prior_information,
        unit=unit,
    )


def _fixed(
    problem: _Problem,
    within: np.ndarray,
    kind: Kind,
    scale: float | None,
    warnings: tuple[str, ...],
) -> Reconstruction:
    """Returns the reconstruction of a camera whose centre does not move: with rotations
    if `scale` is given, else without."""
    shot = problem.views[np.flatnonzero(within)]
    size = (problem.num_frames, problem.num_landmarks)
    rotations = rotations_only(shot, *size, scale or 1.0, turns=scale is not None)
    R_CW, direction, solved = rotations
    k0 = int(np.argmax(solved))
    T_WC = np.tile(np.eye(4), (problem.num_frames, 1, 1))
    T_WC[:, :3, :3] = np.einsum("ij,tkj->tik", R_CW[k0], R_CW)
    T_WC = fill_missing_poses(T_WC, solved)
    direction = direction @ R_CW[k0].T
    scene = Scene(np.swapaxes(T_WC[:, :3, :3], 1, 2), T_WC[:, :3, 3], direction)
    inlier = within & solved[problem.views.frame]
    inlier &= errors(scene, problem.views) * problem.focal < 4.0
    ids, of = np.unique(problem.views.landmark[inlier], return_inverse=True)
    return _pack(
        problem, kind, T_WC, solved, direction[ids], (ids, of), inlier, warnings
    )


def _nothing(
    problem: _Problem, kind: Kind, warnings: tuple[str, ...]
) -> Reconstruction:
    T_WC = np.tile(np.eye(4), (problem.num_frames, 1, 1))
    none = np.zeros(0, dtype=np.int64)
    nowhere = np.zeros(problem.num_frames, dtype=bool)
    inlier = np.zeros(len(problem.views.frame), dtype=bool)
    points = np.zeros((0, 3))
    return _pack(problem, kind, T_WC, nowhere, points, (none, none), inlier, warnings)


def _pack(
    problem: _Problem,
    kind: Kind,
    T_WC: np.ndarray,
    registered: np.ndarray,
    landmarks: np.ndarray,
    which: tuple[np.ndarray, np.ndarray],
    inlier: np.ndarray,
    warnings: tuple[str, ...],
    *,
    prior_information: np.ndarray | None = None,
    unit: float = 1.0,
) -> Reconstruction:
    """Assembles a reconstruction; `which` has the track of each landmark, and the
    landmark of each inlier."""
    ids, landmark = which
    tracks = Tracks(problem.tracks.frame[inlier], landmark, problem.tracks.uv[inlier])
    error = 0.0
    if inlier.any():
        scene = Scene(np.swapaxes(T_WC[:, :3, :3], 1, 2), T_WC[:, :3, 3], landmarks)
        views = problem.views[np.flatnonzero(inlier)]
        found = errors(scene, Views(views.frame, tracks.landmark, views.xy))
        error = float(np.median(found)) * problem.focal
    return Reconstruction(
        kind=kind,
        T_WC=T_WC,
        registered=registered,
        landmarks=landmarks,
        tracks=tracks,
        inlier=inlier,
        landmark_ids=ids,
        prior_information=np.zeros((len(ids), 3, 3))
        if prior_information is None
        else prior_information,
        error=error,
        unit=unit,
        warnings=warnings,
    )


def fill_missing_poses(
    T_WC: Float[np.ndarray, "t 4 4"], valid: Bool[np.ndarray, " t"]
) -> Float[np.ndarray, "t 4 4"]:
    """Interpolates poses where not `valid`; before the first and after the last valid
    one they are constant."""
    at = np.flatnonzero(valid)
    if not len(at) or valid.all():
        return T_WC
    filled = T_WC.copy()
    time = np.clip(np.arange(len(T_WC)), at[0], at[-1])
    if len(at) == 1:
        filled[:] = T_WC[at[0]]
        return filled
    filled[:, :3, :3] = so3.interpolate_path(at, T_WC[at, :3, :3], time)
    for axis in range(3):
        filled[:, axis, 3] = np.interp(time, at, T_WC[at, axis, 3])
    filled[at] = T_WC[at]
    return filled
