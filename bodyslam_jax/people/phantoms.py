"""Rejects detections that are not people: furniture, mannequins, pictures of people.

Two criteria are used beside the detector's score. The first is a second network,
BlazePose, which examines each detection independently: of 17 false detections on boxes
it found none in the same place, of 28 images of real people cut off or hidden from the
hips down all (and of real people who are mostly hidden by others at least every fourth
frame). The second is motion: within any two seconds at least three keypoints of real
people move relative to the others by 3.2 % of the height and more, on six clips, even
of a sitting person; of three photographs of people that were moved before the camera by
at most 1.5 %, though one or two keypoints with low confidence by up to 10.
"""

import numpy as np
from jaxtyping import Float
from scipy.ndimage import uniform_filter1d

from bodyslam_jax.people.blazepose import turned_square
from bodyslam_jax.people.movenet import MIN_SURE_SCORE, height
from bodyslam_jax.tracking.tracker import Tracklet

MIN_CONFIRMED_HEIGHT_PX = 60.0
"""Height of people below which BlazePose is not used."""
_MIN_CONFIRMED_SHARE = 0.05
"""Share of the frames in which BlazePose must find the person, too."""
_MIN_OBSERVATIONS = 5
"""Number of frames that BlazePose must have examined, and of keypoints that motion is
measured by."""
_MIN_LEG_SCORE, _MIN_FACE_SCORE = 0.3, 0.35
"""Score from which a keypoint of a leg is visible, and mean score from which a face is:
false detections on boxes have faces of 0.02 to 0.41, 0.26 on average; real people
without visible legs 0.40 to 0.73."""
_MIN_LEGS_SHARE = 0.05
"""Share of frames with a visible leg from which a person has legs."""
_MIN_MEAN_SCORE = 0.4
"""Mean score of keypoints below which even legs are no evidence: false detections on
boxes have 0.11 to 0.31."""
_MAX_STILL_S = 2.0
"""Time within which every person moves."""
_MAX_RIGID_MOTION = 0.02
"""Motion of keypoints relative to the others, as a share of the person's height, that a
detector's errors cause on a rigid object."""
_MIN_MOVING_KEYPOINTS = 3
"""Number of keypoints that must move by more than that."""
_SMOOTHING_S = 0.3
"""Averaging time of the keypoints whose motion is measured, which suppresses the
detector's jitter."""
_MIN_SEEN_SHARE = 0.8
"""Share of the frames in which a keypoint must be visible to be compared."""


def is_phantom(
    pieces: list[Tracklet], confirmed: set[tuple[int, int]], fps: float
) -> bool:
    """Returns whether the detections of one person do not show a person.

    Args:
        confirmed: tracklets and frames in which BlazePose found the same person.
    """
    return _is_unconfirmed(pieces, confirmed) or is_rigid(pieces, fps)


def _is_unconfirmed(pieces: list[Tracklet], confirmed: set[tuple[int, int]]) -> bool:
    """Returns whether neither legs, nor a face, nor BlazePose indicate a person."""
    points = np.stack([p for t in pieces for p in t.points])
    known = np.array([(t.number, k) in confirmed for t in pieces for k in t.frames])
    asked = np.array(
        [
            height(p) >= MIN_CONFIRMED_HEIGHT_PX
            and turned_square(p, MIN_SURE_SCORE) is not None
            for p in points
        ]
    )
    score = points[..., 2]
    legless = (score[:, 13:] >= _MIN_LEG_SCORE).any(axis=1).mean() < _MIN_LEGS_SHARE
    if asked.sum() >= _MIN_OBSERVATIONS:
        faint = score.mean() < _MIN_MEAN_SCORE
        return bool((legless or faint) and known[asked].mean() < _MIN_CONFIRMED_SHARE)
    return bool(legless and score[:, :5].mean() < _MIN_FACE_SCORE)


def is_rigid(pieces: list[Tracklet], fps: float) -> bool:
    """Returns whether nothing but the view changes, for longer than people keep still.

    A change of the view of a rigid object is modelled as affine.
    """
    long = [t for t in pieces if t.frames[-1] - t.frames[0] >= _MAX_STILL_S * fps]
    return bool(long) and all(motion(t, fps) < _MAX_RIGID_MOTION for t in long)


def motion(tracklet: Tracklet, fps: float) -> float:
    """Returns the motion of a person's keypoints relative to the others, as a share of
    the person's height: that of the keypoint with the third largest motion.

    It is infinite if few keypoints are visible most of the time.
    """
    points = np.stack(tracklet.points)
    seen = points[..., 2] >= _MIN_LEG_SCORE
    kept = seen.mean(axis=0) >= _MIN_SEEN_SHARE
    if kept.sum() <= _MIN_OBSERVATIONS:
        return np.inf
    weight = np.where(seen, points[..., 2], 1e-3)[:, kept]
    away = _against_the_others(points[:, kept, :2], weight)
    window = max(1, round(_SMOOTHING_S * fps))
    smooth = uniform_filter1d(away, window, axis=0, mode="nearest")
    low, high = np.quantile(smooth, [0.05, 0.95], axis=0)
    size = float(np.median([height(p) for p in tracklet.points]))
    moved = np.sort(np.linalg.norm(high - low, axis=-1))
    return float(moved[-_MIN_MOVING_KEYPOINTS]) / size


def _against_the_others(
    uv: Float[np.ndarray, "t k 2"], weight: Float[np.ndarray, "t k"]
) -> Float[np.ndarray, "t k 2"]:
    """Returns the residuals of the affine maps from the median shape to each frame,
    px."""
    shape = np.median(uv - uv.mean(axis=1, keepdims=True), axis=0)
    design = np.column_stack([shape, np.ones(len(shape))])
    out = np.empty_like(uv)
    for k, (one, w) in enumerate(zip(uv, np.sqrt(weight), strict=True)):
        fit = np.linalg.lstsq(w[:, None] * design, w[:, None] * one, rcond=None)[0]
        out[k] = one - design @ fit
    return out
