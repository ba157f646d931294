"""Which parts of people were measured, which were inferred, and how sure joints are.

A keypoint is measured where something in the image shows it (`people.shown`). What
nothing shows, hidden limbs and those out of the image, is inferred: from priors of
posture and motion, or by a regressor, whose bodies are whole in any case.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax import people
from bodyslam_jax.body import BodyModel
from bodyslam_jax.body.skeleton import BODY25
from bodyslam_jax.people.keypoint_errors import DETECTOR_FLOOR
from bodyslam_jax.types import JointEstimate, Sequence

_SIDES = ("left", "right")
_points = lambda *names: tuple(BODY25[f"{s}_{n}"] for n in names for s in _SIDES)
LIMBS: dict[str, tuple[int, ...]] = {
    "arms": _points("elbow", "wrist"),
    "legs": _points("knee", "ankle"),
    "feet": _points("big_toe", "heel"),
}
"""Keypoints of BODY_25 by which a limb is measured."""

_TRUNK, _TRUNK_GIVEN = 0.03, 0.016
_OF_JOINT: dict[str, tuple[tuple[int, int], float, float, float]] = {
    "hip": ((1, 2), 0.040, 0.05, 0.019),
    "knee": ((4, 5), 0.072, 0.14, 0.026),
    "ankle": ((7, 8), 0.095, 0.19, 0.028),
    "foot": ((10, 11), 0.109, 0.19, 0.030),
    "shoulder": ((16, 17), 0.037, 0.055, 0.019),
    "elbow": ((18, 19), 0.041, 0.045, 0.024),
    "wrist": ((20, 21), 0.093, 0.12, 0.039),
    "hand": ((22, 23), 0.12, 0.14, 0.053),
}
"""Joints (left, right); RMS error where measured; what is added (in squares) where the
joint is hidden for long; RMS error with a regressor's body. All in m, of 28 rendered
sequences, after alignment of the body (`benchmarks/video.md`); bodies there were
simulated without regard to what hides a limb, so that what is added is that of bodies
fitted to keypoints."""
_BY_KEYPOINT = {"foot": ("ankle", "big_toe", "heel"), "hand": ("wrist",)}
"""Keypoints any of which measures a joint, where it is not the one of its name."""
_FORGETS = 0.1
"""s: time constant with which the error of a hidden joint grows to its full size, to
the nearest frame in which it is measured."""
_USUAL = 0.028
"""m: a detector's error of a knee or an ankle of large people (`KEYPOINT_SIGMA`)."""


@dataclasses.dataclass(frozen=True)
class Measured:
    """What was measured of `h` people in `t` frames."""

    keypoint: Bool[np.ndarray, "h t 25"]
    """Keypoints of BODY_25 that something in the image shows."""
    body: Bool[np.ndarray, "h t"]
    """Frames with a body of a regressor, or that was given."""
    joint_sigma: Float[np.ndarray, "h t 24"]
    """Expected error (RMS distance) of each joint within the body, m; 0 where the
    person is absent. Errors of the body's place and size are not in it."""

    def shares(self, person: int, present: Bool[np.ndarray, " t"]) -> dict[str, float]:
        """Share of a person's frames and keypoints in which each limb was not measured.

        A limb is left out where the detector knows none of its keypoints. Empty for
        somebody who is in no frame.
        """
        if not present.any():
            return {}
        found = {}
        for limb, points in LIMBS.items():
            here = self.keypoint[person][:, points]
            if here.any() or limb != "feet":
                found[limb] = float(1 - here[present].mean())
        return found


def measured(sequence: Sequence, joint: JointEstimate, body: BodyModel) -> Measured:
    """What of the people of `joint` was measured, and how sure their joints are."""
    h, t = joint.present.shape
    keypoint, given = np.zeros((h, t, 25), bool), np.zeros((h, t), bool)
    if h:
        keypoint = people.shown_keypoints(sequence, body)
    if sequence.bodies is not None:
        given = sequence.bodies.present & joint.present
    sigma = np.zeros((h, t, 24))
    for k in range(h):
        pixels = pixels_per_metre(joint, k)
        sigma[k] = joint_sigma(keypoint[k], given[k], pixels, sequence.fps)
    sigma = np.where(joint.present[..., None], sigma, 0.0)
    return Measured(keypoint, given, sigma)


def joint_sigma(
    keypoint: Bool[np.ndarray, "t 25"],
    given: Bool[np.ndarray, " t"],
    pixels: Float[np.ndarray, " t"],
    fps: float,
) -> Float[np.ndarray, "t 24"]:
    """Expected error of a person's joints within the body, m.

    Args:
        keypoint: those that were measured.
        given: frames with a regressor's body.
        pixels: of one metre at the person's depth; the error of small people is that
            of the detector's pixels.
    """
    small = np.hypot(1.0, DETECTOR_FLOOR / (_USUAL * np.maximum(pixels, 1e-3)))
    sigma = np.where(given, _TRUNK_GIVEN, _TRUNK * small)[:, None].repeat(24, axis=1)
    for name, (joints, usual, hidden, with_body) in _OF_JOINT.items():
        for joint, side in zip(joints, _SIDES, strict=True):
            names = _BY_KEYPOINT.get(name, (name,))
            points = [BODY25[f"{side}_{one}"] for one in names]
            here = np.asarray(keypoint[:, points].any(axis=1))
            grown = 1 - np.exp(-_time_to_nearest(here, fps) / _FORGETS)
            known = np.where(given, with_body, usual * small)
            sigma[:, joint] = np.sqrt(known**2 + hidden**2 * grown)
    return sigma


def pixels_per_metre(joint: JointEstimate, person: int) -> Float[np.ndarray, " t"]:
    """Pixels of a metre at the depth of a person's pelvis, in each frame."""
    depth = np.maximum(joint.roots[person, :, 2, 3], 1e-3)
    return float(np.mean(joint.intrinsics[:2])) / depth


def _time_to_nearest(
    here: Bool[np.ndarray, " t"], fps: float
) -> Float[np.ndarray, " t"]:
    """Time from each frame to the nearest one of `here`, s; infinite if there is
    none."""
    frames = np.flatnonzero(here)
    if not len(frames):
        return np.full(len(here), np.inf)
    every = np.arange(len(here))
    after = np.searchsorted(frames, every).clip(max=len(frames) - 1)
    before = np.maximum(after - 1, 0)
    apart = np.minimum(abs(every - frames[after]), abs(every - frames[before]))
    return apart / fps
