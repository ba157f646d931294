"""Predicts displacements of the pelvis between frames from a sequence of postures.

`straightened` removes steady yaw from the orientations that are input to the motion
model. Training data are mostly straight walks; on curves the network underestimates
displacements by some per cent. A curve changes the direction of later steps, which
does not matter in the frame of the previous pose, in which displacement is predicted.
So the slowly varying yaw rate about the body's up axis is removed, and the oscillation
with each stride is kept.

`rollout` extrapolates a motion from its last postures, frame by frame.
"""

from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float

from bodyslam_jax.body import BodyModel, local_joints, rest_joints
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.geometry import so3
from bodyslam_jax.motion.network import MotionNetwork, Window
from bodyslam_jax.motion.position_network import MetricNetwork

_SIGMA_FRAMES = 15
"""Standard deviation of the smoothing kernel, frames at 30 fps: about half a stride."""
_MAX_STEP_RAD = 0.35
"""Largest rotation of a joint in one frame, rad: 600 degrees a second."""
Arrays = TypeVar("Arrays", bound=eqx.Module)


class MotionModel(eqx.Module):
    """A network, or a user's function, with its body model and frame rate."""

    network: MotionNetwork
    body: str = eqx.field(static=True)
    """Kind of body model that the network was trained on, such as `default` or
    `smpl`."""
    fps: float = eqx.field(static=True)
    """Frame rate of the input, 1/s."""
    past: int = eqx.field(static=True)
    """Number of past frames that a prediction needs."""
    about: str = eqx.field(static=True, default="{}")
    """The file's header as JSON: data, licence, settings, metrics."""


class Prediction(eqx.Module):
    """Predictions for one person; row k is the step from frame k-1 to k."""

    translation: Float[Array, "t 3"]
    """Displacement of the pelvis joint in H_{k-1}, m per frame."""
    covariance: Float[Array, "t 3 3"]
    """Covariance of the error of `translation` in one frame, m²; errors are correlated
    in time."""
    body_pose: Float[Array, "t 23 3"]
    """θ_k predicted from frames up to k-1, rad."""
    rotation: Float[Array, "t 3"]
    """Rotation vector of C_{H_{k-1}}^T C_{H_k} predicted from frames up to k-1, rad."""
    valid: Bool[Array, " t"]
    """True if all frames that row k depends on are present; else values are
    undefined."""


@jax.jit
def leg_length(body: BodyModel, shape: Float[Array, "*b 10"]) -> Float[Array, "*b"]:
    """Returns the leg length of a body (m): hip to knee to ankle, mean of both
    sides."""
    rest = rest_joints(body, shape)
    bones = rest[..., np.array([4, 7, 5, 8]), :] - rest[..., np.array([1, 4, 2, 5]), :]
    return jnp.sqrt((bones**2).sum(-1)).sum(-1) / 2


def sequence_windows(
    body: BodyModel,
    orientation: Float[Array, "t 3 3"],
    body_pose: Float[Array, "t 23 3"],
    shape: Float[Array, " 10"],
    past: int,
) -> Window:
    """Returns the `t - past` windows of a sequence; the target of the first is frame
    `past`.

    Root orientations are relative to the frame before the target, so that neither
    heading nor up axis of the world matters.
    """
    leg = leg_length(body, shape)
    joints = local_joints(body, body_pose, shape) / leg
    facing = jnp.einsum("tab,tjb->tja", orientation, joints)
    rows = np.arange(len(body_pose) - past)[:, None] + np.arange(past + 1)
    before = orientation[rows[:, -2]]
    return Window(
        rotation=jnp.einsum("wba,wpbc->wpac", before, orientation[rows]),
        body_pose=body_pose[rows],
        joints=jnp.einsum("wba,wpjb->wpja", before, facing[rows]),
        shape=jnp.broadcast_to(shape, (len(rows), 10)),
        leg=jnp.broadcast_to(leg, (len(rows),)),
    )


def in_dtype(model: Arrays, dtype: DTypeLike) -> Arrays:
    """Converts the arrays of a model to another floating-point precision."""
    cast = lambda x: x.astype(dtype) if eqx.is_inexact_array(x) else x
    return jax.tree.map(cast, model)


def check_compatible(model: MotionModel, body: BodyModel, fps: float) -> None:
    """**Raises:** `InputError` if the weights are for another body or frame rate."""
    if model.body != body.kind:
        raise InputError(
            f"the motion model was trained on body {model.body!r}, not {body.kind!r}; "
            "train one with `bodyslam train-motion`."
        )
    if abs(model.fps - fps) > 0.01 * model.fps:
        raise InputError(
            f"the motion model works at {model.fps:g} frames per second, not {fps:g}; "
            "resample the sequence."
        )


def predict(
    model: MotionModel,
    body: BodyModel,
    orientation: Float[Array, "t 3 3"],
    body_pose: Float[Array, "t 23 3"],
    shape: Float[Array, " 10"],
    present: Bool[Array, " t"],
) -> Prediction:
    """Predicts the displacements of one person from postures and shape (section 3.4).

    Args:
        orientation: rotates H into any frame common to the sequence.
        body_pose: θ, rad, at the model's frame rate.
        shape: SMPL β.
        present: frames that are used.

    Neither position, heading nor the direction of gravity is needed. For the default
    network steady yaw is removed from the orientations first, which
    uses orientations up to 1.5 s ahead; the paper's network and users' functions see
    the orientations as they are.

    **Raises:** `InputError` if the weights belong to another body model.
    """
    check_compatible(model, body, model.fps)
    t, past, dtype = len(body_pose), model.past, body_pose.dtype
    if t <= past:
        identity = jnp.broadcast_to(jnp.eye(3, dtype=dtype), (t, 3, 3))
        none = jnp.zeros((t, 3), dtype)
        return Prediction(none, identity, body_pose, none, jnp.zeros(t, bool))
    rate = jnp.zeros(t, dtype)
    if isinstance(model.network, MetricNetwork):
        rate = turning_rate(orientation, present)
        orientation = straightened(orientation, rate)
    window = sequence_windows(body, orientation, body_pose, shape, past)
    guess = in_dtype(model, dtype).network(window)
    factor = guess.cholesky
    covariance = jnp.einsum("wab,wcb->wac", factor, factor)
    rows = np.arange(t - past)[:, None] + np.arange(past + 1)
    valid = present[rows].all(-1)
    turn = rate[past:, None] * jnp.array([0.0, 1.0, 0.0], dtype)
    front = lambda x, fill: jnp.concatenate([fill[:past], x])
    return Prediction(
        translation=front(guess.translation, jnp.zeros((t, 3), dtype)),
        covariance=front(
            covariance, jnp.broadcast_to(jnp.eye(3, dtype=dtype), (t, 3, 3))
        ),
        body_pose=front(guess.body_pose, body_pose),
        rotation=front(so3.compose(turn, guess.rotation), jnp.zeros((t, 3), dtype)),
        valid=jnp.concatenate([jnp.zeros(past, bool), valid]),
    )


def turning_rate(
    orientation: Float[Array, "t 3 3"], present: Bool[Array, " t"]
) -> Float[Array, " t"]:
    """Returns the low-pass filtered yaw about the body's y axis from frame k-1 to k,
    rad, in row k.

    `orientation` rotates H into any fixed frame: the result depends neither on its
    heading nor on its up axis. Frames that are not `present` have no weight.
    """
    step = so3.log(so3.inverse(orientation[:-1]) @ orientation[1:])[:, 1]
    weight = (present[:-1] & present[1:]).astype(step.dtype)
    reach = min(3 * _SIGMA_FRAMES, len(orientation))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / _SIGMA_FRAMES) ** 2)
    kernel = jnp.asarray(kernel, step.dtype)
    smooth = lambda x: jnp.convolve(x, kernel, "full")[reach : reach + len(x)]
    rate = smooth(jnp.where(weight > 0, step, 0)) / jnp.maximum(smooth(weight), 1e-3)
    return jnp.concatenate([jnp.zeros_like(rate[:1]), rate])


def straightened(
    orientation: Float[Array, "t 3 3"], rate: Float[Array, " t"]
) -> Float[Array, "t 3 3"]:
    """Subtracts `rate` from the relative rotations: `C'_k = C'_{k-1} Y(-rate) ΔC_k`."""
    up = jnp.array([0.0, 1.0, 0.0], rate.dtype)
    step = so3.inverse(orientation[:-1]) @ orientation[1:]
    step = so3.exp(-rate[1:, None] * up) @ step
    products = jnp.concatenate([orientation[:1], step])
    frame = jnp.arange(len(products))

    # Each pass doubles the number of factors. `associative_scan` would put every pass
    # into the program, which takes longer to compile than to run.
    def double(level, products):
        back = frame - jnp.left_shift(jnp.ones_like(frame), level.astype(frame.dtype))
        longer = products[jnp.maximum(back, 0)] @ products
        return jnp.where((back >= 0)[:, None, None], longer, products)

    passes = (len(products) - 1).bit_length()
    return jax.lax.fori_loop(0, passes, double, products)


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
