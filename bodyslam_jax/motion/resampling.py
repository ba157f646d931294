"""Predictions at any frame rate from a model that works at 30 frames per second.

Postures are interpolated (slerp) at the model's ticks, the times of its frames.
Predicted displacements are summed to a path, which is interpolated at the times of the
video's frames.
"""

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from bodyslam_jax.body import BodyModel
from bodyslam_jax.geometry import so3
from bodyslam_jax.geometry.lengths import lengthened
from bodyslam_jax.motion.capture.clips import FPS
from bodyslam_jax.motion.contact_network import ContactModel, predict_contact
from bodyslam_jax.motion.prediction import MotionModel, Prediction, predict


class Clock(eqx.Module):
    """Relative positions in time of `t` video frames and the `g` ticks of a model."""

    frame: Int[Array, " g"]
    """The frame at or before each tick."""
    between: Float[Array, " g"]
    """Position of the tick between that frame and the next, 0 to 1."""
    tick: Int[Array, " t"]
    """The tick at or before each frame."""
    beyond: Float[Array, " t"]
    """Position of the frame between that tick and the next, 0 to 1."""
    steps: Float[Array, " t"]
    """Ticks since the previous frame."""
    same: bool = eqx.field(static=True)
    """True if frames coincide with ticks, so that nothing is interpolated."""

    def lengthened(self, frames: int) -> "Clock":
        """Returns the clock of a padded sequence, whose added frames lie at the last
        tick.

        The number of ticks is rounded up, to half a tick for each frame, so that it
        depends on the frame rate but hardly on the number of frames.
        """
        if frames == len(self.tick):
            return self
        if self.same:
            ticks = frames
        else:
            ticks = -(-2 * len(self.frame) // len(self.tick)) * frames // 2
        # Added ticks lie at the last of these frames, where nobody is present.
        more = ticks - len(self.frame)
        last = np.full(more, frames - 1, self.frame.dtype)
        none = np.zeros(more, self.between.dtype)
        joined = np.concatenate
        if isinstance(self.frame, jax.core.Tracer):
            joined = jnp.concatenate
        of_frames = lengthened((self.tick, self.beyond, self.steps), frames)
        return Clock(
            frame=jnp.asarray(joined([self.frame, last])),
            between=jnp.asarray(joined([self.between, none])),
            tick=of_frames[0],
            beyond=of_frames[1],
            steps=of_frames[2],
            same=self.same,
        )

    def from_frame(self, start: int) -> "Clock":
        """Returns the clock of the sequence that begins at frame `start`, with the
        ticks from there on; frames before the first tick lie at it."""
        tick, beyond = np.asarray(self.tick)[start:], np.asarray(self.beyond)[start:]
        first = int(tick[0] + (beyond[0] > 1e-9))
        before = tick < first
        return Clock(
            frame=jnp.asarray(np.asarray(self.frame)[first:] - start),
            between=jnp.asarray(np.asarray(self.between)[first:]),
            tick=jnp.asarray(np.where(before, 0, tick - first)),
            beyond=jnp.asarray(np.where(before, 0.0, beyond)),
            steps=jnp.asarray(np.asarray(self.steps)[start:]),
            same=self.same,
        )


def make_clock(
    timestamps: Float[np.ndarray, " t"], fps: float = FPS, num_ticks: int | None = None
) -> Clock:
    """Aligns the ticks of a model, `fps` per second, with the timestamps (s) of a
    video.

    Args:
        num_ticks: number of ticks, so that programs do not depend on the timestamps;
            without it, as many as there are until the last one. Frames after the last
            tick lie at it.
    """
    position = (timestamps - timestamps[0]) * fps
    t = len(position)
    same = bool(np.abs(np.diff(position) - 1).max(initial=0) < 0.02)
    if same:
        position = np.arange(t, dtype=float)
    if num_ticks is None:
        num_ticks = int(np.ceil(position[-1] - 1e-6)) + 1
    ticks = np.arange(num_ticks)
    position = np.minimum(position, num_ticks - 1)
    frame = np.clip(
        np.searchsorted(position, ticks, side="right") - 1, 0, max(t - 2, 0)
    )
    following = np.minimum(frame + 1, t - 1)
    gap = np.maximum(position[following] - position[frame], 1e-9)
    between = np.clip((ticks - position[frame]) / gap, 0, 1)
    tick = np.clip(np.floor(position + 1e-9).astype(int), 0, max(len(ticks) - 2, 0))
    return Clock(
        jnp.asarray(frame),
        jnp.asarray(between),
        jnp.asarray(tick),
        jnp.asarray(position - tick),
        jnp.asarray(np.diff(position, prepend=position[0])),
        same,
    )


def predict_between(
    model: tuple[MotionModel, Clock],
    body: BodyModel,
    orientation: Float[Array, "t 3 3"],
    body_pose: Float[Array, "t 23 3"],
    shape: Float[Array, " 10"],
    present: Bool[Array, " t"],
) -> Prediction:
    """Predicts steps between the frames of a `Clock`: row k is that from frame k-1 to
    k.

    Errors of successive ticks are assumed fully correlated within one frame's step. See
    `predict` for the arguments.
    """
    network, clock = model
    if clock.same:
        return predict(network, body, orientation, body_pose, shape, present)
    clock = clock.lengthened(len(body_pose))
    dtype = body_pose.dtype
    beyond, steps = clock.beyond.astype(dtype), clock.steps.astype(dtype)
    C, pose, at_tick = _at_ticks(clock, orientation, body_pose, present)
    ticks = predict(network, body, C, pose, shape, at_tick)

    before = jnp.concatenate([C[:1], C[:-1]])
    step = jnp.einsum("gij,gj->gi", before, ticks.translation)
    step = jnp.where(ticks.valid[:, None], step, 0)
    missing = jnp.cumsum(~ticks.valid)
    path = jnp.cumsum(step, axis=0) - step[:1]
    last = jnp.minimum(clock.tick + 1, len(path) - 1)
    position = path[clock.tick] + beyond[:, None] * (path[last] - path[clock.tick])
    moved = position - jnp.concatenate([position[:1], position[:-1]])
    started = jnp.concatenate([orientation[:1], orientation[:-1]])
    end = jnp.where(beyond > 0, last, clock.tick)
    start = jnp.concatenate([clock.tick[:1], clock.tick[:-1]])
    valid = (missing[end] == missing[start]) & (jnp.arange(len(steps)) > 0) & present
    step = so3.between(pose[end - 1], ticks.body_pose[end])
    previous = jnp.concatenate([body_pose[:1], body_pose[:-1]])
    return Prediction(
        translation=jnp.einsum("tji,tj->ti", started, moved),
        covariance=ticks.covariance[end] * (steps**2)[:, None, None]
        + jnp.where(valid, 0, 1)[:, None, None].astype(dtype) * jnp.eye(3, dtype=dtype),
        body_pose=so3.compose(previous, steps[:, None, None] * step),
        rotation=ticks.rotation[end] * steps[:, None],
        valid=valid,
    )


def contact_between(
    model: tuple[ContactModel, Clock],
    body: BodyModel,
    orientation: Float[Array, "t 3 3"],
    body_pose: Float[Array, "t 23 3"],
    shape: Float[Array, " 10"],
    present: Bool[Array, " t"],
) -> Float[Array, "t 4"]:
    """Predicts contact at the frames of a `Clock`, interpolated between ticks; see
    `predict_contact` for the arguments."""
    network, clock = model
    if clock.same:
        return predict_contact(network, body, orientation, body_pose, shape, present)
    clock = clock.lengthened(len(body_pose))
    C, pose, at_tick = _at_ticks(clock, orientation, body_pose, present)
    ticks = predict_contact(network, body, C, pose, shape, at_tick)
    last = jnp.minimum(clock.tick + 1, len(ticks) - 1)
    beyond = clock.beyond.astype(ticks.dtype)[:, None]
    found = ticks[clock.tick] + beyond * (ticks[last] - ticks[clock.tick])
    return jnp.where(present[:, None], found, 0.0)


def _at_ticks(
    clock: Clock,
    orientation: Float[Array, "t 3 3"],
    body_pose: Float[Array, "t 23 3"],
    present: Bool[Array, " t"],
) -> tuple[Float[Array, "g 3 3"], Float[Array, "g 23 3"], Bool[Array, " g"]]:
    """Returns orientations, postures and presence at the ticks of a clock."""
    between = clock.between.astype(body_pose.dtype)
    following = jnp.minimum(clock.frame + 1, len(body_pose) - 1)

    def interpolated(angles: Array) -> Array:
        share = between.reshape(-1, *(1,) * (angles.ndim - 1))
        step = so3.between(angles[clock.frame], angles[following])
        return so3.compose(angles[clock.frame], share * step)

    C = so3.exp(interpolated(so3.log(orientation)))
    at_tick = present[clock.frame] & (present[following] | (between == 0))
    return C, interpolated(body_pose), at_tick
