"""Keypoints rigidly attached to bones, with derivatives in closed form.

A surface keypoint (nose, ears, heels, toes) is attached to one bone as at rest, which
is within millimetres of the skinned vertex. Derivatives are therefore geometric:
rotating joint j by a small vector ω about its own centre moves a point x below it by
`ω x (x - x_j)`. Differentiation through a chain of rotations would compile and run an
order of magnitude slower.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bodyslam_jax.body import PARENTS, BodyModel, local_keypoints, rest_joints
from bodyslam_jax.body.keypoint_definitions import definition_offsets
from bodyslam_jax.body.skeleton import LEVELS
from bodyslam_jax.geometry import so3
from bodyslam_jax.people.stature import linear_stature

# Bone that carries each BODY_25 keypoint: SMPL's joint of that name, the head for the
# face, the toe joint for toes, the ankle for heels.
_KEYPOINT_BONE = np.array(
    [15, 12, 17, 19, 21, 16, 18, 20, 0, 2, 5, 8, 1, 4, 7]
    + [15, 15, 15, 15, 10, 10, 7, 11, 11, 8]
)
_CARRIER = np.concatenate([PARENTS, _KEYPOINT_BONE])


def _paths() -> np.ndarray:
    """Returns which offsets (24 joints, then 25 keypoints) add up to each point's
    position."""
    path = np.zeros((49, 49))
    for point in range(49):
        link = point
        while link > 0:
            path[point, link] = 1.0
            link = _CARRIER[link]
    return path


_PATH_MATRIX = _paths()


_OFFSETS = (
    *(((9, 12), axis, sigma) for axis, sigma in ((0, 0.02), (1, 0.04), (2, 0.02))),
    *(((2, 5), axis, sigma) for axis, sigma in ((0, 0.02), (1, 0.025), (2, 0.02))),
    *(((8,), axis, sigma) for axis, sigma in ((1, 0.04), (2, 0.02))),
    *(((1,), axis, sigma) for axis, sigma in ((1, 0.03), (2, 0.02))),
    *(((10, 13), axis, sigma) for axis, sigma in ((1, 0.02), (2, 0.015))),
    *(((11, 14), axis, sigma) for axis, sigma in ((1, 0.02), (2, 0.015))),
    *(((3, 6), 0, 0.02), ((4, 7), 0, 0.025)),
    *(((0, 15, 16, 17, 18), axis, 0.02) for axis in (1, 2)),
    *(((19, 20, 22, 23), axis, 0.02) for axis in (1, 2)),
    *(((21, 24), axis, 0.015) for axis in (1, 2)),
)
"""Offsets of a detector's keypoints from SMPL's, constant for a detector and person:
keypoints, axis of the bone they are attached to, prior standard deviation (m), mirrored
in x. They are estimated as extra shape components; without them an offset of the hip of
3 cm would appear as legs bent by 20 degrees. The deviations are of the size of what is
left of a detector's errors after its definition, 0.6 to 2.8 % of the stature along an
axis (`benchmarks/keypoints.md`)."""
NUM_SHAPE = 10 + len(_OFFSETS)
"""Number of shape components: β, then the detector's offsets in standard deviations."""
_LEFT_KEYPOINTS = (5, 6, 7, 12, 13, 14, 16, 18, 19, 20, 21)


class Skeleton(eqx.Module):
    """Offsets of 24 joints and 25 keypoints from the joints that carry them, at
    rest."""

    offset: Float[Array, "49 3"]
    """Offsets for β = 0, m; that of the pelvis is 0."""
    offset_shape: Float[Array, "49 3 s"]
    """Change of the offsets per unit of each of the `NUM_SHAPE` shape components, m."""


class Points(eqx.Module):
    """A posed skeleton in the root frame H, m, with the pelvis at the origin."""

    joints: Float[Array, "24 3"]
    keypoints: Float[Array, "25 3"]
    by_angle: Float[Array, "25 21 3 3"]
    """Derivative of a keypoint's coordinate (last axis) with respect to a component of
    the angle of joints 1 to 21."""
    by_shape: Float[Array, "25 3 s"]


@eqx.filter_jit
def _at_rest(body: BodyModel, bias: Array) -> Float[Array, "11 49 3"]:
    dtype = body.joint_template.dtype
    shapes = jnp.concatenate([jnp.zeros((1, 10), dtype), jnp.eye(10, dtype=dtype)])
    joints = rest_joints(body, shapes)
    pose = jnp.zeros((23, 3), dtype)
    keypoints = local_keypoints(body, pose, shapes, "body25", bias)
    return jnp.concatenate([joints - joints[:, :1], keypoints], axis=1)


def make_skeleton(
    body: BodyModel, bias: float, definition: str = "unknown"
) -> Skeleton:
    """Returns the skeleton of a body model.

    `bias` is that of `body.local_keypoints`: 0 for SMPL's joints, 1 for COCO detectors.
    Keypoints are also moved by the offsets of `definition` if this is the default body.
    """
    dtype = body.joint_template.dtype
    rest = np.asarray(_at_rest(body, jnp.asarray(bias, dtype)), float)
    offset = rest - np.where(_CARRIER[:, None] >= 0, rest[:, _CARRIER], 0.0)
    if body.kind == "default":
        linear = linear_stature(body)
        stature = linear.template + np.append(0.0, linear.slope)
        offset[:, 24:] += stature[:, None, None] * definition_offsets(definition)
    by_shape = np.zeros((49, 3, NUM_SHAPE))
    by_shape[..., :10] = np.moveaxis(offset[1:] - offset[0], 0, -1)
    for column, (points, axis, sigma) in enumerate(_OFFSETS, start=10):
        for point in points:
            mirrored = axis == 0 and point not in _LEFT_KEYPOINTS
            by_shape[24 + point, axis, column] = -sigma if mirrored else sigma
    return Skeleton(jnp.asarray(offset[0], dtype), jnp.asarray(by_shape, dtype))


def place_points(
    skeleton: Skeleton, angles: Float[Array, " 63"], shape: Float[Array, " s"]
) -> tuple[Float[Array, "24 3"], Float[Array, "25 3"]]:
    """Returns joints and keypoints in H, m, without derivatives."""
    orientation = _orientations(so3.exp(angles.reshape(21, 3)))
    offset = skeleton.offset + skeleton.offset_shape @ shape
    carried = jnp.einsum("pij,pj->pi", orientation[_carriers()], offset)
    point = jnp.asarray(_PATH_MATRIX, angles.dtype) @ carried
    return point[:24], point[24:]


def pose_points(
    skeleton: Skeleton, angles: Float[Array, " 63"], shape: Float[Array, " s"]
) -> Points:
    """Returns joints and keypoints in H, m, with derivatives."""
    theta = angles.reshape(21, 3)
    turn = so3.exp(theta)
    change = jax.vmap(jax.jacfwd(so3.exp))(theta)
    # dR/dθ_a R' is the cross product's matrix of the axis about which θ_a turns.
    spin = jnp.einsum("jika,jlk->jila", change, turn)
    axis = jnp.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)
    orientation = _orientations(turn)
    axis = orientation[jnp.array(PARENTS[1:22])] @ axis

    offsets = jnp.concatenate(
        [(skeleton.offset + skeleton.offset_shape @ shape)[..., None]]
        + [skeleton.offset_shape],
        axis=-1,
    )
    carried = orientation[_carriers()] @ offsets
    point = jnp.tensordot(jnp.asarray(_PATH_MATRIX, angles.dtype), carried, 1)
    place, by_shape = point[..., 0], point[24:, :, 1:]
    arm = place[24:, None] - place[None, 1:22]
    arm = arm * jnp.asarray(_below(), angles.dtype)[..., None]
    by_angle = jnp.cross(jnp.swapaxes(axis, -1, -2)[None], arm[:, :, None])
    return Points(place[:24], place[24:], by_angle, by_shape)


def _carriers() -> Array:
    return jnp.array(np.maximum(_CARRIER, 0))


def _below() -> np.ndarray:
    """Returns whether keypoint k is attached to joint j + 1, directly or through
    others."""
    return _PATH_MATRIX[24:, 1:22]


def _orientations(turn: Float[Array, "21 3 3"]) -> Float[Array, "24 3 3"]:
    """Returns the orientation of every joint in H; hands are not rotated."""
    still = jnp.broadcast_to(jnp.eye(3, dtype=turn.dtype), (2, 3, 3))
    turn = jnp.concatenate([still[:1], turn, still])
    found = turn[:1]
    for level in LEVELS:
        first, last = level[0], level[-1] + 1
        parent = jnp.array(PARENTS[first:last])
        found = jnp.concatenate([found, found[parent] @ turn[first:last]])
    return found
