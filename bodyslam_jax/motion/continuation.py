"""Extrapolates a motion from its last postures, frame by frame."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bodyslam_jax.body import BodyModel, local_joints
from bodyslam_jax.geometry import so3
from bodyslam_jax.motion.network import Window
from bodyslam_jax.motion.prediction import (
    MotionModel,
    check_compatible,
    in_dtype,
    leg_length,
)

_MAX_STEP_RAD = 0.35
"""Largest rotation of a joint in one frame, rad: 600 degrees a second."""


class Rollout(eqx.Module):
    """A motion: the given frames, and predicted ones after them."""

    orientation: Float[Array, "t 3 3"]
    """C_WH, in the given world W."""
    body_pose: Float[Array, "t 23 3"]
    """θ, rad."""
    trans: Float[Array, "t 3"]
    """Pelvis joint in W, m; the last given frame is at the origin."""


@eqx.filter_jit
def rollout(
    model: MotionModel,
    body: BodyModel,
    orientation: Float[Array, "p 3 3"],
    body_pose: Float[Array, "p 23 3"],
    shape: Float[Array, " 10"],
    frames: int,
) -> Rollout:
    """Continues a motion by `frames` frames from `p` given postures.

    Two postures suffice: a window longer than `p` is filled by extrapolating the first
    rate of change backwards. Rates are limited to plausible values.

    Args:
        orientation: C_WH.
        body_pose: θ, rad, at the frame rate of the model.
        shape: SMPL β.

    **Raises:** `InputError` if the model belongs to another body model.
    """
    check_compatible(model, body, model.fps)
    dtype = body_pose.dtype
    network = in_dtype(model, dtype).network
    leg = leg_length(body, shape)
    past = model.past
    given = len(body_pose)
    turn, pose = _extended(orientation, body_pose, past)

    def guess(turn, pose):
        joints = local_joints(body, pose, shape) / leg
        before = turn[-2]
        local = lambda x: jnp.einsum("ba,pbc->pac", before, x)
        world = jnp.einsum("pab,pjb->pja", turn, joints)
        return network(
            Window(
                rotation=local(turn),
                body_pose=pose,
                joints=jnp.einsum("ba,pjb->pja", before, world),
                shape=shape,
                leg=leg,
            )
        )

    def advance(carry, _):
        turn, pose = carry  # the last `past` frames
        # The predicted posture does not depend on the last frame of the window.
        ahead = guess(
            jnp.concatenate([turn, turn[-1:]]), jnp.concatenate([pose, pose[-1:]])
        )
        turns = so3.between(pose[-1], ahead.body_pose)
        next_pose = so3.compose(pose[-1], _limited(turns))
        spin = so3.exp(_limited(ahead.rotation))
        next_turn = turn[-1] @ spin
        turn = jnp.concatenate([turn, next_turn[None]])
        pose = jnp.concatenate([pose, next_pose[None]])
        move = turn[-2] @ guess(turn, pose).translation
        return (turn[1:], pose[1:]), (next_turn, next_pose, move)

    _, (turns, poses, moves) = jax.lax.scan(advance, (turn, pose), None, frames)
    given_path = _given_path(guess, turn, pose, orientation, body_pose, given)
    return Rollout(
        orientation=jnp.concatenate([orientation, turns]),
        body_pose=jnp.concatenate([body_pose, poses]),
        trans=jnp.concatenate([given_path, jnp.cumsum(moves, 0)]),
    )


def _given_path(guess, turn, pose, orientation, body_pose, given):
    """Returns predicted positions in the given frames, with the last one at the
    origin."""
    turns = jnp.concatenate([turn[: len(turn) - min(given, len(turn))], orientation])
    poses = jnp.concatenate([pose[: len(pose) - min(given, len(pose))], body_pose])
    size = len(turn) + 1
    steps = []
    for k in range(1, given):
        last = len(turns) - given + k
        rows = jnp.clip(jnp.arange(last - size + 1, last + 1), 0)
        steps.append(turns[last - 1] @ guess(turns[rows], poses[rows]).translation)
    path = (
        jnp.concatenate(
            [jnp.zeros((1, 3), body_pose.dtype), jnp.cumsum(jnp.stack(steps), 0)]
        )
        if steps
        else jnp.zeros((1, 3), body_pose.dtype)
    )
    return path - path[-1]


def _limited(angles: Float[Array, "*b 3"]) -> Float[Array, "*b 3"]:
    """Scales rotation vectors down to a length of at most `_MAX_STEP_RAD`."""
    square = (angles * angles).sum(-1, keepdims=True)
    norm = jnp.sqrt(jnp.maximum(square, 1e-12))
    return angles * jnp.minimum(1.0, _MAX_STEP_RAD / norm)


def _extended(turn, pose, past):
    """Returns the last `past` frames; missing ones are extrapolated with decaying
    rates."""
    missing = past - len(pose)
    if missing <= 0:
        return turn[-past:], pose[-past:]
    if len(pose) == 1:
        return jnp.repeat(turn, past, 0), jnp.repeat(pose, past, 0)
    decay = np.cumsum(0.7 ** np.arange(1, missing + 1))[::-1]
    decay = jnp.asarray(decay.copy(), pose.dtype)
    spin = so3.log(so3.inverse(turn[1]) @ turn[0])
    back_turn = turn[0] @ so3.exp(decay[:, None] * spin)
    rate = so3.between(pose[1], pose[0])
    back_pose = so3.compose(pose[0][None], decay[:, None, None] * rate)
    return jnp.concatenate([back_turn, turn]), jnp.concatenate([back_pose, pose])
