"""Removes offsets between a detector's keypoints and the joints of the body model.

Every detector has its own definition of hip or knee, which is the same in all frames of
a person. The part common to all people is known (`body.keypoint_definitions`); the fit
estimates the rest with the shape (`skeleton`: fixed to bones). Both must be removed
before keypoints are compared with the model's joints: a leg that appears 5 % too short
bends the knee by 36 degrees.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from bodyslam_jax.body import BodyModel
from bodyslam_jax.geometry.camera import project
from bodyslam_jax.geometry.lengths import padded_length
from bodyslam_jax.people.costs import MIN_DEPTH_M, robust
from bodyslam_jax.people.keypoint_errors import (
    CORRELATION_TIME,
    ROBUST_SCALE,
    in_pixels,
    keypoint_sigma,
)
from bodyslam_jax.people.person_state import PersonState
from bodyslam_jax.people.skeleton import (
    NUM_SHAPE,
    Skeleton,
    make_skeleton,
    place_points,
    pose_points,
)
from bodyslam_jax.types import Intrinsics, Keypoints

_NUM_ROUNDS = 6


def as_body_keypoints(
    keypoints: Keypoints,
    roots: PersonState,
    chosen: Bool[np.ndarray, " h"],
    intrinsics: Intrinsics,
    body: BodyModel,
    fps: float,
) -> Keypoints:
    """Returns the keypoints moved from the detector's definitions to the joints of the
    body.

    The bodies of the people `chosen` were fitted to these keypoints. The deviation of
    their offsets from the detector's definition is estimated by robust linear
    regression on the reprojection residuals, with the priors of `skeleton`; frames
    within the correlation time of the errors count once. For other people only the
    definition is removed. Frames without a body are unchanged.
    """
    uv = keypoints.uv.copy()
    graphs = make_skeleton(body, 0.0)
    skeleton = graphs
    if keypoints.definition != "unknown":
        skeleton = make_skeleton(body, 0.0, keypoints.definition)
    camera = jnp.asarray(intrinsics.params, skeleton.offset.dtype)
    focal = float(np.mean(intrinsics.params[:2]))
    defined = graphs is not skeleton
    for h in np.flatnonzero((chosen | defined) & roots.present.any(axis=1)):
        where = np.flatnonzero(roots.present[h])
        T_CH = roots.T_CH[h, where]
        depth = np.maximum(T_CH[:, 2, 3], MIN_DEPTH_M)
        sigma = keypoint_sigma(keypoints, intrinsics, int(h))[where]
        sigma = (
            in_pixels(sigma, focal / depth)
            if chosen[h]
            else np.full_like(sigma, np.inf)
        )
        alike = max(1.0, CORRELATION_TIME * fps)
        shape = np.concatenate([roots.shape[h], np.zeros(NUM_SHAPE - 10)])
        angles = roots.body_pose[h, where, :21].reshape(-1, 63)
        rows = (T_CH[:, :3, :3], T_CH[:, :3, 3], angles, uv[h, where])
        # As long as the clip: people who are in few of its frames share the program.
        length = padded_length(roots.present.shape[1]) - len(where)
        last = lambda a: np.concatenate([a, np.repeat(a[-1:], length, axis=0)])
        silent = np.full((length, 25), np.inf)
        sigma = np.concatenate([sigma * np.sqrt(alike), silent])
        numbers = (*map(last, rows), sigma, shape, ROBUST_SCALE)
        arrays = (jnp.asarray(a, skeleton.offset.dtype) for a in numbers)
        shift = np.asarray(_shift(graphs, skeleton, camera, *arrays), float)
        uv[h, where] -= shift[: len(where)]
    return dataclasses.replace(keypoints, uv=uv, definition="unknown")


@eqx.filter_jit
def _shift(
    graphs: Skeleton,
    skeleton: Skeleton,
    intrinsics: Float[Array, " i"],
    orientation: Float[Array, "t 3 3"],
    position: Float[Array, "t 3"],
    angles: Float[Array, "t 63"],
    uv: Float[Array, "t 25 2"],
    sigma: Float[Array, "t 25"],
    shape: Float[Array, " s"],
    scale: Float[Array, ""],
) -> Float[Array, "t 25 2"]:
    """Returns the displacement of each keypoint in the image, px, by the detector's
    definitions: from those of the skeleton `graphs` to those of `skeleton`, plus the
    estimated deviation."""

    def frame(R, p, angles):
        plain = place_points(graphs, angles, shape)[1] @ R.T + p
        points = pose_points(skeleton, angles, shape)
        p_C = points.keypoints @ R.T + p
        view = jax.vmap(jax.jacfwd(lambda x: project(intrinsics, x)))(p_C)
        predicted = project(intrinsics, p_C)
        defined = predicted - project(intrinsics, plain)
        return predicted, defined, view @ R @ points.by_shape[..., 10:]

    predicted, defined, jac = jax.vmap(frame)(orientation, position, angles)
    residual = (uv - predicted) / sigma[..., None]
    whitened = jac / sigma[..., None, None]

    def fit(_, offsets):
        left = residual - whitened @ offsets
        _, weight = robust(jnp.sum(left**2, -1), scale)
        weighted = whitened * weight[..., None, None]
        hessian = jnp.einsum("tkci,tkcj->ij", weighted, whitened)
        right = jnp.einsum("tkci,tkc->i", weighted, residual)
        return jnp.linalg.solve(hessian + jnp.eye(len(right)), right)

    start = jnp.zeros(jac.shape[-1], jac.dtype)
    return defined + jac @ jax.lax.fori_loop(0, _NUM_ROUNDS, fit, start)
