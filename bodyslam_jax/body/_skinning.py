"""From pose and shape to the vertices of the skin.

SMPL (Loper et al., 2015): `v = Σ_j w_j (G_j (v_rest - J_j) + x_j)` with
`v_rest = template + S β + P vec(R - I)`. Two ways to compute it, chosen by the shapes:
"""

import math

import jax
import jax.numpy as jnp
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

_CHUNK = 16
"""Frames computed together: what they need fits a CPU's cache, and a long video does
not need more memory than its result."""


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
    # T_j = [root G_j | root (x_j - G_j J_j)], (24, 3, 4, n), then frame first
    move = posed.x - matvec(posed.G, posed.rest)
    T = matmul(root[None], jnp.concatenate([posed.G, move[:, :, None]], 2))
    if is_shared:
        points = _skin_shared(model, T, shape.reshape(10))
    else:
        feature = pose_feature(posed.R)[: model.pose_dirs.shape[-1]]
        points = _skin_each(model, T, beta, feature.T)
    return (points + pelvis.T[:, None]).reshape(*batch, model.num_vertices, 3)


def _skin_shared(model, T, shape):
    """One β for all: `[w_j v_rest; w_j]`, j = 0..23, is one matrix, applied at once."""
    rest = model.template + (model.shape_dirs.reshape(-1, 10) @ shape).reshape(-1, 3)
    v = model.num_vertices
    rest = jnp.concatenate([rest.T, jnp.ones((1, v), rest.dtype)])
    M = (_dense_weights(model)[:, None] * rest).reshape(96, v)

    def skin(T):
        points = T.reshape(-1, 96) @ M
        return points.reshape(-1, 3, v).transpose(0, 2, 1)

    return _by_chunks(skin, T.transpose(3, 1, 0, 2))


def _skin_each(model, T, shape, feature):
    """A rest surface for each frame: blend the transforms, then apply them."""
    v, num_features = model.num_vertices, feature.shape[-1]
    W = _dense_weights(model)
    S = model.shape_dirs.transpose(2, 1, 0).reshape(10, -1)
    P = model.pose_dirs.transpose(2, 1, 0).reshape(num_features, 3 * v)

    # Recomputed in the backward pass: the blended transforms of a long video are
    # several times as large as its vertices.
    @jax.checkpoint
    def skin(T, shape, feature):
        rest = (shape @ S).reshape(-1, 3, v) + model.template.T
        if num_features:
            rest = rest + (feature @ P).reshape(-1, 3, v)
        A = (T.reshape(-1, 24) @ W).reshape(-1, 3, 4, v)
        row = lambda c: A[:, :, c] * rest[:, c, None]
        return (row(0) + row(1) + row(2) + A[:, :, 3]).transpose(0, 2, 1)

    return _by_chunks(skin, T.transpose(3, 1, 2, 0), shape, feature)


def _dense_weights(model):
    """Skinning weights (24, v): a product with zeros is faster than a gather."""
    joint = jnp.arange(24, dtype=model.skin_joint.dtype)[:, None, None]
    is_joint = (model.skin_joint == joint).astype(model.dtype)
    return (model.skin_weight * is_joint).sum(-1)


def _by_chunks(function, *arrays):
    """`function` over the leading axis, `_CHUNK` frames at a time."""
    n = len(arrays[0])
    if n <= _CHUNK:
        return function(*arrays)
    whole = n - n % _CHUNK
    split = lambda a: a[:whole].reshape(n // _CHUNK, _CHUNK, *a.shape[1:])
    out = jax.lax.map(lambda xs: function(*xs), tuple(map(split, arrays)))
    out = out.reshape(whole, *out.shape[2:])
    if whole < n:
        out = jnp.concatenate([out, function(*[a[whole:] for a in arrays])])
    return out
