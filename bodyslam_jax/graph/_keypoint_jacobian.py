"""Keypoints of one person in one frame with their derivatives, in closed form.

A keypoint is a weighted sum of points fixed to joints, `p = Σ_i w_i (x_i + G_i a_i)`. A
turn `R_j Exp(δ_j)` of joint j carries what hangs below it:
`dp/dδ_j = -[Σ_{i below j} w_i (x_i + G_i a_i - x_j)]x G_j`, plus what pose blend shapes
add to a vertex. Forward differentiation of the chain takes twenty times as long.
"""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float

from bodyslam_jax.body import (
    DETECTOR_BIAS,
    KEYPOINT_NAMES,
    PARENTS,
    BodyModel,
    rest_joints,
)
from bodyslam_jax.body._skeleton import KEYPOINT_JOINT, LEVELS, SURFACE_POINTS


def _ancestors() -> np.ndarray:
    """1 where joint (row) is the other (column) or above it."""
    above = np.eye(24)
    for joint in range(1, 24):
        above[:, joint] += above[:, PARENTS[joint]]
    return np.minimum(above, 1.0)


def keypoint_jacobian(
    body: BodyModel,
    pose: Float[Array, "23 3"],
    shape: Float[Array, " 10"],
    layout: str,
    bias: float | Float[Array, ""],
) -> tuple[Float[Array, "k 3"], Float[Array, "3 k 69"], Float[Array, "k 3 10"]]:
    """`local_keypoints`, and its derivatives by `Exp` on the right of each joint, and
    by shape."""
    dtype = pose.dtype
    R = jaxlie.SO3.exp(pose).as_matrix()
    names = KEYPOINT_NAMES[layout]
    skinned = np.array([name in SURFACE_POINTS for name in names])
    pick = np.array(
        [SURFACE_POINTS.index(n) if n in SURFACE_POINTS else 0 for n in names]
    )
    own = jnp.array([KEYPOINT_JOINT.get(n, 0) for n in names], body.skin_joint.dtype)
    offset = np.array([DETECTOR_BIAS.get(n, (0.0, 0.0, 0.0)) for n in names])
    vertex = body.picks[pick]
    joint = jnp.where(skinned[:, None], body.skin_joint[vertex], own[:, None])
    alone = np.arange(body.skin_weight.shape[1]) == 0
    weight = jnp.where(
        skinned[:, None], body.skin_weight[vertex], jnp.asarray(alone, dtype)
    )
    features = body.pose_dirs.shape[-1]

    def points(shape):
        rest = rest_joints(body, shape)
        G, x = _chain(R, rest)
        shaped = body.template[vertex] + body.shape_dirs[vertex] @ shape
        if features:
            change = (R - jnp.eye(3, dtype=dtype)).reshape(207)[:features]
            shaped = shaped + body.pose_dirs[vertex] @ change
        on_skin = shaped[:, None] - rest[joint]
        at_joint = jnp.asarray(bias, dtype) * jnp.asarray(offset, dtype)
        arm = jnp.where(skinned[:, None, None], on_skin, at_joint[:, None])
        placed = x[joint] + jnp.einsum("knij,knj->kni", G[joint], arm)
        return jnp.sum(weight[..., None] * placed, axis=1), (placed, G, x)

    by_shape, (placed, G, x) = jax.jacfwd(points, has_aux=True)(shape)
    position = jnp.sum(weight[..., None] * placed, axis=1)
    below = jnp.asarray(_ancestors()[1:], dtype)[:, joint] * weight
    mass = jnp.sum(below, axis=-1)
    moment = jnp.einsum("jkn,kni->jki", below, placed) - mass[..., None] * x[1:, None]
    # One column for each axis of each joint, 69 in a row.
    arm = [jnp.repeat(moment[..., i].T, 3, axis=1) for i in range(3)]
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
        dirs = jnp.pad(body.pose_dirs[vertex], ((0, 0), (0, 0), (0, 207 - features)))
        dirs = dirs.reshape(len(names), 3, 23, 9)
        bent = jnp.einsum("kcjp,jap->kcja", dirs, turned.reshape(23, 3, 9))
        frame = jnp.einsum("kn,knij->kij", weight, G[joint])
        moved = jnp.einsum("kic,kcm->ikm", frame, bent.reshape(len(names), 3, 69))
        moved = jnp.where(skinned[:, None], moved, 0.0)
        by_pose = [by_pose[i] + moved[i] for i in range(3)]
    return position, jnp.stack(by_pose), by_shape


def _chain(R, rest):
    """Rotations `24 3 3` and places `24 3` of the joints, one level of the tree at a
    time; the levels are in the order of the joints."""
    offset = rest[1:] - rest[jnp.array(PARENTS[1:])]
    G = jnp.eye(3, dtype=R.dtype)[None]
    x = jnp.zeros((1, 3), R.dtype)
    for level in LEVELS:
        parent = jnp.array([PARENTS[k] for k in level])
        here = slice(level[0] - 1, level[-1])
        x = jnp.concatenate(
            [x, x[parent] + jnp.einsum("kij,kj->ki", G[parent], offset[here])]
        )
        G = jnp.concatenate([G, jnp.einsum("kij,kjl->kil", G[parent], R[here])])
    return G, x
