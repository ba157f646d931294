"""The state: all variables of the graph, their tangent space and retraction.

Cameras carry the paper's scale over-parameterisation (Section 3.6): `r_WC = s r'_WC`
with a linear `s`. People are anchored in the camera (`T_CH`, not `T_WH`), so that the
keypoint factors depend neither on the cameras nor on `s`, which can then change freely.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.geometry import so3
from bodyslam_jax.geometry.lengths import lengthened, padded_length, shortened

TURNS = 69
"""Number of coordinates of the turns of a posture's 23 joints, three each."""
_PERTURBATION_SIGMA = 0.01
"""Standard deviation of a random step, in the unit of each coordinate."""


class Step(eqx.Module):
    """An element of the tangent space of a `State`."""

    scale: Float[Array, ""]
    """m per unit of the map"""
    cameras: Float[Array, "t 6"]
    """Rotation vector in the camera's own frame (rad), then centre (units, world)."""
    roots: Float[Array, "h t 6"]
    """Rotation vector in the person's own frame (rad), then pelvis (m, camera)."""
    poses: Float[Array, "h t 23 3"]
    """Rotation vector in each joint's own frame, rad."""
    shapes: Float[Array, "h 10"]
    landmarks: Float[Array, "l 3"]
    """units of the map"""
    intrinsics: Float[Array, " i"]
    """px for focal length and centre; dimensionless for distortion."""
    globals: Float[Array, " g"] = None  # pyright: ignore[reportAssignmentType]
    """Named variables that all frames have in common, one after another."""

    def __post_init__(self):
        if self.globals is None:
            self.globals = _no_globals(self.scale)


class State(eqx.Module):
    """`t` cameras, `h` people, `l` landmarks."""

    scale: Float[Array, ""]
    """s, metres per unit of the map"""
    cameras: Float[Array, "t 4 4"]
    """T'_WC: camera to world, with its centre in units of the map: `r_WC = s r'_WC`."""
    roots: Float[Array, "h t 4 4"]
    """T_CH: person's root frame to camera; translation is the pelvis joint, m."""
    poses: Float[Array, "h t 23 3"]
    """θ: axis-angle of each joint but the root, rad."""
    shapes: Float[Array, "h 10"]
    """SMPL β"""
    landmarks: Float[Array, "l 3"]
    """Static points in the world frame, units of the map."""
    intrinsics: Float[Array, " i"]
    """`fx fy cx cy` px, then `k1 k2 p1 p2` if distorted."""
    globals: Float[Array, " g"] = None  # pyright: ignore[reportAssignmentType]
    """Named variables that all frames have in common, one after another, each in its
    own unit; `Problem.globals` has their names and sizes. None without it."""

    def __post_init__(self):
        if self.globals is None:
            self.globals = _no_globals(self.scale)

    def retract(self, step: Step) -> "State":
        """Moves by `step`: rotations through the exponential map, the rest added."""
        poses = jnp.concatenate([self.cameras[None], self.roots])
        steps = jnp.concatenate([step.cameras[None], step.roots])
        moved = retract_pose(poses, steps)
        return State(
            scale=self.scale + step.scale,
            cameras=moved[0],
            roots=moved[1:],
            poses=retract_rotation(self.poses, step.poses),
            shapes=self.shapes + step.shapes,
            landmarks=self.landmarks + step.landmarks,
            intrinsics=self.intrinsics + step.intrinsics,
            globals=self.globals + step.globals,
        )

    def local(self, other: "State") -> Step:
        """Returns the step to `other`, the inverse of `retract`, for rotations by
        less than half a turn."""
        poses = jnp.concatenate([self.cameras[None], self.roots])
        others = jnp.concatenate([other.cameras[None], other.roots])
        steps = local_pose(poses, others)
        return Step(
            scale=other.scale - self.scale,
            cameras=steps[0],
            roots=steps[1:],
            poses=so3.between(self.poses, other.poses),
            shapes=other.shapes - self.shapes,
            landmarks=other.landmarks - self.landmarks,
            intrinsics=other.intrinsics - self.intrinsics,
            globals=other.globals - self.globals,
        )

    def zero_step(self) -> Step:
        """Returns the step that is 0 in all coordinates."""
        return Step(
            scale=jnp.zeros_like(self.scale),
            cameras=jnp.zeros_like(self.cameras, shape=(*self.cameras.shape[:-2], 6)),
            roots=jnp.zeros_like(self.roots, shape=(*self.roots.shape[:-2], 6)),
            poses=jnp.zeros_like(self.poses),
            shapes=jnp.zeros_like(self.shapes),
            landmarks=jnp.zeros_like(self.landmarks),
            intrinsics=jnp.zeros_like(self.intrinsics),
            globals=jnp.zeros_like(self.globals),
        )


def _no_globals(scale: Any) -> Float[Array, " 0"]:
    """Returns an empty vector of the precision of `scale`."""
    return jnp.zeros((0,), getattr(scale, "dtype", None))


def retract_pose(
    pose: Float[Array, "*b 4 4"], step: Float[Array, "*b 6"]
) -> Float[Array, "*b 4 4"]:
    """Returns the pose with `C Exp(step[:3])` and `r + step[3:]`."""
    turn = so3.exp(step[..., :3])
    top = jnp.concatenate(
        [
            pose[..., :3, :3] @ turn,
            (pose[..., :3, 3] + step[..., 3:])[..., None],
        ],
        axis=-1,
    )
    return jnp.concatenate([top, pose[..., 3:, :]], axis=-2)


def local_pose(
    pose: Float[Array, "*b 4 4"], other: Float[Array, "*b 4 4"]
) -> Float[Array, "*b 6"]:
    """Returns the step from one pose to another, the inverse of `retract_pose`."""
    turn = so3.log(so3.inverse(pose[..., :3, :3]) @ other[..., :3, :3])
    return jnp.concatenate([turn, other[..., :3, 3] - pose[..., :3, 3]], axis=-1)


def retract_rotation(
    rotation: Float[Array, "*b 3"], step: Float[Array, "*b 3"]
) -> Float[Array, "*b 3"]:
    """Returns `Log(Exp(rotation) Exp(step))`, continuous in `step` for angles up to pi.

    For vectors longer than 2 rad the branch of the logarithm is that of `rotation`, so
    an axis-angle vector may leave the ball of radius pi without a jump. Beyond 2 pi - 2
    it wraps by a full turn, to the same rotation.
    """
    moved = so3.compose(rotation, step)
    squared = jnp.sum(moved**2, axis=-1, keepdims=True)
    # The 2 rad of the docstring, squared.
    far = squared > 4.0
    angle = jnp.sqrt(jnp.where(far, squared, 1.0))
    flipped = jnp.sum(moved * rotation, axis=-1, keepdims=True) < 0
    return jnp.where(far & flipped, moved * (1 - 2 * jnp.pi / angle), moved)


def world_from_root(state: State) -> Float[Array, "h t 4 4"]:
    """Returns T_WH in metres: `r_WH = s r'_WC + C_WC r_CH`, `C_WH = C_WC C_CH`."""
    cameras = state.cameras.at[:, :3, 3].multiply(state.scale)
    return cameras @ state.roots


@jax.jit
def moved_at_random(state: State) -> State:
    """Returns a state close by, drawn with a fixed key, at which no residual or
    derivative is 0 by chance."""
    leaves, treedef = jax.tree.flatten(state.zero_step())
    keys = jax.random.split(jax.random.key(0), len(leaves))
    draw = lambda key, x: _PERTURBATION_SIGMA * jax.random.normal(key, x.shape, x.dtype)
    step = [draw(k, x) for k, x in zip(keys, leaves, strict=True)]
    return state.retract(treedef.unflatten(step))


def gauge(cameras: Float[Array, "t 4 4"]) -> Float[Array, "t 6"]:
    """Returns 1 where a camera coordinate is free, 0 where it is held to fix the gauge.

    The world's origin and axes are the first camera; the unit of the map is one
    coordinate, the largest, of the camera that is farthest from it. Seven numbers are
    held exactly, so that no prior is needed and the normal equations have no null
    space.
    """
    frames = len(cameras)
    return shortened(_gauge(lengthened(cameras, padded_length(frames))), frames)


@jax.jit
def _gauge(cameras: Float[Array, "t 4 4"]) -> Float[Array, "t 6"]:
    offset = jnp.abs(cameras[:, :3, 3] - cameras[0, :3, 3])
    held = jnp.zeros_like(offset).reshape(-1).at[jnp.argmax(offset)].set(1.0)
    free = jnp.concatenate([jnp.ones_like(offset), 1 - held.reshape(-1, 3)], axis=1)
    return free.at[0].set(0.0)
