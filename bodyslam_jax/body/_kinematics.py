"""From pose and shape to joints and keypoints; no vertex but the picked ones.

SMPL (Loper et al., 2015): the joints at rest are linear in the shape,
`J(β) = J_0 + J_s β`; joint k turns about its parent's frame,
`G_k = G_parent R_k`, `x_k = x_parent + G_parent (J_k - J_parent)`.

Arrays are turned so that the batch lies last: the 3x3 products are then plain
arithmetic on long vectors, one level of the tree at a time.
"""

import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from bodyslam_jax.body._model import BodyModel
from bodyslam_jax.body._skeleton import (
    DETECTOR_BIAS,
    KEYPOINT_JOINT,
    KEYPOINT_NAMES,
    LEVELS,
    PARENTS,
    SURFACE_POINTS,
)


def rest_joints(
    model: BodyModel, shape: Float[Array, "*b 10"]
) -> Float[Array, "*b 24 3"]:
    """Joints at rest for SMPL β, m, in the model's own frame (pelvis at `J_0(β)`)."""
    moved = shape @ model.joint_shape_dirs.reshape(72, 10).T
    return model.joint_template + moved.reshape(*shape.shape[:-1], 24, 3)


def local_joints(
    model: BodyModel,
    body_pose: Float[Array, "*#b 23 3"],
    shape: Float[Array, "*#b 10"],
) -> Float[Array, "*b 24 3"]:
    """Posed joints in the root frame H, m: the pelvis is the origin, unrotated.

    `body_pose` holds the axis-angle rotations of joints 1 to 23, rad, each in its
    parent's frame; `shape` is SMPL β. Leading axes broadcast.
    """
    _, position = _chain(_rotations(body_pose), rest_joints(model, shape))
    return position


def joints(
    model: BodyModel,
    pose: Float[Array, "*#b 72"],
    shape: Float[Array, "*#b 10"],
    trans: Float[Array, "*#b 3"],
) -> Float[Array, "*b 24 3"]:
    """Posed joints, m, in the frame into which the root rotation `pose[:3]` turns.

    The pelvis is at `J_0(β) + trans` whatever the pose.
    """
    local = local_joints(model, pose[..., 3:].reshape(*pose.shape[:-1], 23, 3), shape)
    return _place(model, local, pose, shape, trans)


def local_keypoints(
    model: BodyModel,
    body_pose: Float[Array, "*#b 23 3"],
    shape: Float[Array, "*#b 10"],
    layout: str = "body25",
    bias: float | Float[Array, ""] = 0.0,
) -> Float[Array, "*b keypoints 3"]:
    """Keypoints of a 2D detector in the root frame H, m: joints and picked vertices.

    **Arguments:**

    - `layout`: `body25`, `coco17` or `halpe26`; names are in `KEYPOINT_NAMES`.
    - `bias`: 0 takes each keypoint to be SMPL's joint of that name, as bodies'
        projections do; 1 puts hips, neck and shoulders where detectors trained on COCO
        put them (`DETECTOR_BIAS`). Keypoints are linear in it.
    """
    names = KEYPOINT_NAMES[layout]
    rest = rest_joints(model, shape)
    R = _rotations(body_pose)
    G, x = _chain_rotations(R, rest)
    surface = [n for n in names if n in SURFACE_POINTS]
    on_skin = _picked_vertices(model, surface, R, G, x, rest, shape)
    offset = jnp.array([DETECTOR_BIAS.get(n, (0.0, 0.0, 0.0)) for n in names], x.dtype)
    joint = jnp.array([KEYPOINT_JOINT.get(n, 0) for n in names])
    at_joint = x[..., joint, :] + jnp.einsum(
        "...kij,kj->...ki", G[..., joint, :, :], jnp.asarray(bias, x.dtype) * offset
    )
    parts = [
        on_skin[..., surface.index(n), :] if n in surface else at_joint[..., k, :]
        for k, n in enumerate(names)
    ]
    return jnp.stack(parts, axis=-2)


def keypoints(
    model: BodyModel,
    pose: Float[Array, "*#b 72"],
    shape: Float[Array, "*#b 10"],
    trans: Float[Array, "*#b 3"],
    layout: str = "body25",
    bias: float | Float[Array, ""] = 0.0,
) -> Float[Array, "*b keypoints 3"]:
    """`local_keypoints`, placed like `joints`."""
    body_pose = pose[..., 3:].reshape(*pose.shape[:-1], 23, 3)
    local = local_keypoints(model, body_pose, shape, layout, bias)
    return _place(model, local, pose, shape, trans)


def _place(model, local, pose, shape, trans):
    """Points of frame H turned by the root and moved to `J_0(β) + trans`."""
    R = jaxlie.SO3.exp(pose[..., :3]).as_matrix()
    pelvis = rest_joints(model, shape)[..., 0, :] + trans
    return jnp.einsum("...ij,...kj->...ki", R, local) + pelvis[..., None, :]


def _rotations(body_pose):
    return jaxlie.SO3.exp(body_pose).as_matrix()


def _chain(R, rest):
    return _chain_rotations(R, rest)


def _chain_rotations(R, rest):
    """Rotations `*b 24 3 3` and places `*b 24 3` of the joints in frame H."""
    batch = jnp.broadcast_shapes(R.shape[:-3], rest.shape[:-2])
    offset = rest[..., 1:, :] - rest[..., jnp.array(PARENTS[1:]), :]
    eye = jnp.broadcast_to(jnp.eye(3, dtype=R.dtype), (*batch, 3, 3))
    G, x = [eye] + [eye] * 23, [jnp.zeros((*batch, 3), R.dtype)] * 24
    for level in LEVELS:
        for k in level:
            p = PARENTS[k]
            x[k] = x[p] + (G[p] * offset[..., k - 1, None, :]).sum(-1)
            G[k] = G[p] @ jnp.broadcast_to(R[..., k - 1, :, :], (*batch, 3, 3))
    return jnp.stack(G, axis=-3), jnp.stack(x, axis=-2)


def _picked_vertices(model, names, R, G, x, rest, shape):
    """Skinned vertices of the named surface points, `*b n 3`, in frame H."""
    v = model.picks[jnp.array([SURFACE_POINTS.index(n) for n in names])]
    shaped = model.template[v] + jnp.einsum(
        "vcs,...s->...vc", model.shape_dirs[v], shape
    )
    num_features = model.pose_dirs.shape[-1]
    if num_features:
        feature = R - jnp.eye(3, dtype=R.dtype)
        feature = feature.reshape(*R.shape[:-3], 207)[..., :num_features]
        shaped = shaped + jnp.einsum("vcp,...p->...vc", model.pose_dirs[v], feature)
    j = model.skin_joint[v]
    arm = shaped[..., None, :] - rest[..., j, :]
    moved = x[..., j, :] + jnp.einsum("...vkij,...vkj->...vki", G[..., j, :, :], arm)
    return (model.skin_weight[v][..., None] * moved).sum(-2)
