"""Detections that are no people: furniture, mannequins, pictures of people.

Two witnesses beside the detector's score are asked. A second network, BlazePose, which
looks at each detection by itself: of 17 false detections on boxes it saw none in the
same place, of 28 images of real people cut off or hidden from the hips down all (and of
real people who are mostly hidden by others at least every fourth frame). And motion:
within any two seconds at least three keypoints of real people move against the others
by 3.2 % of the height and more, on six clips, of somebody who sits, too; of three
photographs of people that were moved before the camera by at most 1.5 %, though one or
two keypoints, of which the detector is not sure, by up to 10.
"""

import numpy as np
from jaxtyping import Float
from scipy.ndimage import uniform_filter1d

from bodyslam_jax.people.blazepose import turned_square
from bodyslam_jax.people.movenet import SURE
from bodyslam_jax.people.tracking import Tracklet, height

SMALLEST_CONFIRMED = 60.0
"""Height of people, px, below which BlazePose is of no use."""
_CONFIRMED = 0.05
"""Share of the frames in which BlazePose must find the person, too."""
_FEWEST = 5
"""Frames that BlazePose must have looked at, for its word to count."""
_LEG, _FACE = 0.3, 0.35
"""Score of a leg's keypoint that is seen, and mean score of a face's that are: false
detections on boxes have faces of 0.02 to 0.41, in the mean 0.26; real people without
legs 0.40 to 0.73."""
_LEGS = 0.05
"""Share of frames with a leg that is seen, below which a person has none."""
_FAINT = 0.4
"""Mean score of keypoints below which also legs are no evidence: false detections on
boxes have 0.11 to 0.31."""
_STILL = 2.0
"""s: time over which anybody moves."""
_RIGID = 0.02
"""Motion of keypoints against the others, of the person's height, by which a detector
errs on a rigid thing."""
_MOVING = 3
"""Keypoints of which all have to move as much."""
_SMOOTH = 0.3
"""s: average of keypoints whose motion counts: jitter of the detector does not."""
_OFTEN = 0.8
"""Share of the frames in which a keypoint must be seen, to be compared."""


def is_phantom(
    pieces: list[Tracklet], confirmed: set[tuple[int, int]], fps: float
) -> bool:
    """Whether the detections of one person are of no person.

    Args:
        confirmed: tracklets and frames in which BlazePose found the same person.
    """
    return _is_unconfirmed(pieces, confirmed) or is_rigid(pieces, fps)


def _is_unconfirmed(pieces: list[Tracklet], confirmed: set[tuple[int, int]]) -> bool:
    """Whether neither legs, a face nor BlazePose speak for a person."""
    points = np.stack([p for t in pieces for p in t.points])
    known = np.array([(t.number, k) in confirmed for t in pieces for k in t.frames])
    asked = np.array(
        [
            height(p) >= SMALLEST_CONFIRMED and turned_square(p, SURE) is not None
            for p in points
        ]
    )
    score = points[..., 2]
    legless = (score[:, 13:] >= _LEG).any(axis=1).mean() < _LEGS
    if asked.sum() >= _FEWEST:
        faint = score.mean() < _FAINT
        return bool((legless or faint) and known[asked].mean() < _CONFIRMED)
    return bool(legless and score[:, :5].mean() < _FACE)


def is_rigid(pieces: list[Tracklet], fps: float) -> bool:
    """Whether nothing moves but the view, for as long as anybody keeps still.

    A change of the view of a rigid thing is taken to be affine.
    """
    long = [t for t in pieces if t.frames[-1] - t.frames[0] >= _STILL * fps]
    return bool(long) and all(motion(t, fps) < _RIGID for t in long)


def motion(tracklet: Tracklet, fps: float) -> float:
    """Motion of a person's keypoints against the others, of the person's height: that
    of the third that moves most. Infinite where few are seen most of the time.
    """
    points = np.stack(tracklet.points)
    seen = points[..., 2] >= _LEG
    kept = seen.mean(axis=0) >= _OFTEN
    if kept.sum() <= _FEWEST:
        return np.inf
    weight = np.where(seen, points[..., 2], 1e-3)[:, kept]
    away = _against_the_others(points[:, kept, :2], weight)
    window = max(1, round(_SMOOTH * fps))
    smooth = uniform_filter1d(away, window, axis=0, mode="nearest")
    low, high = np.quantile(smooth, [0.05, 0.95], axis=0)
    size = float(np.median([height(p) for p in tracklet.points]))
    moved = np.sort(np.linalg.norm(high - low, axis=-1))
    return float(moved[-_MOVING]) / size


def _against_the_others(
    uv: Float[np.ndarray, "t k 2"], weight: Float[np.ndarray, "t k"]
) -> Float[np.ndarray, "t k 2"]:
    """Residuals of the affine maps from the median shape to each frame, px."""
    shape = np.median(uv - uv.mean(axis=1, keepdims=True), axis=0)
    design = np.column_stack([shape, np.ones(len(shape))])
    out = np.empty_like(uv)
    for k, (one, w) in enumerate(zip(uv, np.sqrt(weight), strict=True)):
        fit = np.linalg.lstsq(w[:, None] * design, w[:, None] * one, rcond=None)[0]
        out[k] = one - design @ fit
    return out
