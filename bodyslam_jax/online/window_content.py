"""The content of the window: its frames, people, landmarks and what is known of them.

The window has `FRAMES` frames in chunks of ten. The first chunk is the past, whose
measurements are in the prior; the others are measured. All arrays have one size.

Landmarks span `LIFE` chunks at most; a longer track continues as another landmark. So a
prior couples `PRIOR` frames, whatever the tracks.
"""

import dataclasses

import numpy as np
from jaxtyping import Float, Int, Real

from bodyslam_jax import graph
from bodyslam_jax.body import BodyModel
from bodyslam_jax.config import Config
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.graph import CHUNK
from bodyslam_jax.online import prior as priors
from bodyslam_jax.types import Intrinsics

FRAMES = 60
"""Frames of a window, the first ten of them the past; the solver has programs of this
size."""
LIFE = 3
"""Largest number of chunks that a landmark spans, so that the solver's tables are
narrow."""
PRIOR = (LIFE + 1) * CHUNK
"""Frames of the prior: the past, and those that landmarks of the leaving chunk
observe."""
_INITIAL_SIGMA_PX = 0.7
"""Noise of tracks until it is estimated, px."""
_MAX_UNSEEN_FRAMES = 10
"""Frames without keypoints after which a person's slot is free for another person."""
_MAX_OBSERVATIONS = 150
"""Largest number of observations of a frame that are in the graph."""
_NOTHING = np.zeros(0, int), np.zeros((0, 2))


@dataclasses.dataclass(frozen=True)
class Measured:
    """The measurements of the front end in one frame."""

    time: float
    """Time, s; within half a step of the window's rate from its nominal time in the
    window."""
    T_WC: Float[np.ndarray, "4 4"]
    """Camera to map, map units; a guess where not `located`."""
    located: bool
    """True also of an interpolated frame without an image, whose ids are empty."""
    ids: Int[np.ndarray, " n"]
    """Numbers of the tracks."""
    uv: Float[np.ndarray, "n 2"]
    """Pixels of the tracks, px."""
    people: dict[int, Float[np.ndarray, "25 3"]]
    """Keypoints (u px, v px, confidence) by person."""


class Content:
    """The last frames of one map, and the people in them."""

    def __init__(
        self,
        intrinsics: Intrinsics,
        body: BodyModel,
        config: Config,
        fps: float,
        places: int,
    ) -> None:
        """**Arguments:** `fps`: rate of the window's frames, 1/s; `places`: number of
        slots for people."""
        self.intrinsics, self.body, self.config = intrinsics, body, config
        self.fps, self.places = fps, places
        self.count = 0
        """Number of measured frames in the window, after the past."""
        self.solved_until = -CHUNK
        """Number of the first frame that was in no solve."""
        self.first = self.start = -CHUNK
        """Number of its first frame, now and at first; frames of the map count from 0.
        """
        self.times = np.arange(FRAMES) / fps
        self.cameras = np.tile(np.eye(4), (FRAMES, 1, 1))
        self.located = np.zeros(FRAMES, bool)
        self.free = np.zeros((FRAMES, 6))
        self.seen: list[tuple[np.ndarray, np.ndarray]] = [_NOTHING] * FRAMES
        """Landmark and pixel of each observation, by frame."""
        self.uv = np.zeros((places, FRAMES, 25, 2))
        self.confidence = np.zeros((places, FRAMES, 25))
        self.roots = np.tile(np.eye(4), (places, FRAMES, 1, 1))
        self.poses = np.zeros((places, FRAMES, 23, 3))
        self.known = np.zeros((places, FRAMES), bool)
        """True where roots and poses are those of a solve."""
        self.shapes = np.zeros((places, 10))
        self.shape_covariance = np.full((places, 10, 10), np.nan)
        """Covariance of each shape from the last solve that computed it, else NaN."""
        self.people: list[int | None] = [None] * places
        self.began = np.zeros(places, int)
        """Number of the frame in which each person's shape is measured."""
        self.book: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        """Shapes, and their standard deviations, of people who have left the window."""
        self.fixed = False
        """True if the camera stands still or only turns: its poses are held, there are
        no landmarks, and the scale is determined by people's sizes alone."""
        self.scale, self.scale_sigma = 1.0, float("nan")
        self.drift = 1.0
        """Ratio by which the map's unit became longer, as loops told, that s has not
        followed yet."""
        self.size_sigma = float("nan")
        """Relative standard deviation of people's sizes where `fixed`; NaN as long as
        it is unknown."""
        self.pixel_sigma = _INITIAL_SIGMA_PX
        self.steps_told = np.zeros(places)
        """Information of marginalised steps on their common factor."""
        self.ground_told = 0.0
        """Number of marginalised frames with a ground factor."""
        self.prior: graph.MarginalPrior | None = None
        self.where: dict[int, np.ndarray] = {}
        """Positions of landmarks, map units."""
        self.life: dict[int, tuple[int, int]] = {}
        """By track: its landmark, and the chunk in which that landmark ends."""
        self.track: dict[int, int] = {}
        """By landmark: its track."""
        self.landmarks = 0
        """Number of landmarks so far."""
        self.in_graph = np.zeros(0, int)
        """The landmarks of the last problem."""
        self.predictor: graph.MotionPredictor | None = None
        self.stands: graph.MotionPredictor | None = None

    def restart(self) -> None:
        """Clears the map; the shapes of people are kept in the book."""
        for h in range(self.places):
            self._leave(h)
        book, told = self.book, (self.predictor, self.stands)
        self.__init__(self.intrinsics, self.body, self.config, self.fps, self.places)
        self.book = book
        self.predictor, self.stands = told

    def _take(self, frames: list[Measured]) -> None:
        at = CHUNK + self.count
        if self.count == 0:  # The past of the first window is nothing.
            self.cameras[:] = frames[0].T_WC
        step = 1 / self.fps
        if self.count == 0:
            self.times[:at] = frames[0].time - step * np.arange(at, 0, -1)
        self.times[at : at + CHUNK] = [frame.time for frame in frames]
        later = np.arange(1, FRAMES - at - CHUNK + 1)
        self.times[at + CHUNK :] = frames[-1].time + step * later
        for k, frame in enumerate(frames, start=at):
            self.cameras[k:] = frame.T_WC
            self.located[k] = frame.located
            shown = frame.located and len(frame.ids) > 0 and not self.fixed
            self.free[k] = float(shown)
            self.seen[k] = self._landmarks_of(k, frame) if shown else _NOTHING
            self.known[:, k:] = False
            self.uv[:, k:], self.confidence[:, k:] = 0.0, 0.0
            for person, points in frame.people.items():
                h = self._place_of(person, k)
                if h is not None:
                    self.uv[h, k] = points[:, :2]
                    self.confidence[h, k] = points[:, 2]
        self.count += CHUNK
        if self.first == self.start:
            self._fix_gauge()

    def _fix_gauge(self) -> None:
        """Fixes the gauge: holds the first camera, and one coordinate of the farthest
        camera of the first window, which defines the unit of the map."""
        shown = np.array([len(ids) > 0 for ids, _ in self.seen])
        here = CHUNK + np.flatnonzero(shown[CHUNK:])
        if not len(here):
            return
        self.free[here] = 1.0
        self.free[here[0]] = 0.0
        away = np.abs(self.cameras[here, :3, 3] - self.cameras[here[0], :3, 3])
        k, axis = np.unravel_index(np.argmax(away), away.shape)
        self.free[here[k], 3 + axis] = 0.0

    def _landmarks_of(self, k: int, frame: Measured) -> tuple[np.ndarray, np.ndarray]:
        chunk = (self.first + k) // CHUNK
        order = np.argsort([i not in self.life for i in frame.ids], kind="stable")
        chosen = np.sort(order[:_MAX_OBSERVATIONS])
        rows = []
        for i in frame.ids[chosen].tolist():
            landmark, end = self.life.get(i, (-1, -1))
            if chunk >= end:
                # The first life of a track is shorter for two in three: tracks that
                # begin together end apart, so that no frame cuts the map in two.
                life = LIFE if landmark >= 0 else 1 + (i % LIFE)
                before = self.where.get(landmark)
                landmark, self.landmarks = self.landmarks, self.landmarks + 1
                self.life[i] = landmark, chunk + life
                self.track[landmark] = i
                if before is not None:
                    self.where[landmark] = before
            rows.append(landmark)
        return np.array(rows, int), np.asarray(frame.uv[chosen], float)

    def _place_of(self, person: int, k: int) -> int | None:
        """Returns the person's slot from frame `k` on; a new person gets the slot of
        one who was not visible for a while, or `None`."""
        if person in self.people:
            return self.people.index(person)
        recent = slice(max(0, k - _MAX_UNSEEN_FRAMES), k)
        gone = [
            h
            for h, other in enumerate(self.people)
            if other is None or not (self.confidence[h, recent] > 0).any()
        ]
        if not gone:
            return None
        h = gone[0]
        self._leave(h)
        self.people[h] = person
        self.began[h] = -1
        self.steps_told[h] = 0.0
        self.known[h] = False
        self.uv[h], self.confidence[h] = 0.0, 0.0
        self.roots[h], self.poses[h] = np.eye(4), 0.0
        self.shapes[h] = self._known_shape(person)
        self.shape_covariance[h] = np.nan
        return h

    def _known_shape(self, person: int | None) -> Float[np.ndarray, " 10"]:
        known = None if person is None else self.book.get(person)
        return np.zeros(10) if known is None else known[0]

    def _leave(self, h: int) -> None:
        """Frees a slot; the estimate of the person's shape is kept in the book."""
        person = self.people[h]
        if person is None:
            return
        sigma = np.full(10, self.config.weights.shape_sigma)
        self.book[person] = self.shapes[h].copy(), sigma
        if self.prior is not None:
            self.prior = priors.without_person(self.prior, h)
        self.people[h] = None

    def _bridge(self) -> None:
        """Interpolates cameras without an image between those around them."""
        rows = np.arange(CHUNK, CHUNK + self.count)
        shown = np.array([len(self.seen[k][0]) > 0 for k in rows], bool)
        solved = rows[shown]
        missing = rows[~shown & self.located[rows]]
        missing = missing[(missing > solved.min(initial=FRAMES))]
        missing = missing[(missing < solved.max(initial=0))]
        if len(missing):
            self.cameras[missing] = between(solved, self.cameras[solved], missing)

    def _shift(self) -> None:
        """Makes the oldest measured frames the past and removes their landmarks."""
        gone = np.concatenate([s[0] for s in self.seen[CHUNK : 2 * CHUNK]])
        gone = np.unique(gone)
        move = lambda x, axis: np.concatenate(
            [
                np.take(x, np.arange(CHUNK, FRAMES), axis),
                np.take(x, np.full(CHUNK, FRAMES - 1), axis),
            ],
            axis,
        )
        for name in ("cameras", "located", "free"):
            setattr(self, name, move(getattr(self, name), 0))
        for name in ("uv", "confidence", "roots", "poses", "known"):
            setattr(self, name, move(getattr(self, name), 1))
        last = self.times[-1] + np.arange(1, CHUNK + 1) / self.fps
        self.times = np.concatenate([self.times[CHUNK:], last])
        self.known[:, FRAMES - CHUNK :] = False
        self.confidence[:, FRAMES - CHUNK :] = 0.0
        self.seen = self.seen[CHUNK:] + [_NOTHING] * CHUNK
        for k in range(FRAMES):
            ids, uv = self.seen[k]
            kept = ~np.isin(ids, gone) & (k >= CHUNK)
            self.seen[k] = ids[kept], uv[kept]
        self.first += CHUNK
        self.count -= CHUNK
        self._forget()

    def _forget(self) -> None:
        """Removes landmarks and tracks that are in no frame."""
        here = set(np.concatenate([s[0] for s in self.seen]).tolist())
        chunk = (self.first + FRAMES) // CHUNK - 1
        self.life = {
            i: (landmark, end)
            for i, (landmark, end) in self.life.items()
            if landmark in here or end >= chunk
        }
        current = {landmark for landmark, _ in self.life.values()} | here
        self.where = {i: x for i, x in self.where.items() if i in current}
        self.track = {i: x for i, x in self.track.items() if i in current}


def between(
    known: Real[np.ndarray, " n"],
    T: Float[np.ndarray, "n 4 4"],
    wanted: Real[np.ndarray, " m"],
) -> Float[np.ndarray, "m 4 4"]:
    """Returns poses at other times, interpolated; beyond the ends the first and the
    last."""
    found = np.tile(np.eye(4), (len(wanted), 1, 1))
    after = np.clip(np.searchsorted(known, wanted), 0, len(known) - 1)
    before = np.clip(np.searchsorted(known, wanted, side="right") - 1, 0, None)
    gap = np.maximum(known[after] - known[before], 1e-9)
    share = np.clip((wanted - known[before]) / gap, 0.0, 1.0)
    a, b = T[before], T[after]
    found[:, :3, 3] = a[:, :3, 3] + share[:, None] * (b[:, :3, 3] - a[:, :3, 3])
    found[:, :3, :3] = so3.interpolate(a[:, :3, :3], b[:, :3, :3], share)
    return found
