"""Finds and identifies people in the images of a running video.

The networks that ship search a square around each tracked person, and every third of a
second the whole image for a new one. Given keypoints are tracked in the same way. A
track of some duration is a person; one that begins where a person with the same clothes
was lost is that person again. Descriptions of clothes are kept in memory only.

Frames are numbered by their times, so that durations and velocities are right where a
slow machine left frames out.
"""

import dataclasses

import numpy as np
from jaxtyping import Float, UInt8

from bodyslam_jax.config import Association, Detect
from bodyslam_jax.io.keypoints.layouts import LAYOUTS
from bodyslam_jax.people import movenet
from bodyslam_jax.people.find import (
    COARSE_INPUT_PX,
    MIN_CONTINUE_SCORE,
    MIN_START_SCORE,
    MIN_TRACK_S,
    SEARCH_INTERVAL_S,
    confirmed,
    merged,
)
from bodyslam_jax.people.found import as_body25
from bodyslam_jax.people.movenet import (
    MIN_SURE_SCORE,
    MOVENET_POINTS,
    height,
    sure_points,
)
from bodyslam_jax.people.networks import BLAZEPOSE, MOVENET, open_network
from bodyslam_jax.people.regions import behind, regions
from bodyslam_jax.tracking.appearance import DESCRIPTOR_SIZE, describe, difference
from bodyslam_jax.tracking.tracker import MAX_COLOUR_DIFFERENCE, Tracker

_SQUARE_INPUT_PX = 224
"""Side of the square around a person in MoveNet's input: keypoints are as exact as with
256, in three quarters of the time (`benchmarks/online.md`)."""
_SEARCH_INTERVAL_TRACKED_S = 1.0
"""Time between two searches of the whole image while somebody is tracked, s."""
_MAX_PEOPLE = 4
"""Largest number of tracked people; the largest ones in the image are kept."""
_MAX_CLOTHES_DIFFERENCE = 0.6 * MAX_COLOUR_DIFFERENCE
"""Largest difference of colours of a person who returns."""
_MAX_ABSENCE_S = 5.0
"""Longest absence after which a person whose clothes are not visible is recognised,
s."""
_MAX_DETECTIONS = 45
"""Number of detections of a track that are kept."""
_BODY25_OF_COCO = np.array(LAYOUTS[movenet.NUM_KEYPOINTS]["COCO"].parts)
"""BODY_25's keypoint of each of COCO's."""


@dataclasses.dataclass
class _Person:
    """A person with a number."""

    track: int
    look: np.ndarray


class LivePeople:
    """Tracks of people, and the numbers of the people."""

    def __init__(
        self,
        fps: float,
        settings: Detect = Detect(),
        association: Association = Association(),
        spared_cores: int = 0,
    ) -> None:
        """
        **Arguments:**

        - `fps`: rate by which frames are numbered, 1/s.
        - `spared_cores`: cores of the processor that the networks leave to others.
        """
        self.fps, self.settings, self.spared_cores = fps, settings, spared_cores
        self.tracker = Tracker(fps, association.max_gap, MOVENET_POINTS)
        self.persons: dict[int, _Person] = {}
        self.start: float | None = None
        """Time of the first frame, s."""
        self.frame, self.next_search = -1, 0
        """Numbers of the last frame, and of the next one that is searched whole."""
        self.networks: tuple | None = None

    def load_networks(self) -> None:
        """Opens the networks.

        **Raises:** as `open_network`.
        """
        if self.networks is None:
            self.networks = tuple(
                open_network(network, spared_cores=self.spared_cores)
                for network in (MOVENET, BLAZEPOSE)
            )

    def find(
        self, image: UInt8[np.ndarray, "y x 3"], time: float
    ) -> dict[int, Float[np.ndarray, "25 3"]]:
        """Returns BODY_25 keypoints (u px, v px, confidence) in the next image, of
        `time` (s), by person."""
        self.load_networks()
        assert self.networks is not None
        self.frame = max(self.frame + 1, self._number(time))
        alive = self.tracker.alive(self.frame)
        expected = [t.expected(self.frame) for t in alive]
        squares = regions(expected, self.settings.min_height, _MAX_PEOPLE)
        found = [self._look(image, r, _SQUARE_INPUT_PX) for r in squares]
        if self.frame >= self.next_search:
            whole = 0, 0, image.shape[1], image.shape[0]
            found.append(self._look(image, whole, COARSE_INPUT_PX))
            wait = _SEARCH_INTERVAL_TRACKED_S if squares else SEARCH_INTERVAL_S
            self.next_search = self.frame + max(1, round(wait * self.fps))
        points, score = merged(found)
        large = np.array([height(p) >= self.settings.min_height for p in points], bool)
        points, score = points[large], score[large]
        looks = [describe(image, p, MIN_SURE_SCORE) for p in points]
        looks = np.array(looks).reshape(-1, DESCRIPTOR_SIZE)
        clear = ~behind(points, score)
        who = self._track(points, looks, clear, clear & (score >= MIN_START_SCORE))
        return {person: self._whole(image, points[row]) for row, person in who.items()}

    def given(
        self,
        keypoints: Float[np.ndarray, "p 25 3"],
        time: float,
        image: UInt8[np.ndarray, "y x 3"] | None = None,
    ) -> dict[int, Float[np.ndarray, "25 3"]]:
        """Returns keypoints of the next frame, of `time` (s), given in any order, by
        person."""
        self.frame = max(self.frame + 1, self._number(time))
        points = keypoints[:, _BODY25_OF_COCO]
        some = np.array([sure_points(p).sum() >= 3 for p in points], bool)
        rows = np.flatnonzero(some)
        looks = np.full((len(rows), DESCRIPTOR_SIZE), np.nan)
        if image is not None:
            found = [describe(image, points[row], MIN_SURE_SCORE) for row in rows]
            looks = np.array(found).reshape(-1, DESCRIPTOR_SIZE)
        every = np.ones(len(rows), bool)
        who = self._track(points[rows], looks, every, every)
        return {person: keypoints[rows[row]] for row, person in who.items()}

    def expected(self, time: float) -> dict[int, Float[np.ndarray, "25 3"]]:
        """Returns predicted keypoints without feet at a later `time` (s), by person,
        of everybody whose track is alive."""
        frame = self._number(time)
        alive = {t.number: t for t in self.tracker.alive(frame)}
        return {
            person: as_body25(alive[known.track].expected(frame), None)
            for person, known in self.persons.items()
            if known.track in alive
        }

    def _number(self, time: float) -> int:
        """Returns the number of the frame at a time."""
        if self.start is None:
            self.start = time
        return round((time - self.start) * self.fps)

    def _look(
        self, image: np.ndarray, region: movenet.Region, longer: int
    ) -> tuple[np.ndarray, np.ndarray]:
        assert self.networks is not None
        points, score = movenet.find_people(self.networks[0], image, region, longer)
        kept = score >= MIN_CONTINUE_SCORE
        return points[kept], score[kept]

    def _whole(
        self, image: np.ndarray, points: Float[np.ndarray, "17 3"]
    ) -> Float[np.ndarray, "25 3"]:
        """Returns BODY_25, with the feet that BlazePose finds."""
        assert self.networks is not None
        found = confirmed(self.networks[1], image, points)
        return as_body25(points, None if found is None else found[1])

    def _track(
        self,
        points: np.ndarray,
        looks: np.ndarray,
        may_return: np.ndarray,
        may_start: np.ndarray,
    ) -> dict[int, int]:
        """Returns the person of each row that shows one."""
        who = self.tracker.update(self.frame, points, looks, may_return, may_start)
        for track in self.tracker.tracklets:
            for kept in (track.frames, track.points, track.looks):
                del kept[:-_MAX_DETECTIONS]
        found = {}
        for row, number in enumerate(who.tolist()):
            person = None if number < 0 else self._person(number)
            if person is not None:
                found[row] = person
        return found

    def _person(self, number: int) -> int | None:
        for person, known in self.persons.items():
            if known.track == number:
                known.look = self.tracker.tracklets[number].look
                return person
        track = self.tracker.tracklets[number]
        duration = track.frames[-1] - track.frames[0] + 1
        if len(track.frames) < 2 or duration < round(MIN_TRACK_S * self.fps):
            return None
        look, person = track.look, len(self.persons)
        away = [
            (difference(known.look, look), other)
            for other, known in self.persons.items()
            if self._last(other) < track.frames[0]
        ]
        # Without an image, one who comes soon after only one left is that person.
        lately = [
            (0.0, other)
            for d, other in away
            if np.isnan(d)
            and self.frame - self._last(other) <= _MAX_ABSENCE_S * self.fps
        ]
        away = lately if len(lately) == 1 else away
        away = [(d, other) for d, other in away if d < _MAX_CLOTHES_DIFFERENCE]
        if away:
            person = min(away)[1]
        self.persons[person] = _Person(number, look)
        return person

    def _last(self, person: int) -> int:
        """Returns the frame in which a person was visible last."""
        return self.tracker.tracklets[self.persons[person].track].frames[-1]
