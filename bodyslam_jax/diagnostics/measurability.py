"""Figures that tell whether a person can be measured, and which share was measured.

People who are small in the image, or far and seen briefly, have no speed and no path in
metres; of people whose legs are hidden the posture is inferred.
"""

import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax import people
from bodyslam_jax.body.skeleton import PELVIS
from bodyslam_jax.diagnostics.measured import Measured, pixels_per_metre
from bodyslam_jax.geometry.arrays import runs
from bodyslam_jax.people.costs import KEYPOINT_SIGMA
from bodyslam_jax.people.keypoint_errors import CORRELATION_TIME, MIN_DETECTOR_SIGMA_PX
from bodyslam_jax.types import JointEstimate, Keypoints, Result, Sequence

_HORIZONTAL_AXES = [0, 2]
_MIN_KEYPOINTS = 3
"""Number of keypoints from whose spread in the image a depth is measured."""
_MIN_STRETCH_S = 1.0
"""In a shorter stretch, s, most frames have no prediction by the motion model, which
reads the preceding half second."""
_WALKING_SPEED_M_S = 1.25
"""Typical walking speed."""


def inferred_legs(
    found: Measured, person: int, present: Bool[np.ndarray, " t"], fps: float
) -> Bool[np.ndarray, " t"]:
    """Returns the frames in which a person's legs were mostly inferred
    (`people.legs_shown`)."""
    shown = people.legs_shown(found.keypoint[person][None], present[None], fps)
    return present & ~shown[0]


def measurement_figures(
    sequence: Sequence, found: Measured, result: Result
) -> list[dict[str, float]]:
    """Returns, for each person, the figures of measurability that `PERSON_CHECKS`
    judge.

    They are the shares of frames with inferred legs and in short stretches (%), the
    speed across gaps (m/s), and the overlap with others at the first appearance (%).
    """
    within = _appears_within(sequence.keypoints, result.present)
    out = []
    for h, present in enumerate(result.present):
        figures = {
            "speed_across_gap": _speed_across_gaps(
                result.joints[h, :, PELVIS], present, result.timestamps
            ),
            "appears_within": within[h],
            "seen_in_pieces": _in_pieces(present, sequence.fps),
        }
        if present.any():
            inferred = inferred_legs(found, h, present, sequence.fps)
            figures["legs_inferred"] = 100 * float(inferred[present].mean())
        out.append(figures)
    return out


def leg_in_image(joint: JointEstimate, result: Result, person: int) -> float:
    """Returns the length of a stretched leg at the person's depth, px (median over
    frames)."""
    present = result.present[person]
    if not present.any():
        return np.nan
    hip, knee, ankle = result.joints[person, present][:, [1, 4, 7]].swapaxes(0, 1)
    leg = np.linalg.norm(hip - knee, axis=1) + np.linalg.norm(knee - ankle, axis=1)
    return float(np.median(leg * pixels_per_metre(joint, person)[present]))


def speed_noise(
    sequence: Sequence, found: Measured, joint: JointEstimate, person: int
) -> float:
    """Returns the standard deviation, due to keypoint noise, of a person's mean speed
    along the view, m/s.

    It is the standard error of the slope of a line through the depths of the person's
    longest stretch. A depth is measured by the spread of the keypoints in the image;
    their error is the usual one of detectors, at least a pixel, and correlated over
    0.15 s. NaN without keypoints, infinite where too few are visible.
    """
    if sequence.keypoints is None or not joint.present[person].any():
        return np.nan
    stretch = max(runs(joint.present[person]), key=lambda run: run.stop - run.start)
    here = found.keypoint[person, stretch]
    here = here & (sequence.keypoints.confidence[person, stretch] > 0)
    enough = here.sum(axis=1) >= _MIN_KEYPOINTS
    if not enough.any():
        return np.inf
    pixels = pixels_per_metre(joint, person)[stretch][enough]
    sigma = np.hypot(KEYPOINT_SIGMA * pixels[:, None], MIN_DETECTOR_SIGMA_PX)
    weight = np.where(here[enough], sigma**-2, 0.0)
    uv = sequence.keypoints.uv[person, stretch][enough]
    centre = (weight[..., None] * uv).sum(1) / weight.sum(1)[:, None]
    apart = ((uv - centre[:, None]) ** 2).sum(-1)
    relative = np.maximum((weight * apart).sum(1), 1e-12) ** -0.5
    depth = joint.roots[person, stretch, 2, 3][enough]
    seconds = len(here) / sequence.fps
    independent = max(seconds / CORRELATION_TIME, 1.0)
    error = float(np.median(depth * relative))
    return error * float(np.sqrt(12 / independent)) / seconds


def relative_speed_error(sigma: float, speed: float) -> float:
    """Returns the standard deviation of a speed in % of that speed, or of a typical
    walking speed if the person is slower."""
    return 100 * sigma / max(speed, _WALKING_SPEED_M_S)


def _speed_across_gaps(
    pelvis: Float[np.ndarray, "t 3"],
    present: Bool[np.ndarray, " t"],
    times: Float[np.ndarray, " t"],
) -> float:
    """Returns the greatest speed over the ground from the end of a stretch to the start
    of the next, m/s; NaN where there is one stretch only."""
    stretches = runs(present)
    speeds = [
        np.linalg.norm((pelvis[b.start] - pelvis[a.stop - 1])[_HORIZONTAL_AXES])
        / (times[b.start] - times[a.stop - 1])
        for a, b in zip(stretches[:-1], stretches[1:], strict=True)
    ]
    return float(max(speeds)) if speeds else np.nan


def _in_pieces(present: Bool[np.ndarray, " t"], fps: float) -> float:
    """Returns the share of the frames that lie in stretches shorter than a second, %; 0
    if there is only one stretch."""
    lengths = np.array([run.stop - run.start for run in runs(present)])
    if len(lengths) < 2:
        return 0.0
    return 100 * float(lengths[lengths < _MIN_STRETCH_S * fps].sum() / lengths.sum())


def _appears_within(
    keypoints: Keypoints | None, present: Bool[np.ndarray, "h t"]
) -> list[float]:
    """Returns the share of each person's region of the image that another person covers
    who was there before, in the frame in which the person first appears, %; NaN if that
    is the first frame."""
    if keypoints is None:
        return [np.nan] * len(present)
    detected = (keypoints.confidence > 0)[..., None]
    low = np.where(detected, keypoints.uv, np.inf).min(axis=2)
    high = np.where(detected, keypoints.uv, -np.inf).max(axis=2)
    found = []
    for h, there in enumerate(present):
        k = int(there.argmax())
        others = present[:, k] & present[:, :k].any(axis=1) & detected[:, k].any((1, 2))
        if not there.any() or k == 0 or not others.any() or not detected[h, k].any():
            found.append(np.nan)
            continue
        common = np.minimum(high[h, k], high[others, k])
        common = np.maximum(common - np.maximum(low[h, k], low[others, k]), 0)
        area = max(float(np.prod(high[h, k] - low[h, k])), 1.0)
        found.append(100 * float(common.prod(axis=1).max()) / area)
    return found
