"""Forward kinematics: joints and keypoints of a pose and shape.

In SMPL (Loper et al., 2015) the joints at rest are linear in the shape,
`J(β) = J_0 + J_s β`; joint k rotates in its parent's frame,
`G_k = G_parent R_k`, `x_k = x_parent + G_parent (J_k - J_parent)`.

Keypoints on the skin require a few vertices (`BodyModel.picks`) only. Internally, the
batch is the last axis, so that products of 3x3 matrices are arithmetic on long vectors,
one level of the kinematic tree at a time.
"""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bodyslam_jax.body.model import BodyModel
from bodyslam_jax.body.skeleton import (
    DETECTOR_BIAS,
    KEYPOINT_JOINT,
    KEYPOINT_NAMES,
    PARENTS,
    SURFACE_POINTS,
    ancestors,
)
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.geometry import so3

_PARENT = np.array(PARENTS[1:])
"""Parents of joints 1 to 23."""
_ARGUMENT_AXES = {
    "body_pose": ((23, 3), "axis-angle of joints 1 to 23, without the root"),
    "pose": ((72,), "axis-angle of 24 joints, root first, in one axis"),
    "shape": ((10,), "SMPL β"),
    "trans": ((3,), "a translation, m"),
}
"""Last axes and meaning of each argument."""


def batch_of(function: str, **arguments: Array) -> tuple[int, ...]:
    """Returns the shape to which the leading axes of the arguments broadcast.

    **Raises:** `InputError` naming the argument whose last axes are wrong, or all
    leading axes if they do not broadcast.
    """
    leads = {}
    for name, x in arguments.items():
        tail, meaning = _ARGUMENT_AXES[name]
        shape = jnp.shape(x)
        if shape[-len(tail) :] != tail:
            expected = ", ".join(map(str, tail))
            raise InputError(
                f"{function}: `{name}` has shape {shape}, expected (..., {expected}): "
                f"{meaning}."
            )
        leads[name] = shape[: -len(tail)]
    try:
        return np.broadcast_shapes(*leads.values())
    except ValueError:
        found = ", ".join(f"`{name}` {lead}" for name, lead in leads.items())
        raise InputError(
            f"{function}: leading axes {found}, expected axes that broadcast."
        ) from None


@jax.jit
def rest_joints(
    model: BodyModel, shape: Float[Array, "*b 10"]
) -> Float[Array, "*b 24 3"]:
    """Returns the joints at rest for SMPL β, m, in the model's frame (pelvis at
    `J_0(β)`).

    **Raises:** `InputError` naming an argument of another shape.
    """
    batch_of("rest_joints", shape=shape)
    moved = shape @ model.joint_shape_dirs.reshape(72, 10).T
    return model.joint_template + moved.reshape(*shape.shape[:-1], 24, 3)


@jax.jit
def local_joints(
    model: BodyModel,
    body_pose: Float[Array, "*#b 23 3"],
    shape: Float[Array, "*#b 10"],
) -> Float[Array, "*b 24 3"]:
    """Returns posed joints in the root frame H, m: the pelvis is the origin, unrotated.

    `body_pose` holds the axis-angle rotations of joints 1 to 23, rad, each in its
    parent's frame; `shape` is SMPL β. Leading axes broadcast.

    **Raises:** `InputError` naming an argument of another shape.
    """
    batch = batch_of("local_joints", body_pose=body_pose, shape=shape)
    R = _under_root(flatten(body_pose, batch, 2))
    return _unflatten(pose_joints(model, R, flatten(shape, batch, 1)).x, batch)


@jax.jit
def joints(
    model: BodyModel,
    pose: Float[Array, "*#b 72"],
    shape: Float[Array, "*#b 10"],
    trans: Float[Array, "*#b 3"],
) -> Float[Array, "*b 24 3"]:
    """Returns posed joints, m, in the frame to which the root rotation `pose[:3]` maps.

    The pelvis is at `J_0(β) + trans` for every pose. Leading axes broadcast.

    **Raises:** `InputError` naming an argument of another shape.
    """
    batch_of("joints", pose=pose, shape=shape, trans=trans)
    return _placed(model, pose, shape, trans, lambda posed, shape: posed.x)


@functools.partial(jax.jit, static_argnames="layout")
def local_keypoints(
    model: BodyModel,
    body_pose: Float[Array, "*#b 23 3"],
    shape: Float[Array, "*#b 10"],
    layout: str = "body25",
    bias: float | Float[Array, ""] = 0.0,
) -> Float[Array, "*b keypoints 3"]:
    """Returns keypoints of a 2D detector in the root frame H, m: joints and vertices.

    **Arguments:**

    - `layout`: `body25`, `coco17` or `halpe26`; names are in `KEYPOINT_NAMES`.
    - `bias`: 0 for keypoints at SMPL's joints of the same names, 1 for hips, neck and
        shoulders as located by detectors trained on COCO (`DETECTOR_BIAS`); keypoints
        are linear in it.

    **Raises:** `InputError` naming an argument of another shape.
    """
    batch = batch_of("local_keypoints", body_pose=body_pose, shape=shape)
    beta = flatten(shape, batch, 1)
    posed = pose_joints(model, _under_root(flatten(body_pose, batch, 2)), beta)
    return _unflatten(_detected(model, posed, beta, layout, bias), batch)


@functools.partial(jax.jit, static_argnames="layout")
def keypoints(
    model: BodyModel,
    pose: Float[Array, "*#b 72"],
    shape: Float[Array, "*#b 10"],
    trans: Float[Array, "*#b 3"],
    layout: str = "body25",
    bias: float | Float[Array, ""] = 0.0,
) -> Float[Array, "*b keypoints 3"]:
    """Returns the keypoints of `local_keypoints` in the frame of `joints`, m.

    **Raises:** `InputError` naming an argument of another shape.
    """
    batch_of("keypoints", pose=pose, shape=shape, trans=trans)
    points = lambda posed, beta: _detected(model, posed, beta, layout, bias)
    return _placed(model, pose, shape, trans, points)


class Posed:
    """Joints of `n` bodies relative to the pelvis, with the batch last.

    The frame is the one to which the root's rotation maps. Instances are used only
    within jitted functions.
    """

    def __init__(self, R, rest, G, x):
        self.R = R
        """Rotations of all joints in their parents' frames, (24, 3, 3, n)."""
        self.rest = rest
        """Joints at rest, m, (24, 3, n)."""
        self.G = G
        """Rotations from all joints to that frame, (24, 3, 3, n)."""
        self.x = x
        """Positions of all joints, m, (24, 3, n)."""


def rotations(pose: Float[Array, "n k 3"]) -> Float[Array, "k 3 3 n"]:
    """Converts axis-angle vectors (rad) to matrices, with the batch last.

    **Raises:** `TypeError` for other types than float32 and float64.
    """
    if pose.dtype not in (jnp.float32, jnp.float64):
        raise TypeError(f"poses are of type {pose.dtype}, expected float32 or float64.")
    return so3.exp(pose.transpose(1, 0, 2)).transpose(0, 2, 3, 1)


def _under_root(body_pose):
    """Returns rotations of all joints, with the identity for the root."""
    R = rotations(body_pose)
    return jnp.concatenate([_identity(R), R])


def pose_joints(
    model: BodyModel, R: Float[Array, "24 3 3 n"], shape: Float[Array, "n 10"]
) -> Posed:
    """Computes forward kinematics of a flat batch."""

    def of_shape(template, dirs):
        """Returns template plus blend shapes, with the batch last."""
        moved = dirs.reshape(-1, 10) @ shape.T
        return template[:, :, None] + moved.reshape(*template.shape, -1)

    J_0, J_s = model.joint_template, model.joint_shape_dirs
    # Bones from their own blend shapes, not as differences of joints: one product less
    # to differentiate.
    bones = of_shape(J_0[1:] - J_0[_PARENT], J_s[1:] - J_s[_PARENT])
    return Posed(R, of_shape(J_0, J_s), *_chain(R, bones))


def matmul(A, B):
    """Multiplies `A` (j, 3, 3, n) and `B` (j, 3, c, n) along their middle axes.

    The product is written as a sum of terms, which XLA fuses into one loop.
    """
    term = lambda i: A[:, :, i, None] * B[:, None, i]
    return term(0) + term(1) + term(2)


def matvec(A, x):
    """Multiplies `A` (j, 3, 3, n) and `x` (j, 3, n)."""
    return (
        A[:, :, 0] * x[:, None, 0]
        + A[:, :, 1] * x[:, None, 1]
        + (A[:, :, 2] * x[:, None, 2])
    )


def flatten(x, batch, num_axes):
    """Broadcasts the leading axes to `batch` and merges them into one."""
    tail = x.shape[x.ndim - num_axes :]
    return jnp.broadcast_to(x, (*batch, *tail)).reshape(math.prod(batch), *tail)


def pelvis_place(model, shape, trans):
    """Returns the pelvis positions, m, (3, n), of a flat batch."""
    return (model.joint_template[0] + shape @ model.joint_shape_dirs[0].T + trans).T


def _unflatten(points, batch):
    """Converts points (k, 3, n) to (*batch, k, 3)."""
    return points.transpose(2, 0, 1).reshape(*batch, points.shape[0], 3)


def _placed(model, pose, shape, trans, points):
    """Evaluates `points` of posed bodies, and adds the position of the pelvis."""
    batch = jnp.broadcast_shapes(pose.shape[:-1], shape.shape[:-1], trans.shape[:-1])
    pose, beta = flatten(pose, batch, 1), flatten(shape, batch, 1)
    posed = pose_joints(model, rotations(pose.reshape(len(pose), 24, 3)), beta)
    pelvis = pelvis_place(model, beta, flatten(trans, batch, 1))
    return _unflatten(points(posed, beta) + pelvis, batch)


def _detected(model, posed, shape, layout, bias):
    """Returns keypoints (k, 3, n) relative to the pelvis, m.

    **Raises:** `InputError` for an unknown layout.
    """
    if layout not in KEYPOINT_NAMES:
        layouts = ", ".join(KEYPOINT_NAMES)
        raise InputError(f"keypoint layout {layout!r}, expected one of {layouts}.")
    names = KEYPOINT_NAMES[layout]
    surface = [n for n in names if n in SURFACE_POINTS]
    inner = [n for n in names if n not in SURFACE_POINTS]
    joint = np.array([KEYPOINT_JOINT[n] for n in inner])
    offset = np.array([DETECTOR_BIAS.get(n, (0.0, 0.0, 0.0)) for n in inner])
    offset = jnp.asarray(bias, posed.x.dtype) * jnp.asarray(offset, posed.x.dtype)
    at_joint = posed.x[joint] + matvec(posed.G[joint], offset[:, :, None])
    on_skin = _picked_vertices(model, surface, posed, shape)
    order = np.array([(inner + surface).index(n) for n in names])
    return jnp.concatenate([at_joint, on_skin])[order]


def _picked_vertices(model, names, posed, shape):
    """Returns the skinned vertices of the named surface points, (k, 3, n), relative to
    the pelvis, m."""
    v = model.picks[np.array([SURFACE_POINTS.index(n) for n in names])]
    dirs = model.shape_dirs[v].reshape(-1, 10)
    rest = model.template[v][:, :, None] + (dirs @ shape.T).reshape(len(names), 3, -1)
    num_features = model.pose_dirs.shape[-1]
    if num_features:
        feature = pose_feature(posed.R)[:num_features]
        dirs = model.pose_dirs[v].reshape(-1, num_features)
        rest = rest + (dirs @ feature).reshape(rest.shape)
    # `Σ_j w_j (x_j + G_j (rest - rest_j))` with dense weights of all joints: two
    # products, where gathers for each joint of a vertex are five times as many loops.
    joint = jnp.arange(24, dtype=model.skin_joint.dtype)
    weight = jnp.sum(
        jnp.where(
            model.skin_joint[v][..., None] == joint,
            model.skin_weight[v][..., None],
            0.0,
        ),
        axis=1,
    )
    mixed = lambda u: (weight @ u.reshape(24, -1)).reshape(len(names), *u.shape[1:])
    return matvec(mixed(posed.G), rest) + mixed(posed.x - matvec(posed.G, posed.rest))


def pose_feature(R):
    """Returns SMPL's pose feature `vec(R_k - I)`, k = 1, 2, ...: (207, n) from
    (24, 3, 3, n)."""
    eye = jnp.eye(3, dtype=R.dtype)[None, :, :, None]
    return (R[1:] - eye).reshape(207, R.shape[-1])


# The kinematic chain has a custom derivative: differentiating the matrix products level
# by level is slow to compile and to run. A small rotation φ_k of joint k about
# its position (axis-angle, outer frame) moves every joint below it rigidly:
#   Ω_k = Σ φ_i,  dx_k = Σ (Ω_parent(i) x b_i + G_parent(i) do_i),
# with sums over i from the root to k, computed as products with constant 0-1 matrices;
# o_i is the bone to joint i at rest and b_i = G_parent(i) o_i.


_PATH_TO_JOINT = ancestors().T
"""1 for each joint of the row's path from the root, including the row's own."""
_PATH_TO_PARENT = _PATH_TO_JOINT[_PARENT]
"""The same for the parents of joints 1 to 23."""


@jax.custom_jvp
def _chain(R, bones):
    """Returns `G` (24, 3, 3, n) and `x` (24, 3, n) from `R` and bones (23, 3, n) at
    rest.

    Rotations are composed by doubling the length of the path at each step: a product
    for each of the eight levels of the tree takes twice as long to compile.
    """
    G = jnp.concatenate([R, _identity(R)])
    # Index 24 is the identity, the parent of the root and of itself.
    above = np.append(np.where(np.array(PARENTS) < 0, 24, PARENTS), 24)
    while (above != 24).any():
        G = matmul(G[above], G)
        above = above[above]
    G = G[:24]
    return G, _tree_sum(_PATH_TO_JOINT[:, 1:], matvec(G[_PARENT], bones))


@_chain.defjvp
def _chain_jvp(primals, tangents):
    R, bones = primals
    dR, dbones = tangents
    G, x = _chain(R, bones)
    above = G[_PARENT]
    G_parent = jnp.concatenate([_identity(G), above])
    spin = lambda i, j: (dR[:, i] * R[:, j]).sum(1)  # of dR Rᵀ, which is skew
    phi = matvec(G_parent, jnp.stack([spin(2, 1), spin(0, 2), spin(1, 0)], 1))
    omega, omega_parent = (
        _tree_sum(_PATH_TO_JOINT, phi),
        _tree_sum(_PATH_TO_PARENT, phi),
    )
    dx = _cross(omega_parent, matvec(above, bones)) + matvec(above, dbones)
    dG = jnp.stack([_cross(omega, G[:, :, i]) for i in range(3)], 2)
    return (G, x), (dG, _tree_sum(_PATH_TO_JOINT[:, 1:], dx))


def _identity(R):
    """Returns identity rotations of the root, (1, 3, 3, n), in the shape of `R`."""
    eye = jnp.eye(3, dtype=R.dtype)[..., None]
    return jnp.broadcast_to(eye, (1, 3, 3, R.shape[-1]))


def _tree_sum(ones, u):
    """Sums `u` (j, ...) over the joints that each row of a 0-1 matrix selects."""
    return (jnp.asarray(ones, u.dtype) @ u.reshape(len(u), -1)).reshape(
        len(ones), *u.shape[1:]
    )


def _cross(a, b):
    """Returns cross products of two arrays (j, 3, n) along their middle axis."""
    c = lambda i, j: a[:, i] * b[:, j] - a[:, j] * b[:, i]
    return jnp.stack([c(1, 2), c(2, 0), c(0, 1)], 1)
