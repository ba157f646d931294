"""From pose and shape to the vertices of the skin.

SMPL (Loper et al., 2015): `v = Σ_j w_j (G_j (v_rest - J_j) + x_j)` with
`v_rest = template + S β + P vec(R - I)`. Two ways to compute it, chosen by the shapes:
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bodyslam_jax.body._kinematics import (
    flatten,
    matmul,
    matvec,
    pose_feature,
    pose_joints,
    root_and_pelvis,
)
from bodyslam_jax.body._model import BodyModel

_CHUNK_SHARED, _CHUNK_EACH = 32, 16
"""Frames computed together, with one β and with many: what they need fits a CPU's
cache, and a long video does not need more memory than its result."""


@jax.jit
def vertices(
    model: BodyModel,
    pose: Float[Array, "*#b 72"],
    shape: Float[Array, "*#b 10"],
    trans: Float[Array, "*#b 3"],
) -> Float[Array, "*b v 3"]:
    """Vertices, m, in the frame into which the root rotation `pose[:3]` turns.

    Leading axes broadcast. Frames that share one β (`shape` without a leading axis
    longer than 1) are several times faster than a β for each: see `_skin_shared`.
    """
    batch = jnp.broadcast_shapes(pose.shape[:-1], shape.shape[:-1], trans.shape[:-1])
    is_shared = math.prod(shape.shape[:-1]) == 1 and model.pose_dirs.shape[-1] == 0
    pose, trans = flatten(pose, batch, 1), flatten(trans, batch, 1)
    beta = flatten(shape, batch, 1)
    posed = pose_joints(model, pose[:, 3:].reshape(len(pose), 23, 3), beta)
    root, pelvis = root_and_pelvis(model, pose, beta, trans)
    # T_j = [root G_j | root (x_j - G_j J_j) + pelvis], (24, 3, 4, n)
    move = posed.x - matvec(posed.G, posed.rest)
    T = matmul(root[None], jnp.concatenate([posed.G, move[:, :, None]], 2))
    T = jnp.concatenate([T[:, :, :3], T[:, :, 3:] + pelvis[None, :, None]], 2)
    if is_shared:
        points = _skin_shared(model, T, shape.reshape(10))
    else:
        feature = pose_feature(posed.R)[: model.pose_dirs.shape[-1]]
        points = _skin_each(model, T, beta, feature.T)
    return points.reshape(*batch, model.num_vertices, 3)


def _skin_shared(model, T, shape):
    """One β for all: `[w_j v_rest; w_j]` is one matrix for each run of vertices."""
    rest = model.template + (model.shape_dirs.reshape(-1, 10) @ shape).reshape(-1, 3)
    rest = jnp.concatenate([rest.T, jnp.ones((1, len(rest)), rest.dtype)])
    runs = []
    for start, stop, joints in model.blocks:
        M = _weights(model, start, stop, joints)[:, None] * rest[:, start:stop]
        runs.append((np.array(joints), M.reshape(4 * len(joints), stop - start)))

    def skin(T):
        parts = [T[:, :, j].reshape(-1, len(M)) @ M for j, M in runs]
        points = jnp.concatenate(parts, -1)
        return points.reshape(len(T), 3, -1).transpose(0, 2, 1)

    return _by_chunks(skin, _CHUNK_SHARED, T.transpose(3, 1, 0, 2))


def _skin_each(model, T, shape, feature):
    """A rest surface for each frame: blend the transforms, then apply them."""
    num_features = feature.shape[-1]
    template = model.template.T
    S, P = model.shape_dirs.transpose(2, 1, 0), model.pose_dirs.transpose(2, 1, 0)
    weights = [_weights(model, *run) for run in model.blocks]

    # Recomputed in the backward pass: the blended transforms of a long video are
    # several times as large as its vertices.
    @jax.checkpoint
    def skin(T, shape, feature):
        parts = []
        for (start, stop, joints), W in zip(model.blocks, weights, strict=True):
            size = stop - start
            here = lambda dirs: dirs[:, :, start:stop].reshape(len(dirs), 3 * size)
            rest = (shape @ here(S)).reshape(-1, 3, size) + template[:, start:stop]
            if num_features:
                rest = rest + (feature @ here(P)).reshape(-1, 3, size)
            A = T[..., np.array(joints)].reshape(-1, len(joints)) @ W
            A = A.reshape(-1, 3, 4, size)
            row = lambda c: A[:, :, c] * rest[:, c, None]
            parts.append(row(0) + row(1) + row(2) + A[:, :, 3])
        return jnp.concatenate(parts, -1).transpose(0, 2, 1)

    return _by_chunks(skin, _CHUNK_EACH, T.transpose(3, 1, 2, 0), shape, feature)


def _weights(model, start, stop, joints):
    """Weights (joints, vertices) of a run, dense: few joints, so few zeros."""
    j = jnp.array(joints, model.skin_joint.dtype)[:, None, None]
    is_joint = (model.skin_joint[start:stop] == j).astype(model.dtype)
    return (model.skin_weight[start:stop] * is_joint).sum(-1)


def _by_chunks(function, chunk, *arrays):
    """`function` over the leading axis, `chunk` frames at a time."""
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
