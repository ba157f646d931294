"""Undoes a transformation of given keypoints or bodies.

It is a map of the image, a rigid motion of the bodies, or a shift of frame numbers.
"""

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int

from bodyslam_jax.body import BodyModel
from bodyslam_jax.body.skeleton import BODY25_MIRRORED
from bodyslam_jax.diagnostics.agreement.explanations import ImageMap
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.types import Bodies, Keypoints, Sequence


def with_keypoints_mapped_back(sequence: Sequence, image: ImageMap) -> Sequence:
    """Returns the sequence with its keypoints, if any, mapped by the inverse of
    `image`, to pixels of the video."""
    keypoints = sequence.keypoints
    if keypoints is None:
        return sequence
    uv, confidence = image.inverse(keypoints.uv), keypoints.confidence
    uv = np.where(confidence[..., None] > 0, uv, 0.0)
    if image.swap:
        uv, confidence = uv[:, :, BODY25_MIRRORED], confidence[:, :, BODY25_MIRRORED]
    keypoints = dataclasses.replace(keypoints, uv=uv, confidence=confidence)
    return dataclasses.replace(sequence, keypoints=keypoints)


def with_bodies_moved(
    sequence: Sequence,
    body: BodyModel,
    place: Callable[[Float[np.ndarray, "m 3"]], Float[np.ndarray, "m 3"]],
    R: Float[np.ndarray, "3 3"] | None = None,
) -> Sequence:
    """Returns the sequence with the pelvis positions (m, camera frame) of its bodies,
    if any, mapped by `place`, and each body rotated about its pelvis by `R`, if
    given."""
    bodies = sequence.bodies
    if bodies is None:
        return sequence
    at = bodies.present
    J_0 = np.asarray(body.joint_template[0], float)
    J_0 = J_0 + bodies.shapes[at] @ np.asarray(body.joint_shape_dirs[0], float).T
    trans, poses = bodies.trans.copy(), bodies.poses.copy()
    trans[at] = place(trans[at] + J_0) - J_0
    if R is not None:
        root = so3.log(R @ so3.exp(poses[at][:, :3]))
        poses[at] = np.concatenate([root, poses[at][:, 3:]], axis=-1)
    bodies = dataclasses.replace(bodies, trans=trans, poses=poses)
    return dataclasses.replace(sequence, bodies=bodies)


def retimed(
    bundle: Keypoints | Bodies, new: Callable[[Int[np.ndarray, " t"]], np.ndarray]
):
    """Moves frame k of every array to frame `new(k)`, with the length unchanged.

    Frames that would lie outside the video are dropped; frames that receive no data are
    zero, that is, absent.
    """
    arrays = {k: v for k, v in vars(bundle).items() if isinstance(v, np.ndarray)}
    t = next(iter(arrays.values())).shape[1]
    at = new(np.arange(t))
    inside = (at >= 0) & (at < t)
    moved = {k: np.zeros_like(v) for k, v in arrays.items()}
    for name, value in arrays.items():
        moved[name][:, at[inside]] = value[:, inside]
    return dataclasses.replace(bundle, **moved)
