"""`Online`: an estimate after every frame, and the usual result at the end.

The thread that calls `update` follows points, locates the camera and filters people; a
second one solves windows. The first never waits for the second: it passes on frames of
the window ten at a time, and takes over the solution of the last window once it is
ready (`docs/live.md`).
"""

import dataclasses
import logging
import time
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from bodyslam_jax.body import load_body_model
from bodyslam_jax.config import Config
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.graph import CHUNK
from bodyslam_jax.io.camera.calibration import guess_camera, project_points, with_focal
from bodyslam_jax.online.bodies import LiveBodies
from bodyslam_jax.online.estimate import (
    Estimate,
    PersonEstimate,
    World,
    placed,
)
from bodyslam_jax.online.prepare import compile_all
from bodyslam_jax.online.record import Counts, Record, Seen, parts_of
from bodyslam_jax.online.slots import Slots
from bodyslam_jax.online.window import Solved, Window
from bodyslam_jax.online.window_content import FRAMES, Measured
from bodyslam_jax.pipeline.run import assemble
from bodyslam_jax.sfm.live_map import LiveMap
from bodyslam_jax.sfm.live_tracks import PointFollower
from bodyslam_jax.types import Intrinsics, Result, Sequence, SfmResult

log = logging.getLogger(__name__)

_MAX_WINDOW_RATE = 10.0
"""Largest rate of the window's frames, 1/s: what two cores solve while the video runs
(`benchmarks/online.md`)."""
_KEYFRAME_INTERVAL_S = 2.0
"""Time between two keyframes that are kept for relocalisation, s."""
_RELOCALISATION_INTERVAL = 3
"""Frames between two attempts to relocalise a lost camera."""
_MAX_LOST_S = 2.0
"""Time after which a lost camera that sees points begins a new map, s."""
_MAX_WAITING_FRAMES = 10 * CHUNK
"""Largest number of frames that wait for the window when it begins with them. Of more
frames it takes the newest, and the others keep the cameras that the map located."""
_NUM_NEWEST_FRAMES = 2 * CHUNK
"""Number of frames that the window takes then."""
_TWO_MAPS = (
    "the camera was lost and a new map began: the way between the two maps is not known"
)
_NUM_RELOCALISATION_POINTS = 100
"""Number of points with which a camera resumes tracking after it was lost."""


class Online:
    """The estimate while a video runs; its memory is that of a window and of a record
    of poses.

    One object is for one video. `update` and `finish` are called by one thread.
    """

    def __init__(
        self,
        config: Config = Config(),
        *,
        intrinsics: Intrinsics | None = None,
        fps: float = 30.0,
        places: int = 1,
        threads: bool = True,
        name: str = "live",
    ) -> None:
        """
        **Arguments:**

        - `intrinsics`: of the camera; without them the focal length is that of
            `config`, or else a guess, which is not refined and said in every estimate.
        - `fps`: about how many frames come in a second.
        - `places`: people who are in the window at once; others are filtered only.
        - `threads`: whether windows are solved beside `update`; without it they are
            solved in it, so that the same frames give the same estimates.
        - `name`: of the video, for the summary.

        **Raises:** `InputError` if the body model or the motion model cannot be read.
        """
        if not fps > 0:
            raise InputError(f"fps: found {fps}, expected more than 0.")
        if places < 1:
            raise InputError(f"places: found {places}, expected 1 or more.")
        self.config, self.fps, self.places, self.name = config, fps, places, name
        self.body = load_body_model(config.body_model)
        self.intrinsics = intrinsics
        self.stride = max(1, round(fps / _MAX_WINDOW_RATE))
        self.step = self.stride / fps
        self.pool = ThreadPoolExecutor(1) if threads else None
        self.job: Future[list[Solved]] | None = None
        self.bodies = LiveBodies(config, self.body, fps)
        self.counts, self.record = Counts(), Record()
        self.latest: Estimate | None = None
        self.started = self.prepared = False
        self.done = False
        self.warnings: dict[str, None] = {}
        self.seconds: dict[str, float] = {}
        self.number = -1
        """Number of the current map."""
        self.video: Path | None = None
        """The file that the frames are of, for the result's pictures."""
        self.picks: list[int] = []
        """Indices of the frames in that file."""
        self.inputs: tuple[Sequence, SfmResult]
        """What the result was made of, after `finish`."""

    def prepare(self, size: tuple[int, int] | None = None) -> None:
        """Compiles all programs, or loads them from JAX's cache, on a synthetic scene,
        so that no frame has to wait for it. The first `update` does it if it has not
        been done.

        **Arguments:** `size`: width and height of the images (px), from which the
        intrinsics are guessed if none were given.

        **Raises:** `InputError` if neither is known.
        """
        if self.prepared:
            return
        if self.intrinsics is None:
            if size is None:
                raise InputError("prepare: found neither intrinsics nor a size.")
            self.intrinsics = self._guess(*size)
        if self.config.people and self.config.detect != "none":
            self.bodies.found.load_networks()
        given = self.intrinsics, self.body, self.config
        rates = {"fps": self.fps, "step": self.step}
        compile_all(*given, **rates, places=self.places)
        self.prepared = True

    # Every frame.

    def update(
        self,
        image: UInt8[np.ndarray, "y x 3"] | None,
        timestamp: float,
        keypoints: Float[np.ndarray, "p 25 3"] | None = None,
        *,
        points: tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 2"]] | None = None,
    ) -> Estimate:
        """Processes the next frame and returns the estimate after it.

        **Arguments:**

        - `image`: BGR; `None` where keypoints and points are given.
        - `timestamp`: s; frames whose time is not after the last one's are not used.
        - `keypoints`: of the people in the image, in any order (u px, v px,
            confidence), BODY_25; without them they are found by the networks that ship.
        - `points`: numbers and pixels of points of the scene that were followed
            elsewhere; without them they are followed in the image.

        **Raises:** `InputError` if something is missing, or after `finish`.
        """
        begun = time.perf_counter()
        if self.done:
            raise InputError("update: the estimate is finished.")
        if self.latest is not None and timestamp <= self.latest.timestamp:
            self.counts.late += 1
            return dataclasses.replace(
                self.latest, status="late", latency=time.perf_counter() - begun
            )
        if not self.started:
            self._start(image)
        assert self.intrinsics is not None
        if image is None and points is None:
            raise InputError("update: found neither an image nor points.")
        people = self.bodies.find(image, keypoints)
        gray = None if image is None else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        if points is None:
            assert gray is not None
            points = self.follower.advance(
                gray, self.bodies.mask(people, self.intrinsics)
            )
        self._collect(wait=False)
        status = self._locate(timestamp, gray, *points, people)
        shapes = self.record.shapes
        bodies = self.bodies.follow(timestamp, people, self.intrinsics, shapes)
        self._submit(flush=False)
        self.counts.frames += 1
        self.latest = self._estimate(timestamp, status, bodies)
        elapsed = time.perf_counter() - begun
        self.latest = dataclasses.replace(self.latest, latency=elapsed)
        return self.latest

    def finish(self) -> Result:
        """Solves the remaining frames of the window and returns the result of all
        frames, as an offline run has it: metric, y up, with its summary.

        **Raises:** `InputError` if fewer than three frames were used.
        """
        if self.counts.frames < 3:
            raise InputError(f"{self.name}: {self.counts.frames} frames, expected 3.")
        self.done = True
        self._collect(wait=True)
        self._end_map()
        if self.pool is not None:
            self.pool.shutdown()
        self.record.pixel_sigma = self.window.pixel_sigma
        assert self.intrinsics is not None
        measured, cameras, joint = parts_of(
            self.record,
            self.intrinsics,
            self.name,
            1 / self.step,
            (*self.warnings, *self.counts.notes()),
        )
        if _TWO_MAPS in self.warnings:
            measured = dataclasses.replace(measured, contradictions=(_TWO_MAPS,))
        if self.video is not None:
            picks = np.array(self.picks, int)
            measured = dataclasses.replace(measured, frames=self.video, picks=picks)
        self.inputs = measured, cameras
        seconds = {k: round(v, 2) for k, v in self.seconds.items()}
        given = self.config, self.body, cameras, joint, seconds
        return assemble(measured, *given)

    def warn(self, note: str) -> None:
        """Adds a line to the notes of all further estimates and of the result."""
        self.warnings[note] = None

    @property
    def points(self) -> Float[np.ndarray, "n 2"]:
        """Returns the points that are tracked in the last image, px."""
        return self.follower.uv if self.started else np.zeros((0, 2))

    def drawn(
        self, estimate: Estimate
    ) -> list[tuple[int, Float[np.ndarray, "24 2"], Float[np.ndarray, "24 3"]]]:
        """Returns number, joints in the image (px) and joints in the world (m) of the
        people of an estimate."""
        assert self.intrinsics is not None
        found = []
        for one in estimate.people:
            T_CW = np.linalg.inv(estimate.T_WC)
            p_C = one.joints @ T_CW[:3, :3].T + T_CW[:3, 3]
            p_C[:, 2] = np.maximum(p_C[:, 2], 0.05)
            found.append((one.person, project_points(self.intrinsics, p_C), one.joints))
        return found

    # Parts of a frame.

    def _start(self, image: np.ndarray | None) -> None:
        if self.intrinsics is None:
            if image is None:
                raise InputError("intrinsics: found none, nor an image to guess from.")
            self.intrinsics = self._guess(image.shape[1], image.shape[0])
        self.follower = PointFollower(self.intrinsics, self.config.tracking.num_points)
        self.prepare()
        given = self.intrinsics, self.body, self.config
        self.window = Window(*given, 1 / self.step, self.places)
        self._begin_map()
        self.started = True

    def _guess(self, width: int, height: int) -> Intrinsics:
        known = self.config.focal_length(width)
        guess = guess_camera(width, height)
        if known is not None:
            return with_focal(guess, known.value, known.sigma)
        note = (
            f"the focal length is a guess ({guess.params[0]:.0f} px) and is not "
            "refined: distances are off by its error; give --camera or --focal"
        )
        self.warnings[note] = None
        return guess

    def _begin_map(self) -> None:
        assert self.intrinsics is not None
        self.map = LiveMap(self.intrinsics)
        self.world = World()
        self.number += 1
        self.waiting: deque[tuple[float, dict[int, np.ndarray], np.ndarray, np.ndarray]]
        self.waiting = deque(maxlen=(FRAMES - CHUNK) * self.stride)
        self.slots = Slots(self.step)
        self.lost_since: float | None = None
        self.last_place = -np.inf
        self.solved: Solved | None = None

    def _locate(
        self,
        timestamp: float,
        gray: np.ndarray | None,
        ids: np.ndarray,
        uv: np.ndarray,
        people: dict[int, np.ndarray],
    ) -> str:
        """Locates the camera and passes frames to the window; returns the status."""
        if not self.map.begun:
            self.waiting.append((timestamp, people, ids, uv))
            poses = self.map.begin(ids, uv) if len(ids) else None
            if poses is None:
                self._note_frame(timestamp, -1, np.eye(4), False, people)
                return "starting"
            self._feed_waiting(poses)
            return "tracking"
        T_WC = self.map.locate(ids, uv)
        if T_WC is None:
            T_WC = self._find_again(timestamp, gray)
        if T_WC is None:
            self._take(timestamp, None, ids, uv, people)
            if self.lost_since is None:
                self.lost_since = timestamp
                self.counts.lost += 1
            away = timestamp - self.lost_since
            if away > _MAX_LOST_S and len(ids) >= _NUM_RELOCALISATION_POINTS // 2:
                self._new_map()
                return "starting"
            return "lost"
        self.lost_since = None
        self._take(timestamp, T_WC, ids, uv, people)
        if gray is not None and timestamp - self.last_place >= _KEYFRAME_INTERVAL_S:
            self.follower.remember(self.map.points)
            self.last_place = timestamp
        return "tracking"

    def _find_again(
        self, timestamp: float, gray: np.ndarray | None
    ) -> np.ndarray | None:
        """Returns the camera's pose by relocalisation, and adds points to be tracked;
        `None` if it fails."""
        if gray is None or self.lost_since is None:
            return None
        if self.counts.frames % _RELOCALISATION_INTERVAL:
            return None
        found = self.follower.recognise(gray)
        if found is None:
            return None
        points, uv = found
        T_WC = self.map.relocated(points, uv)
        if T_WC is None:
            return None
        ids = self.follower.add(uv[:_NUM_RELOCALISATION_POINTS])
        self.map.points.update(zip(ids.tolist(), points, strict=False))
        self.counts.relocated += 1
        return T_WC

    def _new_map(self) -> None:
        """Ends a map in which the camera is lost, and waits for another one."""
        self.warnings[_TWO_MAPS] = None
        self._collect(wait=True)
        self._end_map()
        self.window.restart()
        self.follower.places.clear()
        self._begin_map()

    def _feed_waiting(self, poses: list[np.ndarray | None]) -> None:
        """Adds the frames that came before the map, each once; they were recorded
        without a pose."""
        rows = list(self.waiting)
        del self.record.frames[len(self.record.frames) - len(rows) + 1 :]
        for row, pose in zip(rows, poses[-len(rows) :], strict=True):
            timestamp, people, ids, uv = row
            self._take(timestamp, pose, ids, uv, people)
        self.waiting.clear()

    def _take(
        self,
        timestamp: float,
        T_WC: np.ndarray | None,
        ids: np.ndarray,
        uv: np.ndarray,
        people: dict[int, np.ndarray],
    ) -> None:
        """Adds a frame to the record, and one at a time of the window to the window."""
        located = T_WC is not None
        here = self.map.T_WC if T_WC is None else T_WC
        measured = Measured(timestamp, here, located, ids, uv, people)
        slot, since, stood = self.slots.take(measured)
        if stood:
            self.warnings[f"no frame came for {stood:.0f} s"] = None
        self._note_frame(timestamp, slot, since, located, people)

    def _note_frame(
        self,
        timestamp: float,
        slot: int,
        since: np.ndarray,
        located: bool,
        people: dict[int, np.ndarray],
    ) -> None:
        number = self.number if slot >= 0 else -1
        kept = {p: np.asarray(x, np.float32) for p, x in people.items()}
        self.record.frames.append(Seen(timestamp, number, slot, since, located, kept))

    def _shape(self, person: int) -> np.ndarray:
        return self.record.shapes.get(person, np.zeros(10))

    def _estimate(
        self,
        timestamp: float,
        status: str,
        bodies: dict[int, tuple[np.ndarray, np.ndarray]],
    ) -> Estimate:
        T_WC = self.world.camera(self.map.T_WC)
        people: list[PersonEstimate] = []
        for person, (T_CH, pose) in sorted(bodies.items()):
            given = T_CH, pose, self._shape(person), self.body
            people.append(
                placed(person, T_WC, *given, self.bodies.contacts.get(person))
            )
        nan = float("nan")
        scale = sigma = nan
        if self.solved is not None and np.isfinite(self.solved.scale_sigma):
            scale, sigma = self.solved.scale, self.solved.scale_sigma
        notes = list(self.warnings)
        if np.isnan(sigma):
            notes.append("scale unknown: nobody has told it yet")
        return Estimate(
            frame=self.counts.frames - 1,
            timestamp=timestamp,
            T_WC=T_WC,
            located=status == "tracking",
            people=tuple(people),
            scale=scale,
            scale_sigma=sigma,
            status=status,
            notes=tuple(notes),
            latency=0.0,
        )

    # The window.

    def _submit(self, flush: bool) -> None:
        """Passes the waiting frames to the window, if it is idle."""
        if self.job is not None:
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
        if self.pool is not None:
            self.job = self.pool.submit(self.window.advance, frames)
        else:
            self.job = Future()
            self.job.set_result(self.window.advance(frames))
            self._collect(wait=True)

    def _collect(self, wait: bool) -> None:
        """Takes over the solution of the window, if it is ready."""
        if self.job is None or not (wait or self.job.done()):
            return
        windows = self.job.result()
        self.job = None
        for solved in windows:
            self.record.keep(self.number, solved)
            self.world.learn(solved, self.body)
            for name, value in solved.seconds.items():
                self.seconds[name] = self.seconds.get(name, 0.0) + value
        solved = windows[-1]
        first = solved.first
        located = np.flatnonzero(solved.located[CHUNK:])
        if len(located):
            k = CHUNK + int(located[-1])
            before, after = self.slots.front[first + k], solved.T_WC[k]
            move = after @ np.linalg.inv(before)
            move[:3, :3] = so3.nearest(move[:3, :3])
            self.map.corrected(move, solved.landmarks)
            self.slots.move(move)
            places = [p.moved(move) for p in self.follower.places]
            self.follower.places = deque(places, maxlen=self.follower.places.maxlen)
        # A window that comes later begins no earlier.
        self.slots.forget(first + CHUNK)
        self.map.forget(self.follower.ids)
        self.bodies.learn(solved, self.record.shapes)
        self.solved = solved

    def _end_map(self) -> None:
        """Solves all waiting frames."""
        while self.slots.waiting or self.job is not None:
            self._submit(flush=True)
            self._collect(wait=True)
