"""Says whether people sit or stand whose knees and ankles are never in view.

Somebody cut off at the waist, or behind a table, has legs that follow from the upper
body alone, and looks nearly alike whether legs sit or stand: guessed legs of people on
stools hang as those of people who stand. What differs is how far the pelvis moves,
which gives a probability (`tools/sitting_probability.py`, with figures in
`benchmarks/plausibility.md`), by which legs are posed (`pipeline.seated_legs`). Neither
the lean of the trunk is used, since up is taken from trunks where no foot stands, nor
the height over a floor that no foot determines.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import uniform_filter1d

from bodyslam_jax.body.skeleton import HIPS, KNEES, PELVIS
from bodyslam_jax.geometry.arrays import runs
from bodyslam_jax.people.shown import KNEES_AND_ANKLES

_UP_AXIS, _HORIZONTAL_AXES = 1, [0, 2]
WINDOW_S = 1.0
"""Time over which the pelvis' movement is measured, and about which no knee and no
ankle is shown: people sit down and stand up in about a second."""
_MAX_SHOWN_SHARE = 0.05
"""Share of knees and ankles shown within it that is the detector's mistake: in a video
cut off at the hips it had up to 2.5 %, at the edge of the image; one leg is 50 %."""
SEATED_THIGH_DEGREES = 50.0
"""Angle of the thighs with the vertical, mean of both, from which a body sits: 2 % of
the frames of CMU recordings have it between 40 degrees and this, and 4 % of those of
people who sit down and stand up."""
_MIN_MOVEMENT_M = 0.01
"""Movement that counts as none: what estimates of people who keep still show."""
_DEPTH_NOISE_M = 0.05
"""Movement along the view that estimates show of people who keep still and of whom no
leg is in view: 0.05 m of a real man who sits and moves by 0.01 m, across the view 0.02.
"""
_LOGIT_AT_1_M, _LOGIT_PER_LOG = -4.03, -1.29
"""Log odds of sitting at a movement of 1 m, and their change with its logarithm:
logistic regression on recordings (`tools/sitting_probability.py`), half of whose weight
is on people who sit, a quarter on walkers and a quarter on others who stand."""

_POSTURE_WINDOW_S = 2.0
"""Time over which log odds are averaged for the posture that a body is given: it is to
last for as long as people sit. Over 1 to 3 s that errs as often, within 1 %."""


@dataclasses.dataclass(frozen=True)
class Seated:
    """Probability that a person sits in a stretch of frames without legs in view."""

    frames: tuple[int, int]
    """First and last frame."""
    probability: float
    """Mean over the frames."""


def legs_unseen(
    keypoint: Bool[np.ndarray, "t 25"], present: Bool[np.ndarray, " t"], fps: float
) -> Bool[np.ndarray, " t"]:
    """Returns the frames of a person about which no knee and no ankle is shown, within
    half of `WINDOW_S` before and after and but for mistakes."""
    shown = (keypoint[:, KNEES_AND_ANKLES] & present[:, None]).mean(axis=1)
    mean = lambda x: uniform_filter1d(x, _odd(WINDOW_S, fps), mode="constant")
    return present & (mean(shown) < _MAX_SHOWN_SHARE * mean(present.astype(float)))


def sitting_probability(
    pelvis: Float[np.ndarray, "t 3"],
    present: Bool[np.ndarray, " t"],
    fps: float,
    eyes: Float[np.ndarray, "t 3"] | None = None,
) -> Float[np.ndarray, " t"]:
    """Returns the probability that a person sits, frame by frame, from the movement of
    the pelvis alone; NaN where the person is absent.

    `pelvis` and the camera's positions `eyes` are in a world whose y axis is up, m.
    With these, movement along the view counts only beyond the noise of depth.
    """
    found = np.full(len(pelvis), np.nan)
    for run in runs(present):
        movement = pelvis_movement(
            pelvis[run], fps, None if eyes is None else eyes[run]
        )
        logit = _LOGIT_AT_1_M + _LOGIT_PER_LOG * log_movement(movement)
        found[run] = 1 / (1 + np.exp(-logit))
    return found


def pelvis_movement(
    pelvis: Float[np.ndarray, "t 3"],
    fps: float,
    eyes: Float[np.ndarray, "t 3"] | None = None,
) -> Float[np.ndarray, " t"]:
    """Returns the standard deviation of the pelvis' horizontal position within the
    `WINDOW_S` about each frame, m; given the camera's positions `eyes`, less the noise
    along the view."""
    place = pelvis[:, _HORIZONTAL_AXES] - pelvis[:1, _HORIZONTAL_AXES]
    mean = lambda x: _mean_over(WINDOW_S, x, fps)
    product = lambda x: x[:, :, None] * x[:, None]
    covariance = mean(product(place)) - product(mean(place))
    variance = np.trace(covariance, axis1=1, axis2=2)
    if eyes is not None:
        view = (pelvis - eyes)[:, _HORIZONTAL_AXES]
        view = view / np.maximum(np.linalg.norm(view, axis=1, keepdims=True), 1e-9)
        along = np.einsum("ti,tij,tj->t", view, covariance, view)
        variance = variance - np.minimum(along, _DEPTH_NOISE_M**2)
    return np.sqrt(np.maximum(variance, 0.0))


def log_movement(movement: Float[np.ndarray, "*t"]) -> Float[np.ndarray, "*t"]:
    """Returns the natural logarithm of a movement in m, which does not fall below that
    of noise."""
    return np.log(np.hypot(movement, _MIN_MOVEMENT_M))


def thigh_angle(joints: Float[np.ndarray, "t 24 3"]) -> Float[np.ndarray, " t"]:
    """Returns the angle of the thighs with the vertical, mean of both, degrees; 0 is
    hanging down."""
    thigh = joints[:, list(KNEES)] - joints[:, list(HIPS)]
    length = np.maximum(np.linalg.norm(thigh, axis=-1), 1e-9)
    down = np.clip(-thigh[..., _UP_AXIS] / length, -1.0, 1.0)
    return np.degrees(np.arccos(down)).mean(axis=1)


def sits(
    joints: Float[np.ndarray, "t 24 3"],
    unseen: Bool[np.ndarray, " t"],
    fps: float,
    eyes: Float[np.ndarray, "t 3"] | None = None,
) -> Bool[np.ndarray, " t"]:
    """Returns the frames `unseen` (`legs_unseen`) in which a person more probably sits
    than stands, by the mean of the log odds over `_POSTURE_WINDOW_S`."""
    chance = sitting_probability(joints[:, PELVIS], unseen, fps, eyes)
    found = np.zeros(len(joints), bool)
    for run in runs(unseen):
        odds = np.log(chance[run] / (1 - chance[run]))
        found[run] = _mean_over(_POSTURE_WINDOW_S, odds, fps) > 0
    return found


def stretches(
    joints: Float[np.ndarray, "t 24 3"],
    unseen: Bool[np.ndarray, " t"],
    fps: float,
    eyes: Float[np.ndarray, "t 3"] | None = None,
) -> tuple[Seated, ...]:
    """Returns the stretches of frames `unseen` (`legs_unseen`), each with its
    probability that the person sits."""
    probability = sitting_probability(joints[:, PELVIS], unseen, fps, eyes)
    return tuple(
        Seated((int(run.start), int(run.stop - 1)), float(probability[run].mean()))
        for run in runs(unseen)
    )


def other_posture_probability(
    joints: Float[np.ndarray, "t 24 3"],
    unseen: Bool[np.ndarray, " t"],
    fps: float,
    eyes: Float[np.ndarray, "t 3"] | None = None,
) -> Float[np.ndarray, " t"]:
    """Returns the probability that a person stands whose body sits, or the reverse; 0
    where legs are seen."""
    probability = sitting_probability(joints[:, PELVIS], unseen, fps, eyes)
    sits = thigh_angle(joints) > SEATED_THIGH_DEGREES
    return np.where(unseen, np.where(sits, 1 - probability, probability), 0.0)


def _mean_over(
    time: float, values: Float[np.ndarray, "*tc"], fps: float
) -> Float[np.ndarray, "*tc"]:
    """Returns the mean over `time` about each frame, at the ends over what there is."""
    mean = lambda x: uniform_filter1d(x, _odd(time, fps), axis=0, mode="constant")
    share = mean(np.ones(len(values))).reshape(-1, *[1] * (values.ndim - 1))
    return mean(values) / share


def _odd(time: float, fps: float) -> int:
    """Returns a time in frames, an odd number."""
    return 2 * round(time * fps / 2) + 1
