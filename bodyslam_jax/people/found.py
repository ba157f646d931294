"""Represents all detections of people in a video, as BODY_25 keypoints with
confidences."""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from bodyslam_jax.people import blazepose
from bodyslam_jax.people.detect import to_body25
from bodyslam_jax.types import DetectedPeople

MAX_DISAGREEMENT = 0.12
"""Distance between MoveNet's and BlazePose's ankle, and median over all keypoints,
relative to the radius of the circle around a person, up to which they show the same
person."""
_FOOT_CONFIDENCE_FACTOR = 0.6
"""Confidence of heels and toes relative to that of their ankle: they are 2 to 3 % of a
person's height from where other detectors put them, in the median."""
_SCORES = (0.08, 0.15, 0.22, 0.30, 0.40, 0.50)
_CONFIDENCES = (0.0, 0.1, 0.2, 0.5, 0.8, 1.0)
_FOOT_KEYPOINTS = ((21, 19, 11, 15), (24, 22, 14, 16))
"""BODY_25's heel, big toe and ankle, and COCO's ankle, of both sides."""
_WRISTS = [9, 10]
"""COCO's wrists."""
_WRIST_KEYPOINTS = (7, 4)
"""BODY_25's wrists, left and right."""
SURE_WRIST = 0.8
"""Confidence below which MoveNet's wrist is looked for again, and that of a wrist found
so. It errs by 24 to 40 mm in the median, where most of MoveNet's err by 83 to 176
(`benchmarks/keypoints.md`)."""
_MIN_VISIBILITY = 0.5
"""Visibility from which BlazePose's wrist is seen; below it is a guess (112 mm)."""
_WRIST_POWER = 3
"""Exponent of a wrist's confidence. The network guesses a wrist behind the trunk, often
at the position of the other wrist: on ten rendered sequences the error was 2.5 times
that of a certain wrist at a confidence of 0.8, and 7 times at 0.5. Errors of other
joints are about inverse to their confidence. What maximum likelihood has in place of it
is no better (`benchmarks/keypoints.md`)."""


@dataclasses.dataclass(frozen=True)
class Found:
    """All detections in a video of `t` frames, one row per person and frame."""

    frame: Int[np.ndarray, " n"]
    points: Float[np.ndarray, "n 25 3"]
    """Keypoints of BODY_25: u px, v px, confidence."""
    person: Int[np.ndarray, " n"]
    """Number of the person, the most visible first; -1 for people who are only
    masked."""
    silhouettes: UInt8[np.ndarray, "t y x8"]
    """Masks of people at every `step`-th pixel, eight pixels per byte."""
    warnings: tuple[str, ...]

    def by_frame(self, num_frames: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Returns for each frame the keypoints (n, 25, 3) of the numbered people, and
        their numbers (n,)."""
        numbered = self.person >= 0
        frame, points, person = (
            a[numbered] for a in (self.frame, self.points, self.person)
        )
        ends = np.searchsorted(frame, np.arange(1, num_frames))
        return np.split(points, ends), np.split(person, ends)

    def detected(self) -> DetectedPeople:
        """Returns all detections, to be masked in the images."""
        return DetectedPeople(self.frame, self.points, self.silhouettes)


def find_feet(
    pose: blazepose.Pose, points: Float[np.ndarray, "17 3"], apart: np.ndarray
) -> Float[np.ndarray, "4 3"]:
    """Returns heel and big toe of both sides (u px, v px, confidence), with confidence
    0 where the two networks disagree on the ankle."""
    feet = pose.landmarks[blazepose.HEELS_AND_TOES].copy()
    sure = confidence(points[:, 2])
    for side, (_, _, _, ankle) in enumerate(_FOOT_KEYPOINTS):
        rows = slice(2 * side, 2 * side + 2)
        share = (
            _FOOT_CONFIDENCE_FACTOR * sure[ankle] * (apart[ankle] < MAX_DISAGREEMENT)
        )
        feet[rows, 2] *= share
    return feet


def doubtful_wrists(points: Float[np.ndarray, "17 3"]) -> Bool[np.ndarray, " 2"]:
    """Returns which wrists, left and right, MoveNet is not sure of."""
    return confidence(points[_WRISTS, 2]) < SURE_WRIST


def find_wrists(
    pose: blazepose.Pose, points: Float[np.ndarray, "17 3"]
) -> Float[np.ndarray, "2 3"]:
    """Returns the left and right wrist (u px, v px, confidence) that BlazePose sees and
    MoveNet is not sure of; confidence 0 where that is not so."""
    wrists = pose.landmarks[blazepose.COCO_OF_LANDMARKS[_WRISTS]].copy()
    seen = wrists[:, 2] >= _MIN_VISIBILITY
    wrists[:, 2] = np.where(seen & doubtful_wrists(points), SURE_WRIST, 0.0)
    return wrists


def as_body25(
    points: Float[np.ndarray, "17 3"],
    feet: Float[np.ndarray, "4 3"] | None,
    wrists: Float[np.ndarray, "2 3"] | None = None,
) -> Float[np.ndarray, "25 3"]:
    """Returns BODY_25 from MoveNet's keypoints and the output of `find_feet` and
    `find_wrists`."""
    sure = confidence(points[:, 2])
    sure[_WRISTS] **= _WRIST_POWER
    found = to_body25(np.column_stack([points[:, :2], sure]))
    if feet is not None:
        for side, (heel, toe, _, _) in enumerate(_FOOT_KEYPOINTS):
            found[heel], found[toe] = feet[2 * side], feet[2 * side + 1]
        found[found[:, 2] <= 0] = 0.0
    if wrists is not None:
        for keypoint, wrist in zip(_WRIST_KEYPOINTS, wrists, strict=True):
            found[keypoint] = wrist if wrist[2] > 0 else found[keypoint]
    return found


def confidence(score: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Converts MoveNet's score to a confidence in 0..1 that is inverse to the error.

    Errors relative to six clips' other keypoints, two of them rendered, are 1.0 % of a
    person's height in the median from a score of 0.45 on, 1.4 to 1.9 % at 0.35, 2.2 %
    at 0.27 with one in five gross, 4 to 9 % at 0.2.
    """
    return np.interp(score, _SCORES, _CONFIDENCES)
