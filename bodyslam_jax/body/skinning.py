"""Linear blend skinning: vertices of a pose and shape.

In SMPL (Loper et al., 2015) `v = Σ_j w_j (G_j (v_rest - J_j) + x_j)` with
`v_rest = template + S β + P vec(R - I)`. If all frames share one β, rest vertices and
weights are multiplied once (`_skin_shared`), otherwise per frame (`_skin_each`).
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bodyslam_jax.body.kinematics import (
    batch_of,
    flatten,
    matvec,
    pelvis_place,
    pose_feature,
    pose_joints,
    rotations,
)
from bodyslam_jax.body.model import BodyModel

_SHARED_CHUNK_FRAMES, _EACH_CHUNK_FRAMES = 32, 16
"""Frames per chunk, with one β for all and with one for each: a chunk fits a CPU's
cache, and a long video takes little memory beyond its result."""


@jax.jit
def vertices(
    model: BodyModel,
    pose: Float[Array, "*#b 72"],
    shape: Float[Array, "*#b 10"],
    trans: Float[Array, "*#b 3"],
) -> Float[Array, "*b v 3"]:
    """Returns vertices, m, in the frame to which the root rotation `pose[:3]` maps.

    Leading axes broadcast. If all frames share one β (`shape` without a leading axis
    longer than 1), the function is several times faster: see `_skin_shared`.

    **Raises:** `ValueError` naming an argument of another shape.
    """
    batch = batch_of("vertices", pose=pose, shape=shape, trans=trans)
    is_shared = math.prod(shape.shape[:-1]) == 1 and model.pose_dirs.shape[-1] == 0
    pose, trans = flatten(pose, batch, 1), flatten(trans, batch, 1)
    beta = flatten(shape, batch, 1)
    posed = pose_joints(model, rotations(pose.reshape(len(pose), 24, 3)), beta)
    # T_j = [G_j | x_j - G_j J_j + pelvis], (24, 3, 4, n)
    move = posed.x - matvec(posed.G, posed.rest) + pelvis_place(model, beta, trans)
    T = jnp.concatenate([posed.G, move[:, :, None]], 2)
    if is_shared:
        points = _skin_shared(model, T, shape.reshape(10))
    else:
        feature = pose_feature(posed.R)[: model.pose_dirs.shape[-1]]
        points = _skin_each(model, T, beta, feature.T)
    return points.reshape(*batch, model.num_vertices, 3)


def _skin_shared(model, T, shape):
    """Skins frames that share one β: `[w_j v_rest; w_j]` is one matrix per run of
    vertices."""
    rest = model.template + (model.shape_dirs.reshape(-1, 10) @ shape).reshape(-1, 3)
    rest = jnp.concatenate([rest.T, jnp.ones((1, len(rest)), rest.dtype)])
    runs = []
    for start, stop, joints in model.blocks:
        M = _weights(model, start, stop, joints)[:, None] * rest[:, start:stop]
        runs.append(M.reshape(4 * len(joints), stop - start))

    def skin(T):
        by_run = _by_run(model, T, 2)
        parts = [A.reshape(-1, len(M)) @ M for A, M in zip(by_run, runs, strict=True)]
        points = jnp.concatenate(parts, -1)
        return points.reshape(len(T), 3, model.num_vertices).transpose(0, 2, 1)

    return _by_chunks(skin, _SHARED_CHUNK_FRAMES, T.transpose(3, 1, 0, 2))


def _skin_each(model, T, shape, feature):
    """Skins frames with a rest surface each: blends the transforms, then applies
    them."""
    v, num_features = model.num_vertices, feature.shape[-1]
    S, P = (
        dirs.transpose(2, 1, 0).reshape(-1, 3 * v)
        for dirs in (model.shape_dirs, model.pose_dirs)
    )
    weights = [_weights(model, *run) for run in model.blocks]

    # Recomputed in the backward pass: the blended transforms of a long video are
    # several times as large as its vertices.
    @jax.checkpoint
    def skin(T, shape, feature):
        rest = model.template.T.reshape(-1) + shape @ S
        if num_features:
            rest = rest + feature @ P
        rest = rest.reshape(-1, 3, v)
        parts, by_run = [], _by_run(model, T, 3)
        for (start, stop, _), W, A in zip(model.blocks, weights, by_run, strict=True):
            A = (A.reshape(-1, len(W)) @ W).reshape(len(T), 3, 4, stop - start)
            row = lambda c: A[:, :, c] * rest[:, c, None, start:stop]
            parts.append(row(0) + row(1) + row(2) + A[:, :, 3])
        return jnp.concatenate(parts, -1).transpose(0, 2, 1)

    return _by_chunks(skin, _EACH_CHUNK_FRAMES, T.transpose(3, 1, 2, 0), shape, feature)


def _by_run(model, T, axis):
    """Returns the transforms that each run of vertices follows, by one gather and
    slices."""
    every = np.concatenate([joints for *_, joints in model.blocks])
    ends = np.cumsum([len(joints) for *_, joints in model.blocks])
    return jnp.split(jnp.take(T, every, axis=axis), ends[:-1], axis=axis)


def _weights(model, start, stop, joints):
    """Returns the dense weights (joints, vertices) of a run, which follows few
    joints."""
    j = jnp.array(joints, model.skin_joint.dtype)[:, None, None]
    is_joint = (model.skin_joint[start:stop] == j).astype(model.dtype)
    return (model.skin_weight[start:stop] * is_joint).sum(-1)


def _by_chunks(function, chunk, *arrays):
    """Applies `function` over the leading axis, to `chunk` frames at a time."""
    n = len(arrays[0])
    if n <= chunk:
        return function(*arrays)
    whole = n - n % chunk
    split = lambda a: a[:whole].reshape(n // chunk, chunk, *a.shape[1:])
    out = jax.lax.map(lambda xs: function(*xs), tuple(map(split, arrays)))
    out = out.reshape(whole, *out.shape[2:])
    if whole < n:
        out = jnp.concatenate([out, function(*[a[whole:] for a in arrays])])
    return out


def stature(body: BodyModel, betas: Float[np.ndarray, " 10"]) -> float:
    """Returns the height of the body's mesh at rest for SMPL β, m."""
    up = 1  # y
    template = np.asarray(body.template, np.float64)[:, up]
    heights = template + np.asarray(body.shape_dirs, np.float64)[:, up] @ betas
    return float(heights.max() - heights.min())
