"""Keypoints of one person in one frame with their first and second
derivatives, in closed form.

A keypoint is a weighted sum of points fixed to joints, `p = Σ_i w_i (x_i + G_i a_i)`. A
rotation `R_j Exp(δ_j)` of joint j moves all joints below it:
`dp/dδ_j = -[Σ_{i below j} w_i (x_i + G_i a_i - x_j)]x G_j`, plus the derivative of pose
blend shapes. Forward differentiation of the chain takes twenty times as long.

Second derivatives by joint rotations matter because the image of a limb that lies
across the view does not change, to first order, as it rotates towards the camera. A
rotation of joint i about an axis `a` (in H) moves all joints below it, and so rotates
the derivatives `d_j` by them: `∂²p/∂δ_i∂δ_j = a x d_j`, and for i = j its symmetric
part. With `d_j = b x m_j`, where `m_j` is the offset of a point below j, the
contraction with gradients `f` is `Σ f·(a x (b x m_j)) = a·(M_j b - b tr M_j)`, `M_j = Σ
m_j f^T`: nine numbers a joint.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from bodyslam_jax.body import (
    DETECTOR_BIAS,
    KEYPOINT_NAMES,
    PARENTS,
    BodyModel,
    rest_joints,
)
from bodyslam_jax.body.skeleton import KEYPOINT_JOINT, SURFACE_POINTS, ancestors
from bodyslam_jax.geometry import so3

_ANCESTOR_MASK = np.kron(ancestors() - 0.5 * np.eye(24), np.ones((3, 3)))
"""1 where the joint of a coordinate (row) is an ancestor of that of the other, 1/2
where both belong to one joint."""


class Carried(NamedTuple):
    """Keypoints by skinning: `p_k = Σ_i share_ik x_i + G_i lever_ik`, m, in H."""

    G: Float[Array, "24 3 3"]
    """Axes of the joints in H."""
    x: Float[Array, "24 3"]
    """Joints, from the pelvis."""
    share: Float[Array, "24 k"]
    """Weights of skinning, 1."""
    lever: Float[Array, "24 k 3"]
    """Vector from joint to keypoint in the joint's axes, times the share, m."""
    x_by_shape: Float[Array, "24 3 10"]
    lever_by_shape: Float[Array, "24 3 k 10"]
    vertex: Int[Array, " k"]
    """Vertex of the skin of each keypoint that is on it."""
    on_skin: Bool[np.ndarray, " k"]


def carried_by_joints(
    body: BodyModel,
    R: Float[Array, "23 3 3"],
    shape: Float[Array, " 10"],
    layout: str,
    bias: float | Float[Array, ""],
    points: tuple[int, ...] | None = None,
) -> Carried:
    """Returns rotations and positions of joints, and keypoints relative to them: all of
    the layout's, or those with the indices `points`."""
    dtype = R.dtype
    names = KEYPOINT_NAMES[layout]
    names = names if points is None else tuple(names[i] for i in points)
    skinned = np.array([name in SURFACE_POINTS for name in names])
    pick = np.array(
        [SURFACE_POINTS.index(n) if n in SURFACE_POINTS else 0 for n in names]
    )
    own = jnp.array([KEYPOINT_JOINT.get(n, 0) for n in names], body.skin_joint.dtype)
    offset = np.array([DETECTOR_BIAS.get(n, (0.0, 0.0, 0.0)) for n in names])
    vertex = body.picks[pick]
    joint = jnp.where(skinned[:, None], body.skin_joint[vertex], own[:, None])
    first = np.arange(body.skin_weight.shape[1]) == 0
    weight = jnp.where(
        skinned[:, None], body.skin_weight[vertex], jnp.asarray(first, dtype)
    )
    features = body.pose_dirs.shape[-1]

    rest = rest_joints(body, shape)
    by_shape_rest = body.joint_shape_dirs.reshape(24, 3, 10)
    G = turns_of(R)
    # Positions are linear in the offsets of joints from parents, and these in shape.
    parent = jnp.array(PARENTS[1:])
    by_shape_offset = by_shape_rest[1:] - by_shape_rest[parent]
    carried = times(G[parent], by_shape_offset).reshape(23, 30)
    path = jnp.asarray(ancestors()[1:], dtype)
    offsets = (rest[1:] - rest[parent])[..., None]
    x = path.T @ times(G[parent], offsets)[..., 0]
    by_shape_x = path.T @ carried
    shaped = body.template[vertex] + body.shape_dirs[vertex] @ shape
    if features:
        change = (R - jnp.eye(3, dtype=dtype)).reshape(207)[:features]
        shaped = shaped + body.pose_dirs[vertex] @ change
    at_joint = jnp.asarray(bias, dtype) * jnp.asarray(offset, dtype)
    on_skin = skinned[:, None, None]
    arm = jnp.where(on_skin, shaped[:, None] - rest[joint], at_joint[:, None])
    # Weight of each joint for each keypoint: dense, as gathering 3 x 3 is slow.
    carries = (joint[..., None] == jnp.arange(24, dtype=joint.dtype)).astype(
        dtype
    ) * weight[..., None]
    by_shape_arm = jnp.where(
        on_skin[..., None], body.shape_dirs[vertex][:, None] - by_shape_rest[joint], 0.0
    )
    return Carried(
        G=G,
        x=x,
        share=jnp.sum(carries, axis=1).T,
        lever=jnp.einsum("kni,knc->ikc", carries, arm),
        x_by_shape=by_shape_x.reshape(24, 3, 10),
        lever_by_shape=jnp.einsum("kni,kncs->icks", carries, by_shape_arm),
        vertex=vertex,
        on_skin=skinned,
    )


def placed(found: Carried) -> Float[Array, "24 k 3"]:
    """Returns the contribution of each joint to each keypoint, m, in H; keypoints are
    their sums."""
    turned = times(found.lever, found.G.swapaxes(-1, -2))
    return found.share[..., None] * found.x[:, None] + turned


def keypoint_jacobian(
    body: BodyModel,
    pose: Float[Array, "23 3"],
    shape: Float[Array, " 10"],
    layout: str,
    bias: float | Float[Array, ""],
    points: tuple[int, ...] | None = None,
) -> tuple[Float[Array, "k 3"], Float[Array, "3 k 69"], Float[Array, "k 3 10"]]:
    """Returns `local_keypoints` with the derivatives by `Exp` on the right of each
    joint (m/rad), and by shape; of all keypoints, or of those with the indices
    `points`."""
    dtype = pose.dtype
    R = so3.exp(pose)
    found = carried_by_joints(body, R, shape, layout, bias, points)
    G, x, share = found.G, found.x, found.share
    count = share.shape[1]
    features = body.pose_dirs.shape[-1]
    path = jnp.asarray(ancestors()[1:], dtype)
    parts = placed(found)
    position = jnp.sum(parts, axis=0)
    moved = G.swapaxes(0, 1).reshape(3, 72) @ found.lever_by_shape.reshape(72, -1)
    by_shape = (share.T @ found.x_by_shape.reshape(24, 30)).reshape(-1, 3, 10)
    by_shape = by_shape + moved.reshape(3, -1, 10).swapaxes(0, 1)
    # First moment of the points below a joint, about that joint.
    moment = (path @ parts.reshape(24, -1)).reshape(23, -1, 3)
    moment = moment - (path @ share)[..., None] * x[1:, None]
    # One column for each axis of each joint, 69 in a row.
    wide = jnp.broadcast_to(moment[:, :, :, None], (*moment.shape, 3))
    arm = [wide[:, :, i].swapaxes(0, 1).reshape(-1, 69) for i in range(3)]
    axis = [G[1:, i, :].reshape(69) for i in range(3)]
    by_pose = [
        axis[1] * arm[2] - axis[2] * arm[1],
        axis[2] * arm[0] - axis[0] * arm[2],
        axis[0] * arm[1] - axis[1] * arm[0],
    ]
    if features:
        # dR_j / dδ_ja = R_j [e_a]x, for the joints whose entries are blended.
        basis = np.array([np.cross(np.eye(3)[a], np.eye(3)).T for a in range(3)])
        turned = jnp.einsum("jik,akl->jail", R, jnp.asarray(basis, dtype))
        dirs = body.pose_dirs[found.vertex]
        dirs = jnp.pad(dirs, ((0, 0), (0, 0), (0, 207 - features)))
        dirs = dirs.reshape(count, 3, 23, 9)
        bent = jnp.einsum("kcjp,jap->kcja", dirs, turned.reshape(23, 3, 9))
        frame = (share.T @ G.reshape(24, 9)).reshape(-1, 3, 3)
        moved = jnp.einsum("kic,kcm->ikm", frame, bent.reshape(count, 3, 69))
        moved = jnp.where(found.on_skin[:, None], moved, 0.0)
        by_pose = [by_pose[i] + moved[i] for i in range(3)]
    return position, jnp.stack(by_pose), by_shape


def turns_of(R: Float[Array, "23 3 3"]) -> Float[Array, "24 3 3"]:
    """Returns rotations of the joints in H; each pass doubles the path's length."""
    G = jnp.concatenate([jnp.eye(3, dtype=R.dtype)[None], R])
    above = np.maximum(np.array(PARENTS), 0)
    for _ in range(4):  # 2^4 is more than the depth of the tree
        G = times(G[above], G)
        above = above[above]
    return G


def times(a: Float[Array, "*b i c"], b: Float[Array, "*b c j"]) -> Array:
    """Multiplies many small matrices as fused sums, faster than a batched GEMM."""
    term = lambda c: a[..., :, c, None] * b[..., c, None, :]
    return sum((term(c) for c in range(1, a.shape[-1])), term(0))


def keypoint_curvature(
    found: Carried,
    pull: Float[Array, "k 3"],
) -> tuple[Float[Array, "72 72"], Float[Array, "72 10"]]:
    """Returns the second derivatives of `Σ_k pull_k · p_k` by rotations twice, and by
    rotations and shape.

    Points (`carried_by_joints`, m) and `pull`, the gradient of the cost by them, are in
    H. Rotations (rad) are `Exp` on the right: of the whole body about the pelvis, then
    of each joint. Points are linear in shape. Pose blend shapes are neglected.
    """
    G, x = found.G, found.x
    path = jnp.asarray(ancestors(), x.dtype)
    below = lambda y: (path @ y.reshape(24, -1)).reshape(y.shape)
    own = found.share @ pull
    all_own = below(own)
    arm = found.lever.swapaxes(1, 2).reshape(72, -1) @ pull
    outer = lambda f: x[:, :, None] * f[:, None]
    M = below(outer(own) + times(G, arm.reshape(24, 3, 3))) - outer(all_own)
    trace = M[:, 0, 0] + M[:, 1, 1] + M[:, 2, 2]
    crossed = times(M, G) - trace[:, None, None] * G
    axes, crossed = (y.swapaxes(1, 2).reshape(72, 3) for y in (G, crossed))
    product = jnp.asarray(_ANCESTOR_MASK, M.dtype) * (axes @ crossed.T)
    turns = product + product.T

    arms = found.lever_by_shape.transpose(0, 1, 3, 2).reshape(720, -1) @ pull
    arms = times(G, arms.reshape(24, 3, 30)).reshape(24, 3, 10, 3)
    cross = lambda y, f: jnp.cross(y, f[..., None], axis=1)
    spread = cross(found.x_by_shape, own) + _crossed(arms)
    spread = below(spread) - cross(found.x_by_shape, all_own)
    return turns, times(G.swapaxes(1, 2), spread).reshape(72, 10)


def _crossed(y: Float[Array, "i 3 s 3"]) -> Float[Array, "i 3 s"]:
    """Returns `Σ a x b` from `Σ a b^T`."""
    return jnp.stack(
        [y[:, i - 2, :, i - 1] - y[:, i - 1, :, i - 2] for i in range(3)], 1
    )
