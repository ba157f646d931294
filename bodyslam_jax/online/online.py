"""`Online`: an estimate after every frame, and the usual result at the end.

The thread that calls `update` follows points, locates the camera and filters people; a
second one solves windows. The first waits for the second only where a map ends: it
passes on frames of the window ten at a time, and takes over the solution of the last
window once it is ready (`docs/live.md`).
"""

import dataclasses
import time
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from bodyslam_jax.body import load_body_model
from bodyslam_jax.config import Config
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io.camera.calibration import guess_camera, project_points, with_focal
from bodyslam_jax.online.estimate import Estimate, PersonEstimate, placed
from bodyslam_jax.online.maps import TWO_MAPS, Maps
from bodyslam_jax.online.prepare import compile_all
from bodyslam_jax.online.record import parts_of
from bodyslam_jax.pipeline.run import assemble, run_stages
from bodyslam_jax.pipeline.stage_cache import Cache
from bodyslam_jax.types import Intrinsics, Result, Sequence, SfmResult

SMOOTHED = "estimated once more, offline, from what the live run had recorded"


class Online(Maps):
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
        smooth: bool = False,
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
        - `smooth`: whether the points of all frames are recorded, which the method
            `smooth` needs.

        **Raises:** `InputError` if the body model or the motion model cannot be read.
        """
        if not fps > 0:
            raise InputError(f"fps: found {fps}, expected more than 0.")
        if places < 1:
            raise InputError(f"places: found {places}, expected 1 or more.")
        body = load_body_model(config.body_model)
        super().__init__(config, body, fps, places, threads)
        self.intrinsics, self.name = intrinsics, name
        self.keeps_points = smooth
        self.looked: int | None = None
        """Slot in which people were last looked for."""
        self.notes: list[str] = []
        """Lines of `warn`: they apply to the result of `smooth` too."""
        self.latest: Estimate | None = None
        self.started = self.prepared = False
        self.done = False
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
            self._start(image, timestamp)
        self.now = timestamp
        assert self.intrinsics is not None
        if image is None and points is None:
            raise InputError("update: found neither an image nor points.")
        looks = keypoints is not None or self._is_time_to_look(timestamp)
        people = self.bodies.find(timestamp, image, keypoints) if looks else None
        gray = None if image is None else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        if points is None:
            assert gray is not None
            shown = self.bodies.found.expected(timestamp) if people is None else people
            mask = self.bodies.mask(shown, self.intrinsics)
            points = self.follower.advance(gray, mask)
        self._collect(wait=False)
        status = self._locate(timestamp, gray, *points, people)
        shapes = self.record.shapes
        if people is None:
            bodies = self.bodies.predict(timestamp)
        else:
            given = timestamp, people, self.intrinsics, shapes
            bodies = self.bodies.follow(*given)
        self._submit(flush=False)
        self.counts.frames += 1
        self.counts.looks += looks
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
            self.fps,
        )
        if TWO_MAPS in self.warnings:
            measured = dataclasses.replace(measured, contradictions=(TWO_MAPS,))
        measured = self._with_video(measured)
        self.inputs = measured, cameras
        seconds = {k: round(v, 2) for k, v in self.seconds.items()}
        given = self.config, self.body, cameras, joint, seconds
        return assemble(measured, *given)

    def smooth(self) -> Result:
        """Runs the offline stages on the points and keypoints of all frames that were
        used, and returns their result: with everybody who was seen, and with a refined
        focal length if it was guessed. It sets `inputs` to those of this result.

        **Raises:** `InputError` if points were not recorded (`Online(smooth=True)`), if
        `finish` was not called before, or as `run`.
        """
        if not self.keeps_points:
            raise InputError("smooth: found no points, expected Online(smooth=True).")
        if not self.done:
            raise InputError("smooth: found no result, expected finish before.")
        assert self.intrinsics is not None
        frames = len(self.record.frames)
        notes = *self.notes, f"{SMOOTHED}: {frames} frames"
        measured = self.record.measured(self.intrinsics, self.name, notes)
        # People are not detected again.
        config = dataclasses.replace(self.config, detect="none")
        result, cameras, measured = run_stages(
            self._with_video(measured), config, Cache(None)
        )
        self.inputs = measured, cameras
        return result

    def _with_video(self, measured: Sequence) -> Sequence:
        """Returns the sequence with the frames of the file, if there is one."""
        if self.video is None:
            return measured
        used = np.array([frame.time for frame in self.record.frames])
        at = measured.timestamps + used[0]
        picks = np.rint(np.interp(at, used, self.picks)).astype(int)
        return dataclasses.replace(measured, frames=self.video, picks=picks)

    def warn(self, note: str) -> None:
        """Adds a line to the notes of all further estimates and of the result."""
        self.warnings[note] = None
        self.notes.append(note)

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

    def _is_time_to_look(self, timestamp: float) -> bool:
        """Returns whether the networks look for people in this frame: in the first one
        of each slot of the window, which is the one that the window gets."""
        before, self.looked = self.looked, self.slots.number(timestamp)
        return before != self.looked

    def _start(self, image: np.ndarray | None, timestamp: float) -> None:
        if self.intrinsics is None:
            if image is None:
                raise InputError("intrinsics: found none, nor an image to guess from.")
            self.intrinsics = self._guess(image.shape[1], image.shape[0])
        self.prepare()
        self.origin = timestamp
        self._begin(self.intrinsics)
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

    def _shape(self, person: int) -> np.ndarray:
        return self.record.shapes.get(person, np.zeros(10))

    def _estimate(
        self,
        timestamp: float,
        status: str,
        bodies: dict[int, tuple[np.ndarray, np.ndarray]],
    ) -> Estimate:
        T_WC = self.world.camera(self.loops.correction.now(self.map.T_WC))
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
            located=status in ("tracking", "fixed"),
            people=tuple(people),
            scale=scale,
            scale_sigma=sigma,
            status=status,
            notes=tuple(notes),
            latency=0.0,
        )
