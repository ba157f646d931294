"""Determines which parts of people are visible in the image, independently of the
source of their bodies.

A regressor returns a complete body for a person who is cut off at the waist: its legs
are a guess, often a mean posture that stands still while the person walks. A keypoint
is shown where the detector is at least half as confident as for this person's most
confident keypoints: the error of less confident ones is two to five times as large
(`benchmarks/video.md`). In a frame in which the detector lost somebody who has a body
there, a keypoint is shown if it was in the nearest frame with keypoints. For people
without any keypoints, the points of the body are shown that project into the image, and
onto the masks of people if there are any: occlusions are then unknown.
"""

import dataclasses
from collections.abc import Iterator

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import uniform_filter1d

from bodyslam_jax.body import BodyModel
from bodyslam_jax.body.skeleton import BODY25, HEAD, KEYPOINT_JOINT, pose_joints
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.geometry.arrays import runs
from bodyslam_jax.geometry.camera import MIN_DEPTH, project_rows
from bodyslam_jax.people.costs import KEYPOINT_SIGMA
from bodyslam_jax.people.keypoint_errors import keypoint_sigma
from bodyslam_jax.sfm import person_masks
from bodyslam_jax.types import Bodies, Sequence

MIN_CONFIDENCE_RATIO = 0.5
"""Least confidence of a shown keypoint, relative to that of the person's most confident
ones."""
KNEES_AND_ANKLES = tuple(
    BODY25[f"{side}_{name}"] for name in ("knee", "ankle") for side in ("left", "right")
)
MIN_SHOWN_SHARE = 0.55
"""Share of knees and ankles that must be shown: with fewer, postures err by twice as
much as those of people in full view (`benchmarks/video.md`)."""
_STRIDE_S = 1.0
"""Time over which that share is averaged. In a stride each leg hides the other once."""
_MASK_MARGIN = 0.02
"""Error of a projected joint, relative to a quarter of the image's height, by which
masks are widened."""


def shown_keypoints(sequence: Sequence, body: BodyModel) -> Bool[np.ndarray, "h t 25"]:
    """Returns which keypoints of BODY_25 of all people are visible in the image."""
    keypoints, bodies = sequence.keypoints, sequence.bodies
    there = np.zeros((people_in(sequence), sequence.num_frames), bool)
    shown = np.zeros((*there.shape, 25), bool)
    if keypoints is not None:
        for h in range(len(shown)):
            sigma = keypoint_sigma(keypoints, sequence.intrinsics, h)
            shown[h] = sigma <= KEYPOINT_SIGMA / MIN_CONFIDENCE_RATIO
        there = np.asarray((keypoints.confidence > 0).any(axis=-1))
    if bodies is None or not (bodies.present & ~there).any():
        return shown
    inside = _inside(sequence, bodies, body)
    for h, frames in enumerate(there):
        lost = np.flatnonzero(bodies.present[h] & ~frames)
        detected = np.flatnonzero(frames)
        here = inside[h, lost]
        if len(detected):
            apart = np.abs(lost[:, None] - detected)
            here = here & shown[h, detected[apart.argmin(axis=1)]]
        shown[h, lost] = here
    return shown


def legs_shown(
    shown: Bool[np.ndarray, "h t 25"], present: Bool[np.ndarray, "h t"], fps: float
) -> Bool[np.ndarray, "h t"]:
    """Returns the frames in which a person's legs, and so the steps, are not only
    inferred.

    Legs are inferred in stretches of frames with less than `MIN_SHOWN_SHARE` of the
    knees and ankles shown, if the mean over the second around one of the frames is
    below it, too: legs that hide each other momentarily are not inferred. Frames in
    which the person is absent do not count.
    """
    share = shown[..., KNEES_AND_ANKLES].mean(axis=-1)
    window = max(1, round(_STRIDE_S * fps))
    mean = lambda x: uniform_filter1d(x, window, mode="constant")
    found = np.zeros(present.shape, bool)
    for h, frames in enumerate(present):
        for run in runs(frames):
            here = share[h, run]
            lasting = mean(here) < (MIN_SHOWN_SHARE - 1e-9) * mean(np.ones(len(here)))
            inferred = np.zeros(len(here), bool)
            for stretch in runs(lasting | (here < MIN_SHOWN_SHARE)):
                inferred[stretch] = lasting[stretch].any()
            found[h, run] = ~inferred
    return found


def without_keypoints(sequence: Sequence) -> Bool[np.ndarray, " h"]:
    """Returns the people who have a body but no keypoints, whose occlusions are
    unknown."""
    if sequence.bodies is None:
        return np.zeros(people_in(sequence), bool)
    detected = np.zeros(people_in(sequence), bool)
    if sequence.keypoints is not None:
        detected = np.asarray((sequence.keypoints.confidence > 0).any(axis=(1, 2)))
    return np.logical_and(sequence.bodies.present.any(axis=1), ~detected)


def people_in(sequence: Sequence) -> int:
    """Returns the number of people, by keypoints or by bodies."""
    if sequence.keypoints is not None:
        return len(sequence.keypoints.uv)
    return 0 if sequence.bodies is None else len(sequence.bodies.present)


def joints_of(bodies: Bodies, body: BodyModel) -> Float[np.ndarray, "m 22 3"]:
    """Returns the first 22 joints in the camera frame, m, of all bodies that are
    present."""
    template = np.asarray(body.joint_template, float)[:22]
    directions = np.asarray(body.joint_shape_dirs, float)[:22]
    at = bodies.present
    rest = template + np.einsum("jcb,mb->mjc", directions, bodies.shapes[at])
    angles = bodies.poses[at].reshape(-1, 24, 3)[:, :22]
    return pose_joints(so3.exp(angles), rest, rest[:, 0] + bodies.trans[at])[1]


def _inside(
    sequence: Sequence, bodies: Bodies, body: BodyModel
) -> Bool[np.ndarray, "h t 25"]:
    """Returns which points of bodies project into the image, and onto its masks of
    people."""
    camera = sequence.intrinsics
    joints = joints_of(bodies, body)
    uv = project_rows(jnp.asarray(camera.params, float), joints.reshape(-1, 3))
    uv = np.rint(uv).reshape(*joints.shape[:2], 2)
    valid = (uv >= 0).all(axis=-1) & (uv < [camera.width, camera.height]).all(axis=-1)
    valid &= joints[..., 2] > MIN_DEPTH
    if sequence.masks is not None:
        frame = np.nonzero(bodies.present)[1]
        for k, mask in enumerate(_masks(sequence)):
            u, v = np.moveaxis(np.where(valid[..., None], uv, 0)[frame == k], -1, 0)
            valid[frame == k] &= mask[v.astype(int), u.astype(int)] > 0
    inside = np.zeros((*bodies.present.shape, 25), bool)
    inside[bodies.present] = valid[:, _NEAREST_JOINTS]
    return inside


def _masks(sequence: Sequence) -> Iterator[np.ndarray]:
    """Yields the given masks of people, one per frame, 0 elsewhere."""
    alone = dataclasses.replace(sequence, keypoints=None, detected=None)
    for mask in person_masks(alone, _MASK_MARGIN):
        assert mask is not None
        yield mask


def _nearest_joint(name: str) -> int:
    """Returns SMPL's joint that coincides with a keypoint of BODY_25, or is nearest to
    it."""
    side, _, part = name.partition("_")
    part = {"heel": "ankle", "big_toe": "foot", "small_toe": "foot"}.get(part, part)
    return KEYPOINT_JOINT.get(f"{side}_{part}", KEYPOINT_JOINT.get(name, HEAD))


_NEAREST_JOINTS = [_nearest_joint(name) for name in BODY25]
