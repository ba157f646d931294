"""Matches keypoints and bodies of the same person to the same index."""

import dataclasses

import numpy as np
from scipy.optimize import linear_sum_assignment

from bodyslam_jax.body.skeleton import BODY25
from bodyslam_jax.io.camera.calibration import project_points
from bodyslam_jax.types import Bodies, Intrinsics, Keypoints

_MID_HIP = BODY25["mid_hip"]
_UNMATCHED_COST = 1e6
"""Cost of two people who are never in the same frame."""


def pair(
    keypoints: Keypoints, bodies: Bodies, intrinsics: Intrinsics
) -> tuple[Keypoints, Bodies]:
    """Puts keypoints and bodies of the same person at the same index.

    Optimal assignment by the distance in the image of the projected pelvis from the
    middle of the hips, relative to the person's height. People with only one of the two
    are kept, with confidence 0 or not present.
    """
    num_k, num_b = len(keypoints.uv), len(bodies.present)
    cost = np.full((num_k, num_b), _UNMATCHED_COST)
    for j in range(num_b):
        # Of a body of average size: what people have in common does not matter here.
        pelvis = bodies.trans[j] + np.array([0.0, -0.2, 0.0])
        pixel = project_points(intrinsics, pelvis)
        for i in range(num_k):
            both = bodies.present[j] & (keypoints.confidence[i, :, _MID_HIP] > 0)
            if both.any():
                away = np.linalg.norm(
                    keypoints.uv[i, both, _MID_HIP] - pixel[both], axis=-1
                )
                # Missing keypoints lie at 0 and do not count.
                present = keypoints.confidence[i, both] > 0
                v = np.where(present, keypoints.uv[i, both][..., 1], np.nan)
                size = (np.nanmax(v, axis=-1) - np.nanmin(v, axis=-1)).clip(20)
                cost[i, j] = np.median(away / size) - 1e-3 * np.sqrt(both.sum())
    rows, columns = linear_sum_assignment(cost)
    matched = {
        int(j): int(i) for i, j in zip(rows, columns, strict=True) if cost[i, j] < 1
    }
    target = np.empty(num_b, dtype=np.int64)
    extra = num_k
    for j in range(num_b):
        if j in matched:
            target[j] = matched[j]
        else:
            target[j], extra = extra, extra + 1

    def spread(array: np.ndarray, index: np.ndarray) -> np.ndarray:
        out = np.zeros((extra, *array.shape[1:]), dtype=array.dtype)
        out[index] = array
        return out

    return (
        dataclasses.replace(
            keypoints,
            uv=spread(keypoints.uv, np.arange(num_k)),
            confidence=spread(keypoints.confidence, np.arange(num_k)),
        ),
        dataclasses.replace(
            bodies,
            present=spread(bodies.present, target),
            poses=spread(bodies.poses, target),
            shapes=spread(bodies.shapes, target),
            trans=spread(bodies.trans, target),
        ),
    )
