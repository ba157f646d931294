"""Locates the camera of a running video in its maps, and passes frames to the window.

A map begins where two views have parallax. If none do for a while, the camera is fixed:
it is assumed to stand still or to turn (`sfm.live_turning`). Its poses are then held
while people are estimated, as offline, and a map begins as soon as the camera moves. A
lost camera is relocalised in its map, or begins another one.
"""

import dataclasses
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np

from bodyslam_jax.body import BodyModel
from bodyslam_jax.config import FOCAL_SIGMA, Config
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.graph import CHUNK
from bodyslam_jax.online.bodies import LiveBodies
from bodyslam_jax.online.estimate import World
from bodyslam_jax.online.loops import Correction, Loops
from bodyslam_jax.online.record import Counts, Record, Seen
from bodyslam_jax.online.slots import Slots
from bodyslam_jax.online.window import Solved, Window
from bodyslam_jax.online.window_content import FRAMES, Measured
from bodyslam_jax.sfm.live_map import LiveMap
from bodyslam_jax.sfm.live_tracks import PointFollower
from bodyslam_jax.sfm.live_turning import TurningCamera
from bodyslam_jax.types import Intrinsics

_MAX_WINDOW_RATE = 10.0
"""Largest rate of the window's frames, 1/s: what two cores solve while the video runs
(`benchmarks/online.md`)."""
MAX_START_S = 3.0
"""Time without parallax after which the camera is fixed, s. On the twenty simulated
sequences, whose cameras move, a map begins within 0.2 to 1.9 s."""
_FIXED_RETRY_S = 1.0
"""Time until the next attempt where the points do not fit a fixed camera, s."""
_MIN_FIXED_SHARE = 0.5
"""Least share of the waiting frames that a fixed camera must locate."""
_MAP_ATTEMPT_INTERVAL = 3
"""Frames between two attempts to begin a map while the camera is fixed."""
_KEYFRAME_INTERVAL_S = 2.0
"""Time between two keyframes that are kept for relocalisation, s."""
_RELOCALISATION_INTERVAL = 3
"""Frames between two attempts to relocalise a lost camera."""
_MAX_LOST_S = 2.0
"""Time after which a lost camera that sees points begins a new map, s."""
_MAX_REST_S = 1.0
"""Longest time that the window rests, s. Once the scale is known it rests as long as
it took, by the time of the video, which leaves one and a half of two cores to frames.
"""
_MAX_WAITING_FRAMES = 10 * CHUNK
"""Largest number of frames that wait for the window when it begins with them. Of more
frames it takes the newest, and the others keep the cameras that the map located."""
_NUM_NEWEST_FRAMES = 2 * CHUNK
"""Number of frames that the window takes then."""
TWO_MAPS = (
    "the camera was lost and a new map began: the way between the two maps is not known"
)
NO_POINTS = (
    "no parallax, and too few points to tell whether the camera stands still: nobody "
    "is in the result before it moves; --static-camera says that it stands still"
)
LITTLE_PARALLAX = (
    "the camera moves, and so far too little for a map: nobody is in the result before "
    "one begins"
)
_NUM_RELOCALISATION_POINTS = 100
"""Number of points with which a camera resumes tracking after it was lost."""


@dataclasses.dataclass
class _Waiting:
    """A frame with which a map may begin."""

    time: float
    people: dict[int, np.ndarray] | None
    """Keypoints by person; `None` if nobody was looked for."""
    ids: np.ndarray
    uv: np.ndarray
    T_WC: np.ndarray | None = None
    """Pose that the fixed camera has in it, if it was located."""


class Maps:
    """The successive maps of the camera, and the window over the current one."""

    intrinsics: Intrinsics | None
    follower: PointFollower
    window: Window
    map: LiveMap | TurningCamera
    sought: LiveMap | None
    """The map that has not begun yet: the first, or the next of a fixed camera."""

    def __init__(
        self, config: Config, body: BodyModel, fps: float, places: int, threads: bool
    ) -> None:
        self.config, self.body, self.fps, self.places = config, body, fps, places
        self.stride = max(1, round(fps / _MAX_WINDOW_RATE))
        self.step = self.stride / fps
        self.pool = ThreadPoolExecutor(1) if threads else None
        self.job: Future[tuple[list[Solved], Correction | None]] | None = None
        self.now = self.submitted = self.rested = -np.inf
        """Times of the frame that is processed, of that with which the window began,
        and from which it may begin again, s."""
        self.bodies = LiveBodies(config, body, fps, spared_cores=int(threads))
        self.counts, self.record = Counts(), Record()
        self.warnings: dict[str, None] = {}
        self.seconds: dict[str, float] = {}
        self.number = -1
        """Number of the current map."""
        self.origin = 0.0
        """Time of the first frame, s."""
        self.keeps_points = False
        """True if the points of all frames are recorded, for `smooth`."""

    # Maps begin and end.

    def _begin(self, intrinsics: Intrinsics) -> None:
        """Sets up tracks, window and first map before the first frame."""
        self.follower = PointFollower(intrinsics, self.config.tracking.num_points)
        given = self.body, self.config, 1 / self.step, self.places
        self.window = Window(intrinsics, *given)
        self._no_map(intrinsics)

    def _no_map(self, intrinsics: Intrinsics) -> None:
        """Starts in a world without a map, and waits for one to begin."""
        self.intrinsics = intrinsics
        error = intrinsics.focal_sigma, intrinsics.params[0]
        relative = FOCAL_SIGMA if error[0] is None else error[0] / error[1]
        if intrinsics.is_guess:
            relative = self.config.structure.focal_sigma
        self.map = self.sought = LiveMap(intrinsics, float(relative))
        self.world = World()
        self.fixed_at: float | None = None
        """Time at which the camera is fixed if no map has begun, s; `None` before the
        first frame."""
        self.waiting: deque[_Waiting]
        self.waiting = deque(maxlen=(FRAMES - CHUNK) * self.stride)
        self._next_map()
        if self.config.static_camera:
            self.sought = None
            self.map = TurningCamera(intrinsics, still=True)
            self._hold()

    def _next_map(self) -> None:
        """Counts a new map, and resets what belongs to one."""
        self.number += 1
        self.slots = Slots(self.step, self.origin)
        assert self.intrinsics is not None
        self.loops = Loops(self.intrinsics)
        self.lost_since: float | None = None
        self.last_place = -np.inf
        self.solved: Solved | None = None

    def _hold(self) -> None:
        """Holds the poses of the fixed camera in the window."""
        assert isinstance(self.map, TurningCamera)
        self.window.fixed = True
        self.record.fixed[self.number] = self.map.kind

    def _new_map(self) -> None:
        """Ends a map in which the camera is lost, and waits for another one."""
        self.warnings[TWO_MAPS] = None
        self._end_map()
        self.window.restart()
        assert self.intrinsics is not None
        self._no_map(self.intrinsics)

    def _begin_map(self, poses: list[np.ndarray | None]) -> None:
        """Begins the map that was sought, with all waiting frames and their poses."""
        rows, scene = list(self.waiting), self.sought
        poses = poses[-len(rows) :]
        assert scene is not None
        if isinstance(self.map, TurningCamera):
            both = [
                k
                for k, row in enumerate(rows[:-1])
                if row.T_WC is not None and poses[k] is not None
            ]
            first = both[0] if both else len(rows) - 1
            self._leave_fixed(rows, poses, first)
            rows, poses = rows[first:], poses[first:]
        else:
            # All but the last one were recorded without a pose.
            frames = self.record.frames
            del frames[len(frames) - len(rows) + 1 :]
        self.map, self.sought = scene, None
        self.warnings.pop(LITTLE_PARALLAX, None)
        for row, pose in zip(rows, poses, strict=True):
            row.T_WC = pose
            self._take(row)
        self.waiting.clear()

    def _leave_fixed(
        self, rows: list[_Waiting], poses: list[np.ndarray | None], first: int
    ) -> None:
        """Ends the frames of the fixed camera at row `first`, where its map begins, and
        moves that map and its `poses` to the world of these frames."""
        assert self.sought is not None
        pose, before = poses[first], rows[first].T_WC
        self._end_map()
        frames = len(rows) - 1 - first
        if frames and pose is not None and before is not None:
            self.record.join(self.number + 1, frames)
            move = before @ np.linalg.inv(pose)
            self.sought.corrected(move, {})
            poses[:] = [None if T is None else move @ T for T in poses]
            if all(seen.map != self.number for seen in self.record.frames):
                self._forget_fixed()
            self.world.next_map()
        else:
            self.warnings[TWO_MAPS] = None
            self.world = World()
        if self.number in self.record.fixed:
            now, since = rows[-1].time, rows[first].time
            line = f"the camera moved (at {now:.1f} s): a map begins at {since:.1f} s"
            if self.intrinsics is not None and self.intrinsics.is_guess:
                line += "; or it turned, and the guessed focal length is wrong"
            self.warnings[line] = None
        self.window.restart()
        self._next_map()

    def _forget_fixed(self) -> None:
        """Removes the fixed camera from record and warnings, as it had always moved."""
        del self.record.fixed[self.number]
        self.warnings.pop(self.said, None)

    def _begin_fixed(self, timestamp: float) -> bool:
        """Begins with a fixed camera at the waiting frames, and returns true; false if
        their points show that it moves, or do not fit one."""
        assert self.intrinsics is not None and self.sought is not None
        self.sought.forwards = self.sought.moving
        if self.sought.moving:
            self.warnings[LITTLE_PARALLAX] = None
            self.fixed_at = timestamp + _FIXED_RETRY_S
            return False
        self.warnings.pop(LITTLE_PARALLAX, None)
        camera = TurningCamera(self.intrinsics)
        rows = list(self.waiting)
        for row in rows:
            row.T_WC = camera.locate(row.ids, row.uv)
        located = np.array([row.T_WC is not None for row in rows])
        if located.mean() < _MIN_FIXED_SHARE or not located[-1]:
            self.warnings[NO_POINTS] = None
            self.fixed_at = timestamp + _FIXED_RETRY_S
            return False
        self.warnings.pop(NO_POINTS, None)
        frames = self.record.frames
        del frames[len(frames) - len(rows) + 1 :]
        self.map = camera
        self._hold()
        self.said = (
            f"the camera showed no parallax for {MAX_START_S:.0f} s "
            f"(at {timestamp:.1f} s): it is taken to "
            + ("turn" if camera.turns else "stand still")
            + ", and metres come from people's sizes alone until it moves"
        )
        self.warnings[self.said] = None
        for row in rows:
            self._take(row)
        return True

    # Every frame.

    def _locate(
        self,
        timestamp: float,
        gray: np.ndarray | None,
        ids: np.ndarray,
        uv: np.ndarray,
        people: dict[int, np.ndarray] | None,
    ) -> str:
        """Locates the camera and passes frames to the window; returns the status.

        `people` is `None` in a frame in which nobody was looked for.
        """
        row = _Waiting(timestamp, people, ids, uv)
        if self.sought is not None:
            self.waiting.append(row)
            poses = self._seek(ids, uv)
            if poses is not None:
                self._begin_map(poses)
                return "tracking"
            if not isinstance(self.map, TurningCamera):
                if self.fixed_at is None:
                    self.fixed_at = timestamp + MAX_START_S
                if timestamp >= self.fixed_at and self._begin_fixed(timestamp):
                    return "fixed"
                self._note_frame(row, -1, np.eye(4))
                return "starting"
        T_WC = self.map.locate(ids, uv)
        if T_WC is None:
            T_WC = self._find_again(gray)
        row.T_WC = T_WC
        if T_WC is None:
            self._take(row)
            if self.lost_since is None:
                self.lost_since = timestamp
                self.counts.lost += 1
            away = timestamp - self.lost_since
            if away > _MAX_LOST_S and len(ids) >= _NUM_RELOCALISATION_POINTS // 2:
                self._new_map()
                return "starting"
            return "lost"
        self.lost_since = None
        self._take(row)
        if gray is not None and timestamp - self.last_place >= _KEYFRAME_INTERVAL_S:
            place = self.follower.describe(self.map.points, T_WC)
            if place is not None:
                last = self.record.frames[-1]
                self.loops.add(place, timestamp, last.slot, last.since, T_WC)
            self.last_place = timestamp
        if isinstance(self.map, TurningCamera):
            self.record.fixed[self.number] = self.map.kind
            return "fixed"
        return "tracking"

    def _seek(self, ids: np.ndarray, uv: np.ndarray) -> list[np.ndarray | None] | None:
        """Adds a frame to the map that is sought, and returns the poses of all waiting
        frames if it begins; else `None`."""
        assert self.sought is not None
        turning = isinstance(self.map, TurningCamera)
        if not len(ids) or (turning and self.counts.frames % _MAP_ATTEMPT_INTERVAL):
            self.sought.wait(ids, uv)
            return None
        return self.sought.begin(ids, uv)

    def _find_again(self, gray: np.ndarray | None) -> np.ndarray | None:
        """Returns the camera's pose by relocalisation, and adds points to be tracked;
        `None` if it fails."""
        if gray is None or self.lost_since is None:
            return None
        if self.counts.frames % _RELOCALISATION_INTERVAL:
            return None
        found = self.follower.recognise(gray, self.loops.places)
        if found is None:
            return None
        place, points, uv = found
        points = self.loops.placed(place, points)
        T_WC = self.map.relocated(points, uv)
        if T_WC is None:
            return None
        ids = self.follower.add(uv[:_NUM_RELOCALISATION_POINTS])
        self.map.points.update(zip(ids.tolist(), points, strict=False))
        self.counts.relocated += 1
        return T_WC

    def _take(self, row: _Waiting) -> None:
        """Adds a frame to the record, and one at a time of the window to the window."""
        located = row.T_WC is not None
        here = self.map.T_WC if row.T_WC is None else row.T_WC
        people = row.people or {}
        measured = Measured(row.time, here, located, row.ids, row.uv, people)
        slot, since, stood = self.slots.take(measured)
        if stood:
            self.warnings[f"no frame came for {stood:.0f} s"] = None
        self._note_frame(row, slot, since)

    def _note_frame(self, row: _Waiting, slot: int, since: np.ndarray) -> None:
        number = self.number if slot >= 0 else -1
        kept = {p: np.asarray(x, np.float32) for p, x in (row.people or {}).items()}
        points = None
        if self.keeps_points:
            points = np.array(row.ids, np.int32), np.array(row.uv, np.float32)
        located, looked = row.T_WC is not None, row.people is not None
        given = row.time, number, slot, since, located, kept, points, looked
        self.record.frames.append(Seen(*given))

    # The window.

    def _submit(self, flush: bool) -> None:
        """Passes the waiting frames to the window, if it is idle and rested."""
        if self.job is not None or (self.now < self.rested and not flush):
            return
        if flush:
            self.slots.fill(self.map.T_WC)
        count = len(self.slots.waiting) // CHUNK * CHUNK
        if count > _MAX_WAITING_FRAMES and not flush:
            for slot, measured in self.slots.pop(count - _NUM_NEWEST_FRAMES):
                self.record.pass_over(self.number, slot, measured)
                self.counts.skipped += measured.located
            self.window.skip(count - _NUM_NEWEST_FRAMES)
            count = _NUM_NEWEST_FRAMES
        if not count:
            return
        frames = [measured for _, measured in self.slots.pop(count)]
        self.submitted = self.now
        if self.pool is not None:
            self.job = self.pool.submit(self._advance, frames)
        else:
            self.job = Future()
            self.job.set_result(self._advance(frames))
            self._collect(wait=True)

    def _advance(
        self, frames: list[Measured]
    ) -> tuple[list[Solved], Correction | None]:
        windows = self.window.advance(frames)
        return windows, self.loops.close(windows)

    def _collect(self, wait: bool) -> None:
        """Takes over the solution of the window, and of the loops, if it is ready."""
        if self.job is None or not (wait or self.job.done()):
            return
        windows, correction = self.job.result()
        self.job = None
        if np.isfinite(windows[-1].scale_sigma):
            took = self.now - self.submitted
            self.rested = self.now + min(took, _MAX_REST_S)
        unit = self.loops.correction.unit
        if correction is not None:
            self.loops.correction = correction
            self.record.corrections[self.number] = correction
            self.window.follow(correction.unit / unit)
        for solved in windows:
            self.solved = self.loops.correction.of(solved, unit)
            self.record.keep(self.number, solved, self.solved)
            self.world.learn(self.solved, self.body)
            for name, value in solved.seconds.items():
                self.seconds[name] = self.seconds.get(name, 0.0) + value
        solved = windows[-1]
        first = solved.first
        located = np.flatnonzero(solved.located[CHUNK:])
        if len(located) and isinstance(self.map, LiveMap):
            k = CHUNK + int(located[-1])
            before, after = self.slots.front[first + k], solved.T_WC[k]
            move = after @ np.linalg.inv(before)
            move[:3, :3] = so3.nearest(move[:3, :3])
            self.map.corrected(move, solved.landmarks)
            self.slots.move(move)
            self.map.forget(self.follower.ids)
        # A window that comes later begins no earlier.
        self.slots.forget(first + CHUNK)
        self.bodies.learn(solved, self.record.shapes)

    def _end_map(self) -> None:
        """Solves all waiting frames."""
        self._collect(wait=True)
        while self.slots.waiting or self.job is not None:
            self._submit(flush=True)
            self._collect(wait=True)
