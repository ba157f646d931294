"""Which parts of people were measured, which inferred, and the expected joint errors.

A keypoint is measured where it is visible in the image (`people.shown`). Hidden limbs
and those outside the image are inferred: by priors of posture and motion, or by a
regressor, whose bodies are complete in any case. Of the squared error of a measured
knee or ankle somewhat more than half is along the view, of that of a hidden one 0.2 to
0.45 (`benchmarks/plausibility.md`).
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax import people
from bodyslam_jax.body import BodyModel
from bodyslam_jax.body.skeleton import BODY25
from bodyslam_jax.diagnostics import seated
from bodyslam_jax.people.keypoint_errors import MIN_DETECTOR_SIGMA_PX
from bodyslam_jax.types import JointEstimate, Result, Sequence

_SIDES = ("left", "right")
_points = lambda *names: tuple(BODY25[f"{s}_{n}"] for n in names for s in _SIDES)
LIMBS: dict[str, tuple[int, ...]] = {
    "arms": _points("elbow", "wrist"),
    "legs": _points("knee", "ankle"),
    "feet": _points("big_toe", "heel"),
}
"""Keypoints of BODY_25 whose visibility means that the limb is measured."""

_TRUNK_SIGMA_M, _TRUNK_SIGMA_WITH_BODY_M = 0.03, 0.016
"""RMS error of the joints of the trunk, from keypoints and with a regressor's body."""
_JOINT_ERRORS_M: dict[str, tuple[tuple[int, int], float, float, float]] = {
    "hip": ((1, 2), 0.040, 0.05, 0.019),
    "knee": ((4, 5), 0.072, 0.14, 0.026),
    "ankle": ((7, 8), 0.095, 0.19, 0.028),
    "foot": ((10, 11), 0.109, 0.19, 0.030),
    "shoulder": ((16, 17), 0.037, 0.055, 0.019),
    "elbow": ((18, 19), 0.041, 0.045, 0.024),
    "wrist": ((20, 21), 0.093, 0.12, 0.039),
    "hand": ((22, 23), 0.12, 0.14, 0.053),
}
"""For each joint: its indices (left, right); the RMS error where it is measured; the
error added in squares where it is hidden for long; the RMS error with a regressor's
body. All are in m, from 28 rendered sequences, after alignment of the body
(`benchmarks/video.md`). Bodies there were simulated without regard to occlusion, so the
added error is that of bodies fitted to keypoints."""
_OTHER_POSTURE_ERRORS_M = {"knee": 0.43, "ankle": 0.49, "foot": 0.48}
"""Error added in squares where the person sits and the body stands, or the reverse, m:
guessed legs of people on stools whose knees, ankles and feet are hidden, after
alignment of the other joints (`benchmarks/plausibility.md`). A thigh of 0.38 m that is
level, not upright, is 0.54 m away at the knee and at all that hangs from it."""
_JOINT_KEYPOINTS = {"foot": ("ankle", "big_toe", "heel"), "hand": ("wrist",)}
"""Keypoints any of which measures a joint, where their names differ from the
joint's."""
_ERROR_GROWTH_TIME_S = 0.1
"""Time constant with which the error of a hidden joint grows to its full size, with the
time to the nearest frame in which the joint is measured."""
_KEYPOINT_ERROR_M = 0.028
"""Detection error of a knee or an ankle of a person who is large in the image
(`KEYPOINT_SIGMA`)."""


@dataclasses.dataclass(frozen=True)
class Measured:
    """Visibility of keypoints, frames with bodies, and joint errors of `h` people in
    `t` frames."""

    keypoint: Bool[np.ndarray, "h t 25"]
    """Keypoints of BODY_25 that are visible in the image."""
    body: Bool[np.ndarray, "h t"]
    """Frames with a body of a regressor, or given by the user."""
    joint_sigma: Float[np.ndarray, "h t 24"]
    """Expected error (RMS distance) of each joint within the body, m; 0 where the
    person is absent. It excludes errors of the body's position and size; where legs are
    not in view, those are the trunk's and the arms'."""
    legs_unseen: Bool[np.ndarray, "h t"]
    """Frames about which no knee and no ankle is visible (`seated.legs_unseen`)."""

    def shares(self, person: int, present: Bool[np.ndarray, " t"]) -> dict[str, float]:
        """Returns the share of a person's frames and keypoints, by limb, that were not
        measured.

        Feet are left out if the detector provides none of their keypoints. Empty for a
        person who is in no frame.
        """
        if not present.any():
            return {}
        found = {}
        for limb, points in LIMBS.items():
            here = self.keypoint[person][:, points]
            if here.any() or limb != "feet":
                found[limb] = float(1 - here[present].mean())
        return found


def measured(
    sequence: Sequence, joint: JointEstimate, body: BodyModel, result: Result
) -> Measured:
    """Returns which parts of the people of `joint` were measured, and the expected
    errors of their joints; `result` is the metric, upright version of `joint`."""
    h, t = joint.present.shape
    keypoint, given = np.zeros((h, t, 25), bool), np.zeros((h, t), bool)
    if h:
        keypoint = people.shown_keypoints(sequence, body)
    if sequence.bodies is not None:
        given = sequence.bodies.present & joint.present
    sigma, unseen = np.zeros((h, t, 24)), np.zeros((h, t), bool)
    for k in range(h):
        pixels = pixels_per_metre(joint, k)
        unseen[k] = seated.legs_unseen(keypoint[k], joint.present[k], sequence.fps)
        other = seated.other_posture_probability(
            result.joints[k], unseen[k], sequence.fps, result.T_WC[:, :3, 3]
        )
        sigma[k] = joint_sigma(keypoint[k], given[k], pixels, sequence.fps, other)
    sigma = np.where(joint.present[..., None], sigma, 0.0)
    return Measured(keypoint, given, sigma, unseen)


def joint_sigma(
    keypoint: Bool[np.ndarray, "t 25"],
    given: Bool[np.ndarray, " t"],
    pixels: Float[np.ndarray, " t"],
    fps: float,
    other_posture: Float[np.ndarray, " t"],
) -> Float[np.ndarray, "t 24"]:
    """Returns the expected error of a person's joints within the body, m.

    Args:
        keypoint: keypoints of BODY_25 that were measured.
        given: frames with a regressor's body.
        pixels: pixels per metre at the person's depth. For people who are small in the
            image, the detector's error in pixels dominates.
    """
    small = np.hypot(
        1.0, MIN_DETECTOR_SIGMA_PX / (_KEYPOINT_ERROR_M * np.maximum(pixels, 1e-3))
    )
    sigma = np.where(given, _TRUNK_SIGMA_WITH_BODY_M, _TRUNK_SIGMA_M * small)[
        :, None
    ].repeat(24, axis=1)
    for name, (joints, usual, hidden, with_body) in _JOINT_ERRORS_M.items():
        for joint, side in zip(joints, _SIDES, strict=True):
            names = _JOINT_KEYPOINTS.get(name, (name,))
            points = [BODY25[f"{side}_{one}"] for one in names]
            here = np.asarray(keypoint[:, points].any(axis=1))
            grown = 1 - np.exp(-_time_to_nearest(here, fps) / _ERROR_GROWTH_TIME_S)
            known = np.where(given, with_body, usual * small)
            other = other_posture * _OTHER_POSTURE_ERRORS_M.get(name, 0.0) ** 2
            sigma[:, joint] = np.sqrt(known**2 + hidden**2 * grown + other)
    return sigma


def pixels_per_metre(joint: JointEstimate, person: int) -> Float[np.ndarray, " t"]:
    """Returns the number of pixels per metre at the depth of a person's pelvis, in each
    frame."""
    depth = np.maximum(joint.roots[person, :, 2, 3], 1e-3)
    return float(np.mean(joint.intrinsics[:2])) / depth


def _time_to_nearest(
    here: Bool[np.ndarray, " t"], fps: float
) -> Float[np.ndarray, " t"]:
    """Returns the time from each frame to the nearest frame marked by `here`, s;
    infinite if there is none."""
    frames = np.flatnonzero(here)
    if not len(frames):
        return np.full(len(here), np.inf)
    every = np.arange(len(here))
    after = np.searchsorted(frames, every).clip(max=len(frames) - 1)
    before = np.maximum(after - 1, 0)
    apart = np.minimum(abs(every - frames[after]), abs(every - frames[before]))
    return apart / fps
