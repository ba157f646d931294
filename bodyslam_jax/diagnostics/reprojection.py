"""Reprojection errors of a joint estimate, per frame and per person."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from bodyslam_jax.body import BodyModel, local_keypoints
from bodyslam_jax.geometry.camera import project_rows
from bodyslam_jax.geometry.lengths import lengthened, padded_length, shortened
from bodyslam_jax.types import JointEstimate, Sequence, SfmResult


def per_frame(
    sequence: Sequence, body: BodyModel, cameras: SfmResult, joint: JointEstimate
) -> dict[str, list[float | None]]:
    """Returns figures of each frame by name; `None` where a frame has none.

    They are the numbers of tracks and inliers, and the mean reprojection errors of
    landmarks and of keypoints (px).
    """
    t = sequence.num_frames
    tracks, keep = cameras.tracks, cameras.keep
    count = np.bincount(tracks.frame, minlength=t)
    found: dict[str, list[float | None]] = {"tracks": count.astype(float).tolist()}
    if cameras.kind == "moving":
        T = joint.cameras[tracks.frame]
        offset = joint.landmarks[tracks.landmark] - T[:, :3, 3]
        p_C = np.einsum("mji,mj->mi", T[:, :3, :3], offset)
        error = project_rows(joint.intrinsics, p_C) - tracks.uv
        length = np.linalg.norm(error, axis=-1)
        inliers = np.bincount(tracks.frame[keep], minlength=t)
        found["inliers"] = inliers.astype(float).tolist()
        found["reprojection_px"] = _means(tracks.frame[keep], length[keep], t)
    if sequence.keypoints is not None and joint.present.any():
        uv = projected_keypoints(body, joint)
        length = np.linalg.norm(uv - sequence.keypoints.uv, axis=-1)
        valid = (sequence.keypoints.confidence > 0) & joint.present[..., None]
        frame = np.broadcast_to(np.arange(t)[:, None], length.shape)
        found["keypoint_px"] = _means(frame[valid], length[valid], t)
    return found


def projected_keypoints(
    body: BodyModel, joint: JointEstimate
) -> Float[np.ndarray, "h t 25 2"]:
    """Returns the keypoints of the estimated bodies, projected into the images, px."""
    shapes = jnp.asarray(joint.shapes)[:, None]
    frames = joint.poses.shape[1]
    poses = lengthened(joint.poses, padded_length(frames), axis=1)
    p_H = shortened(_keypoints(body, poses, shapes), frames, axis=1)
    turn, move = joint.roots[..., :3, :3], joint.roots[..., None, :3, 3]
    p_C = np.einsum("htij,htkj->htki", turn, np.asarray(p_H)) + move
    uv = project_rows(joint.intrinsics, p_C.reshape(-1, 3))
    return uv.reshape(*p_C.shape[:-1], 2)


_keypoints = eqx.filter_jit(local_keypoints)


def _means(frame: np.ndarray, value: np.ndarray, num_frames: int) -> list[float | None]:
    """Returns the mean of `value` in each frame; `None` where there is none."""
    total = np.bincount(frame, value, num_frames)
    count = np.bincount(frame, minlength=num_frames)
    return [float(x / n) if n else None for x, n in zip(total, count, strict=True)]
