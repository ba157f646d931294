"""Loop closure: joins tracks that observe the same point of the map.

A point tracker begins a new track where a lost point comes back into view. Without loop
closure a camera that turns away and back maps the same scene twice, and the scale of
the map drifts by tens of per cent. A track whose observations in several frames agree
with the projection of an existing landmark becomes part of that landmark.

Relocalisation is the camera pose from landmarks that were mapped earlier, before the
drift.
"""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from bodyslam_jax.geometry.triangulation import triangulate
from bodyslam_jax.sfm.bundle import Scene, Views, errors, rows_by
from bodyslam_jax.sfm.multiview import refine_pose

_MIN_VIEWS, _MAX_VIEWS = 2, 8
"""Least number of registered frames in which a track is observed; largest number of
those that are tested."""
_MAX_DRIFT = 10.0
"""Largest drift of the map, in thresholds, that is searched."""
_MAX_CANDIDATE_ERROR = 2.0
"""Largest error, in thresholds, of a candidate landmark: those with little parallax
have inaccurate positions."""
_MAX_ERROR = 3.0
"""Error, in thresholds, beyond which all errors count alike in a mean."""
_MAX_JOINT_ERROR = 0.7
"""Largest mean error, in thresholds, of a point that explains two tracks."""
_MIN_RIVAL_RATIO = 1.5
"""Least ratio of the error of the second-best point to that of the best."""
Pose = tuple[np.ndarray, np.ndarray]
"""R_CW (3, 3) and the centre (3,) of a camera."""
_MIN_AGREEING_POINTS = 10
"""Least number of points that agree on a pose."""
_MIN_CHANCE_RATIO = 4.0
"""Least ratio of the points that agree to those that would by chance."""
_ANNEALED_SCALES = (6.0, 3.0, 1.5, 1.0)
"""Successive scales of the loss, in thresholds."""


class Revisits:
    """Tracks that observe the same point, and the landmark that each belongs to."""

    def __init__(self, views: Views, num_tracks: int):
        self.track = views.landmark.copy()
        """Track of each observation; `views.landmark` becomes the landmark's number."""
        self.views = views
        self.members: dict[int, list[int]] = {}
        """Tracks of each landmark that has more than one, its own number first."""
        self.refused: set[tuple[int, int]] = set()
        self._of_track = rows_by(self.track, num_tracks)

    def views_of(self, landmark: int) -> Int[np.ndarray, " m"]:
        """Returns all observations of a landmark, whatever tracks they belong to."""
        tracks = self.members.get(landmark, [landmark])
        return np.concatenate([self._of_track[t] for t in tracks])

    def find(
        self,
        scene: Scene,
        frame: int,
        observed: Int[np.ndarray, " n"],
        has_point: Bool[np.ndarray, " l"],
        registered: Bool[np.ndarray, " t"],
        threshold: float,
    ) -> tuple[list[tuple[int, int]], float]:
        """Finds pairs of landmarks (one, other) that may be the same point: `one` is
        observed in `frame`, `other` is not but projects to the same pixel.

        The second value is the drift of the map between the two, as an error at
        depth 1.

        Args:
            observed: landmarks observed in the frame.
            has_point: landmarks that are triangulated.
            registered: frames whose camera is known.
            threshold: error at depth 1 up to which an observation fits.
        """
        others = has_point.copy()
        others[observed] = False
        others = np.flatnonzero(others)
        rows = {int(i): self._some_views(int(i), registered) for i in observed}
        fresh = [i for i, r in rows.items() if len(r) >= _MIN_VIEWS]
        if not len(others) or not fresh:
            return [], 0.0
        at = [self.views_of(i) for i in fresh]
        xy = np.array([self.views.xy[r[self.views.frame[r] == frame][0]] for r in at])
        points = scene.points[others]
        pose: Pose = (scene.R_CW[frame], scene.centre[frame])
        i, j = near(points, xy, pose, _MAX_DRIFT * threshold)
        found, away = relocate(points[j], xy[i], i, pose, threshold, 1 / _MAX_DRIFT**2)
        if found is None:
            return [], 0.0
        pose = found
        i, j = near(points, xy, pose, _MAX_CANDIDATE_ERROR * threshold)
        pairs = [
            (fresh[a], int(others[b]))
            for a, b in zip(i, j, strict=True)
            if (fresh[a], int(others[b])) not in self.refused
        ]
        both = with_moved(scene, frame, pose)
        misfit = self._misfit(both, pairs, registered, threshold)
        return self._one_each(pairs, misfit), away

    def _some_views(
        self, landmark: int, registered: np.ndarray
    ) -> Int[np.ndarray, " m"]:
        """Returns up to `_MAX_VIEWS` observations, spread over
        the registered frames."""
        rows = self.views_of(landmark)
        rows = rows[registered[self.views.frame[rows]]]
        if len(rows) > _MAX_VIEWS:
            rows = rows[np.linspace(0, len(rows) - 1, _MAX_VIEWS).round().astype(int)]
        return rows

    def _misfit(
        self,
        both: Scene,
        pairs: list[tuple[int, int]],
        registered: np.ndarray,
        threshold: float,
    ) -> Float[np.ndarray, " p"]:
        """Returns the mean reprojection error of the point triangulated from both of a
        pair, for the one of the two that it fits worse; in thresholds, each error
        clipped."""
        if not pairs:
            return np.zeros(0)
        parts = [self._some_views(i, registered) for pair in pairs for i in pair]
        part = np.repeat(np.arange(len(parts)), [len(rows) for rows in parts])
        rows = np.concatenate(parts)
        # The first of a pair is observed by the moved cameras.
        frame = self.views.frame[rows] + (part % 2 == 0) * (len(both.centre) // 2)
        views = Views(frame, part // 2, self.views.xy[rows])
        points = triangulate(
            both.R_CW[views.frame],
            both.centre[views.frame],
            views.xy,
            views.landmark,
            len(pairs),
            threshold / 2,
        )
        error = errors(Scene(both.R_CW, both.centre, points), views) / threshold
        total = np.bincount(part, np.minimum(error, _MAX_ERROR), len(parts))
        mean = total / np.bincount(part, minlength=len(parts))
        return mean.reshape(-1, 2).max(axis=1)

    def _one_each(
        self, pairs: list[tuple[int, int]], misfit: np.ndarray
    ) -> list[tuple[int, int]]:
        """Returns the best pairs that are unambiguous and after which no landmark is
        observed twice in one frame."""
        rated: dict[int, list[tuple[float, int]]] = {}
        for (i, j), m in zip(pairs, misfit, strict=True):
            rated.setdefault(i, []).append((float(m), j))
        best = []
        for i, found in rated.items():
            found.sort()
            is_clear = len(found) == 1 or found[1][0] >= _MIN_RIVAL_RATIO * found[0][0]
            if found[0][0] <= _MAX_JOINT_ERROR and is_clear:
                best.append((found[0][0], i, found[0][1]))
        taken: set[int] = set()
        chosen = []
        for _, i, j in sorted(best):
            if i in taken or j in taken:
                continue
            of_i, of_j = (self.views.frame[self.views_of(k)] for k in (i, j))
            if not np.isin(of_i, of_j).any():
                taken |= {i, j}
                chosen.append((i, j))
        return chosen

    def join(self, i: int, j: int) -> Int[np.ndarray, " m"]:
        """Makes landmark `i` part of `j`; returns the observations that changed."""
        rows = self.views_of(i)
        self.members[j] = self.members.get(j, [j]) + self.members.pop(i, [i])
        self.views.landmark[rows] = j
        return rows

    def part(self, error: Float[np.ndarray, " m"]) -> list[int]:
        """Separates joined tracks again whose reprojection error is too large, and
        returns them: they are landmarks of their own again.

        Args:
            error: reprojection error of each observation, in thresholds; NaN where it
                has none.
        """
        loose = []
        for landmark, tracks in list(self.members.items()):
            for track in tracks[1:]:
                rows = self._of_track[track]
                found = np.minimum(error[rows], _MAX_ERROR)
                found = found[~np.isnan(found)]
                if len(found) and found.mean() > _MAX_JOINT_ERROR:
                    tracks.remove(track)
                    self.views.landmark[self._of_track[track]] = track
                    self.refused.add((track, landmark))
                    loose.append(track)
            if len(tracks) == 1:
                del self.members[landmark]
        return loose


def near(
    points: Float[np.ndarray, "p 3"],
    xy: Float[np.ndarray, "n 2"],
    pose: Pose,
    radius: float,
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """Returns pairs of rows of `xy` and of projected `points` within `radius` of each
    other in the image at depth 1."""
    R, centre = pose
    p_C = (points - centre) @ R.T
    front = np.flatnonzero(p_C[:, 2] > 1e-6)
    if not len(front):
        return np.zeros(0, int), np.zeros(0, int)
    tree = KDTree(p_C[front, :2] / p_C[front, 2:])
    found = tree.query_ball_point(xy, radius)
    i = np.repeat(np.arange(len(xy)), [len(n) for n in found])
    return i, front[np.concatenate([np.asarray(n, int) for n in found])]


def relocate(
    points: Float[np.ndarray, "k 3"],
    xy: Float[np.ndarray, "k 2"],
    which: Int[np.ndarray, " k"],
    pose: Pose,
    threshold: float,
    share: float,
) -> tuple[Pose | None, float]:
    """Returns the camera pose from `points`, `None` if too few agree, and the drift
    from `pose`: the median shift of the points that agree, at depth 1.

    Most of the pairs may be wrong matches; only correct ones agree on a pose.

    Args:
        which: index of the image point of each row; several rows may share one.
        share: share of wrong pairs that agree by chance.
    """
    least = max(_MIN_AGREEING_POINTS, _MIN_CHANCE_RATIO * share * len(xy))
    agree = lambda projected: len(
        np.unique(which[np.linalg.norm(projected - xy, axis=-1) < threshold])
    )
    before = _project(points, pose)
    R, centre = pose
    # Where the map has hardly drifted, the wide losses are skipped.
    for scale in _ANNEALED_SCALES[2 if agree(before) > least else 0 :]:
        found = refine_pose(R, centre, points, xy, scale * threshold)
        if found is None:
            return None, 0.0
        R, centre, _ = found
    after = _project(points, (R, centre))
    if agree(after) <= least:
        return None, 0.0
    fits = np.linalg.norm(after - xy, axis=-1) < threshold
    away = np.linalg.norm(after - before, axis=-1)[fits]
    return (R, centre), float(np.median(away))


def _project(points: np.ndarray, pose: Pose) -> np.ndarray:
    p_C = (points - pose[1]) @ pose[0].T
    return p_C[:, :2] / np.where(p_C[:, 2] > 1e-6, p_C[:, 2], 1e-6)[:, None]


def with_moved(scene: Scene, frame: int, pose: Pose) -> Scene:
    """Returns all cameras, followed by copies that are moved by the rigid transform
    from camera `frame` to `pose`."""
    R, centre = pose
    turn = R.T @ scene.R_CW[frame]
    R_CW = scene.R_CW @ turn.T
    moved = (scene.centre - scene.centre[frame]) @ turn.T + centre
    return Scene(
        np.concatenate([scene.R_CW, R_CW]),
        np.concatenate([scene.centre, moved]),
        scene.points,
    )
