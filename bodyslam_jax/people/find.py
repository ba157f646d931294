"""Detects and tracks people by the networks that ship with the package.

MoveNet searches the whole image every third of a second, at a scale for people of at
least a tenth of its longer side, and every second at one for smaller ones; in the
frames in between it runs on a square around each predicted person. A person found in a
search is also tracked backwards to the previous search.
"""

import dataclasses
from collections import deque
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8

from bodyslam_jax.config import Association, Detect
from bodyslam_jax.people import blazepose, movenet
from bodyslam_jax.people.found import (
    MAX_DISAGREEMENT,
    Found,
    as_body25,
    doubtful_wrists,
    find_feet,
    find_wrists,
)
from bodyslam_jax.people.linking import link, remarks
from bodyslam_jax.people.movenet import (
    MIN_SURE_SCORE,
    MOVENET_POINTS,
    Region,
    height,
    sure_points,
)
from bodyslam_jax.people.networks import (
    BLAZEPOSE,
    BLAZEPOSE_HEAVY,
    MOVENET,
    open_network,
)
from bodyslam_jax.people.phantoms import MIN_CONFIRMED_HEIGHT_PX, is_phantom
from bodyslam_jax.people.regions import behind, covered, regions, square_around
from bodyslam_jax.sfm import SILHOUETTE_STEP
from bodyslam_jax.tracking.appearance import DESCRIPTOR_SIZE, describe
from bodyslam_jax.tracking.duplicates import doubles, is_stray
from bodyslam_jax.tracking.tracker import Tracker, Tracklet, between

SEARCH_INTERVAL_S = 0.33
"""Time between two searches of the whole image."""
_MAX_PEOPLE = 8
"""Number of people that are followed, the largest ones first."""
COARSE_INPUT_PX, _SEARCH_INPUT_PX, _FINE_INPUT_PX = 320, 640, 1280
"""Longer side of the image in MoveNet's input: for people who fill the image, for most,
and for small ones."""
_FINE_SEARCH_PERIOD = 3
"""Every how many searches small people are searched for, too."""
_MAX_PERSON_PX = 250.0
"""Size in MoveNet's input above which it splits a person into several."""
SQUARE_INPUT_PX = 256
MIN_START_SCORE, MIN_CONTINUE_SCORE, _MIN_MASK_SCORE = 0.22, 0.12, 0.1
"""Least score of MoveNet that begins a track, that continues one, and that masks the
person in the images. Without people, scores are 0.00 to 0.07."""
_MIN_SEARCH_GAP_FRAMES = 3
"""Least number of frames between two searches after a track was lost."""
_MAX_OVERLAP_SHARE = 0.25
"""Share of a person's box covered by others up to which its colours are the
person's."""
_MIN_RELATIVE_VISIBILITY = 0.03
"""Least visibility (size times confidence, summed over time) of a person who is
estimated, relative to that of the most visible person."""
MIN_TRACK_S = 0.2
"""Shorter tracks are masked without a warning, as they may be false detections."""
_MIN_PRESENCE = 0.5
Detections = tuple[Float[np.ndarray, "n 17 3"], Float[np.ndarray, " n"]]
"""COCO keypoints, and a score for each person."""


@dataclasses.dataclass
class _Frame:
    """Detections in one image, and the image as long as it may be needed."""

    image: UInt8[np.ndarray, "y x 3"]
    mask: Bool[np.ndarray, "r c"]
    """Pixels that show people, at every `SILHOUETTE_STEP`-th pixel."""
    tracked: dict[int, np.ndarray]
    """COCO keypoints by number of the tracklet."""
    others: list[np.ndarray]


def find_people_tracked(
    images: Iterable[UInt8[np.ndarray, "y x 3"]],
    fps: float,
    settings: Detect = Detect(),
    association: Association = Association(),
    progress: Callable[[int], None] | None = None,
) -> Found:
    """Detects and tracks the people in the images of a video.

    Args:
        images: BGR, in order; those since the last search are kept in memory.
        association: how long people are followed while they are not seen (later they
            are recognised by clothes and size), and who is seen too briefly.
        progress: called with the number of images done.

    **Raises:** `ValueError` if a network of the package is missing or damaged.
    """
    finder = _Finder(fps, settings, association)
    for k, image in enumerate(images):
        finder.advance(k, image)
        if progress is not None:
            progress(k + 1)
    return finder.result()


class _Finder:
    """State of the search from frame to frame."""

    def __init__(self, fps: float, settings: Detect, association: Association) -> None:
        self.movenet = open_network(MOVENET)
        self.blazepose = open_network(BLAZEPOSE)
        best = settings.networks == "best"
        self.heavy = open_network(BLAZEPOSE_HEAVY) if best else None
        self.fps, self.settings, self.association = fps, settings, association
        self.whom = settings.min_height, _MAX_PEOPLE
        self.tracker = Tracker(fps, association.max_gap, MOVENET_POINTS)
        self.interval = max(1, round(SEARCH_INTERVAL_S * fps))
        self.next_search, self.last_search, self.searches = (
            0,
            -_MIN_SEARCH_GAP_FRAMES,
            0,
        )
        self.recent: deque[tuple[int, _Frame]] = deque(maxlen=self.interval + 1)
        self.feet: dict[tuple[int, int], np.ndarray] = {}
        """Heel and big toe of both sides (4, 3), by tracklet and frame."""
        self.wrists: dict[tuple[int, int], np.ndarray] = {}
        """What `find_wrists` returns, by tracklet and frame."""
        self.others: list[tuple[int, np.ndarray]] = []
        self.masks: list[np.ndarray] = []

    def advance(self, k: int, image: np.ndarray) -> None:
        """Processes image `k` (BGR): detects people and assigns them to tracklets."""
        size = tuple(-(-n // SILHOUETTE_STEP) for n in image.shape[:2])
        now = _Frame(image, np.zeros(size, bool), {}, [])
        expected = [t.expected(k) for t in self.tracker.alive(k)]
        found = [
            self._look(image, r, SQUARE_INPUT_PX) for r in regions(expected, *self.whom)
        ]
        if k >= self.next_search:
            found += self._search(image)
            self.last_search, self.next_search = k, k + self.interval
        points, score = merged(found)
        looks = self._looks(image, points)
        first_new = len(self.tracker.tracklets)
        clear = ~behind(points, score)
        who = self.tracker.update(
            k, points, looks, clear, clear & (score >= MIN_START_SCORE)
        )
        for row, number in zip(points, who.tolist(), strict=True):
            if number < 0:
                now.others.append(row)
                self.others.append((k, row))
            else:
                self._note(k, now, number, row)
        for number in range(first_new, len(self.tracker.tracklets)):
            self._look_back(number)
        if any(self._was_lost(t, k) for t in self.tracker.tracklets):
            sooner = max(k + 1, self.last_search + _MIN_SEARCH_GAP_FRAMES)
            self.next_search = min(self.next_search, sooner)
        self.masks.append(np.packbits(now.mask, axis=1))
        self.recent.append((k, now))

    def result(self) -> Found:
        """Returns all detections after the last image, with tracklets linked to
        people."""
        everybody = link(self.tracker.tracklets)
        phantoms = [p for p in everybody if self._is_phantom(p)]
        real = [p for p in everybody if not any(p is q for q in phantoms)]
        people = sorted(filter(self._is_estimated, real), key=_presence, reverse=True)
        people = [
            p
            for p in people
            if _presence(p) > _MIN_RELATIVE_VISIBILITY * _presence(people[0])
        ]
        people = _once(people)
        who = {
            (piece.number, frame): number
            for number, pieces in enumerate(people)
            for piece in pieces
            for frame in piece.frames
        }
        alone = lambda k, points: (k, -1, as_body25(points, None))
        rows: list[tuple[int, int, np.ndarray]] = [
            alone(*other) for other in self.others
        ]
        for tracklet in self.tracker.tracklets:
            for frame, points in zip(tracklet.frames, tracklet.points, strict=True):
                key = tracklet.number, frame
                body = as_body25(points, self.feet.get(key), self.wrists.get(key))
                rows.append((frame, who.get(key, -1), body))
            rows += [alone(*other) for other in between(tracklet)]
        rows.sort(key=lambda row: row[:2])
        warnings = remarks(people, self.fps, self.association.max_gap)
        warnings += [_of_phantom(p) for p in filter(self._is_estimated, phantoms)]
        tracks = [_track(p) for p in people]
        gap = max(1, round(self.association.max_gap * self.fps))
        others = 0
        for pieces in real:
            if any(pieces is p for p in people):
                continue
            track = _track(pieces)
            if len(track) >= MIN_TRACK_S * self.fps:
                others += not is_stray(track, tracks, gap, MIN_SURE_SCORE)
        if others > 0:
            warnings.append(
                f"{others} more people, small or seen briefly, are kept out of the map "
                "and not estimated."
            )
        return Found(
            np.array([row[0] for row in rows], int),
            np.array([row[2] for row in rows]).reshape(-1, 25, 3),
            np.array([row[1] for row in rows], int),
            np.stack(self.masks),
            tuple(warnings),
        )

    def _was_lost(self, tracklet: Tracklet, k: int) -> bool:
        """Returns whether a track of sufficient size ended in the previous frame."""
        large = height(tracklet.points[-1]) >= self.settings.min_height
        return large and tracklet.frames[-1] == k - 1

    def _is_estimated(self, pieces: list[Tracklet]) -> bool:
        """Returns whether a person is large and visible long enough to be estimated."""
        heights = [height(p) for t in pieces for p in t.points]
        least = min(self.association.min_duration * self.fps, len(self.masks))
        return (
            float(np.median(heights)) >= self.settings.min_height
            and len(heights) >= least
        )

    def _is_phantom(self, pieces: list[Tracklet]) -> bool:
        return is_phantom(pieces, set(self.feet), self.fps)

    def _search(self, image: np.ndarray) -> list[Detections]:
        """Returns the people anywhere in the image."""
        whole = (0, 0, image.shape[1], image.shape[0])
        longest = max(image.shape[:2])
        found = [self._look(image, whole, COARSE_INPUT_PX)]
        found.append(self._look(image, whole, _SEARCH_INPUT_PX))
        if (
            longest > 1.3 * _SEARCH_INPUT_PX
            and self.searches % _FINE_SEARCH_PERIOD == 0
        ):
            found.append(self._look(image, whole, min(longest, _FINE_INPUT_PX)))
        self.searches += 1
        return found

    def _look(self, image: np.ndarray, region: Region, longer: int) -> Detections:
        points, score = movenet.find_people(self.movenet, image, region, longer)
        scale = longer / max(region[2] - region[0], region[3] - region[1])
        sizes = np.array([movenet.box_size(p) for p in points])
        kept = score >= _MIN_MASK_SCORE
        if longer > COARSE_INPUT_PX:
            kept &= sizes * scale <= _MAX_PERSON_PX
        return points[kept], score[kept]

    def _looks(self, image: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Returns descriptors of clothes; NaN for people whom others overlap."""
        boxes = [movenet.box(p) for p in points]
        looks = np.full((len(points), DESCRIPTOR_SIZE), np.nan)
        for i, row in enumerate(points):
            others = [covered(boxes[i], b) for j, b in enumerate(boxes) if j != i]
            if max(others, default=0.0) < _MAX_OVERLAP_SHARE:
                looks[i] = describe(image, row, movenet.MIN_SURE_SCORE)
        return looks

    def _note(self, k: int, frame: _Frame, number: int, points: np.ndarray) -> None:
        """Records a person in a frame, with feet and silhouette if BlazePose confirms
        the person."""
        frame.tracked[number] = points
        if height(points) < MIN_CONFIRMED_HEIGHT_PX:
            return
        if self.heavy is not None and doubtful_wrists(points).any():
            again = confirmed(self.heavy, frame.image, points)
            if again is not None:
                self.wrists[number, k] = find_wrists(again[0], points)
        found = confirmed(self.blazepose, frame.image, points)
        if found is None:
            return
        pose, self.feet[number, k] = found
        size = frame.image.shape[0], frame.image.shape[1]
        frame.mask |= blazepose.mask_in_image(pose, size, SILHOUETTE_STEP) > 0

    def _look_back(self, number: int) -> None:
        """Extends a new track backwards to the frames since the last search."""
        tracklet = self.tracker.tracklets[number]
        for index, frame in reversed(self.recent):
            first = tracklet.points[0]
            near = self._look(frame.image, square_around(first), SQUARE_INPUT_PX)
            points, score = merged([near])
            looks = self._looks(frame.image, points)
            if not len(points):
                return
            cost = self.tracker.cost_before(tracklet, points, looks)
            best = int(np.argmin(cost))
            taken = frame.tracked.values()
            if cost[best] >= 1 or score[best] < MIN_CONTINUE_SCORE:
                return
            if any(movenet.same_person(points[best], p) for p in taken):
                return
            tracklet.prepend(index, points[best], looks[best])
            self._note(index, frame, number, points[best])
            self.masks[index] = np.packbits(frame.mask, axis=1)


def confirmed(
    session: Any, image: UInt8[np.ndarray, "y x 3"], points: Float[np.ndarray, "17 3"]
) -> tuple[blazepose.Pose, Float[np.ndarray, "4 3"]] | None:
    """Returns BlazePose's view of a person with these keypoints, and heel and big toe
    of both sides; `None` if it does not see the same person there."""
    square = blazepose.turned_square(points, MIN_SURE_SCORE)
    if square is None:
        return None
    pose = blazepose.read_pose(session, image, square)
    apart = blazepose.disagreement(pose, points)
    unlike = np.median(apart[sure_points(points)]) > MAX_DISAGREEMENT
    if pose.presence < _MIN_PRESENCE or unlike:
        return None
    return pose, find_feet(pose, points, apart)


def merged(found: list[Detections]) -> Detections:
    """Returns the detections of several searches without duplicates."""
    points = np.concatenate([np.zeros((0, 17, 3)), *(p for p, _ in found)])
    score = np.concatenate([np.zeros(0), *(s for _, s in found)])
    kept = movenet.distinct(points, score)
    return points[kept], score[kept]


def _once(people: list[list[Tracklet]]) -> list[list[Tracklet]]:
    """Merges people who are at the same place at the same time: the more visible one is
    kept, with the pieces of the other from frames in which the first is not seen."""
    twice = doubles([_track(p) for p in people], MIN_SURE_SCORE)
    for i, j in twice.items():
        known = {frame for piece in people[j] for frame in piece.frames}
        more = [t for t in people[i] if known.isdisjoint(t.frames)]
        people[j] = sorted([*people[j], *more], key=lambda t: t.frames[0])
    return [p for i, p in enumerate(people) if i not in twice]


def _track(pieces: list[Tracklet]) -> dict[int, np.ndarray]:
    """Returns a person's keypoints by frame."""
    return {
        frame: points
        for t in pieces
        for frame, points in zip(t.frames, t.points, strict=True)
    }


def _of_phantom(pieces: list[Tracklet]) -> str:
    """Returns a warning about a detection that is not a person."""
    first, last = pieces[0].frames[0], pieces[-1].frames[-1]
    u, v = np.median([p[:, :2] for t in pieces for p in t.points], axis=(0, 1))
    return (
        f"something like a person at ({u:.0f}, {v:.0f}) px, frames {first} to {last}, "
        "is taken for a thing: no leg or face is seen and a second network finds "
        "nobody there, or nothing of it moves against the rest. It is kept out of the "
        "map and not estimated; give keypoints (--keypoints) if it is a person."
    )


def _presence(pieces: list[Tracklet]) -> float:
    """Returns the visibility of a person: size times confidence, summed over time."""
    return sum(height(p) * float(p[:, 2].sum()) for t in pieces for p in t.points)
