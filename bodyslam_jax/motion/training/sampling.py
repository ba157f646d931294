"""Training data on the device, and random batches with simulated estimation errors.

A batch has `s` segments of `n + l` frames: `l` windows, the first with `n` past frames.
Each segment has its own random shape β, speed (stride) and mirroring, and its own
standard deviation of posture errors: a share of segments has no correlated errors, the
others have AR(1) errors. Errors are drawn once per segment, so that its `l` overlapping
windows share them, as in a video.

Estimated postures are true ones with slowly varying errors (`disturb`, `drift`).
Regressors err by 10 to 20 degrees. Almost all of the error varies slowly (AR(1), rho
0.9 to 0.97 at 30 fps); white noise adds a few tenths of a degree.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, PRNGKeyArray

from bodyslam_jax.body import BodyModel, local_joints, rest_joints
from bodyslam_jax.body.skeleton import ANKLES, FEET, HANDS, WRISTS
from bodyslam_jax.config import MotionTraining
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.geometry import so3
from bodyslam_jax.motion.capture.clips import (
    FPS,
    LEFT_RIGHT,
    Clip,
    hip_centre,
    interleave,
    resample,
)
from bodyslam_jax.motion.network import Window
from bodyslam_jax.motion.prediction import leg_length

RATE_FACTOR = 4
"""Ratio between the frame rates of stored training data and of the model, so that
segments can start at any phase and have different speeds."""
_ROOT_ERROR_PROBABILITY = 0.3
"""Probability that a segment also has errors of the root's orientation."""
CORRELATION = 0.96
"""Correlation of the slow error between successive frames at 30 fps."""
_EXTREMITIES = (*ANKLES, *FEET, *WRISTS, *HANDS)
JOINT_FACTOR = np.where(np.isin(np.arange(24), _EXTREMITIES), 1.5, 1.0)
"""Factor on the error of each joint: 1.5 at hands and feet, else 1."""


class Corpus(eqx.Module):
    """All training frames, concatenated, and the frames where a segment may begin."""

    poses: Float[Array, "n 24 3"]
    """Axis-angle, rad."""
    path: Float[Array, "n 3"]
    """Midpoint of the hips in the capture's world, in leg lengths of the subject."""
    start: Int[Array, " c"]
    """Candidates for a segment's first frame."""
    last: Int[Array, " c"]
    """Last frame of the clip that a candidate belongs to."""
    cumulative: Float[Array, " c"]
    """Cumulative distribution over the candidates."""

    @property
    def num_windows(self) -> int:
        """Number of frames where a segment may begin."""
        return len(self.start)


class Batch(eqx.Module):
    """`s` segments of `l` windows each."""

    window: Window
    move: Float[Array, "s l 3"]
    """True displacement in H_{k-1}, leg lengths per step."""
    frame: Float[Array, "s l 3 3"]
    """True C_{H_0}^T C_{H_{k-1}}, which rotates displacements from H_{k-1} into H_0,
    the root frame before the segment's first step."""
    pose: Float[Array, "s l 24 3"]
    """True posture of frame k, rad; row 0 is the root's rotation vector from k-1 to
    k."""
    weight: Float[Array, "s l"]
    """Weight of each window: 1, or 0 beyond the end of the clip."""


def corpus(clips: Sequence[Clip], settings: MotionTraining) -> Corpus:
    """Collects clips at `RATE_FACTOR` times the model's rate.

    **Raises:** `InputError` if no clip of a trained class is as long as one window.
    """
    share = {"walk": 1.0, "run": settings.run_weight}
    share_of = lambda clip: share.get(clip.motion, settings.other_weight)
    wanted = [clip for clip in clips if share_of(clip) > 0]
    if not wanted:
        raise InputError(
            f"no usable sequence among {len(clips)}: none is named walk, run or jog; "
            "train on all motion with a positive `other_weight`."
        )
    dense = resample(interleave(wanted), FPS * RATE_FACTOR)
    span = settings.past * max(settings.strides)
    # A window includes its first and its last frame; the next begins a step later.
    spacing = 1 if settings.sliding else span + RATE_FACTOR
    starts, lasts, weights, offset = [], [], [], 0
    for clip in dense:
        t = len(clip.poses)
        first = np.arange(0, t - span, spacing) + offset
        starts.append(first)
        lasts.append(np.full(len(first), offset + t - 1))
        weights.append(np.full(len(first), share_of(clip)))
        offset += t
    weight = np.concatenate(weights)
    if len(weight) == 0:
        longest = max(len(clip.poses) / clip.fps for clip in dense)
        raise InputError(
            f"no usable sequence among {len(clips)}: the longest lasts "
            f"{longest:.2f} s; a window needs {span / RATE_FACTOR / FPS:.2f} s."
        )
    path = [hip_centre(clip) / clip.leg_length for clip in dense]
    return Corpus(
        poses=jnp.asarray(np.concatenate([clip.poses for clip in dense]), jnp.float32),
        path=jnp.asarray(np.concatenate(path), jnp.float32),
        start=jnp.asarray(np.concatenate(starts), jnp.int32),
        last=jnp.asarray(np.concatenate(lasts), jnp.int32),
        cumulative=jnp.asarray(np.cumsum(weight) / weight.sum(), jnp.float32),
    )


@eqx.filter_jit
def draw(
    key: PRNGKeyArray, data: Corpus, body: BodyModel, settings: MotionTraining
) -> Batch:
    """Draws a random batch."""
    s, l, past = settings.segments, settings.steps, settings.past
    keys = jax.random.split(key, 8)
    row = jnp.searchsorted(
        data.cumulative, jax.random.uniform(keys[0], (s,), jnp.float32)
    )
    row = jnp.minimum(row, len(data.start) - 1)
    strides = jnp.asarray(settings.strides, jnp.int32)
    stride = strides[jax.random.randint(keys[1], (s,), 0, len(strides))]
    count = jnp.arange(past + l, dtype=jnp.int32)
    frames = data.start[row, None] + stride[:, None] * count
    inside = frames <= data.last[row, None]
    frames = jnp.minimum(frames, data.last[row, None])
    poses, path = data.poses[frames], data.path[frames]
    if settings.mirror:
        poses, path = mirrored(jax.random.bernoulli(keys[2], 0.5, (s,)), poses, path)
    shape = settings.shape_sigma * jax.random.normal(keys[3], (s, 10), jnp.float32)
    noise = posture_errors(keys[4:8], s, past + l, settings)
    estimated = disturb(poses, noise)

    true = so3.exp(poses[:, :, 0])
    before, after = true[:, past - 1 : -1], true[:, past:]
    leg = leg_length(body, shape)
    rest = rest_joints(body, shape)
    below = ((rest[:, 1] + rest[:, 2]) / 2 - rest[:, 0]) / leg[:, None]
    path = path - jnp.einsum("sfab,sb->sfa", true, below)
    step = path[:, past:] - path[:, past - 1 : -1]
    turn = so3.log(so3.inverse(before) @ after)
    joints = local_joints(body, estimated[:, :, 1:], shape[:, None])
    window = jax.vmap(_windows, (0, 0, 0, None))(
        so3.exp(estimated[:, :, 0]),
        joints / leg[:, None, None, None],
        estimated[:, :, 1:],
        past,
    )
    wide = lambda x: jnp.broadcast_to(x[:, None], (s, l, *x.shape[1:]))
    return Batch(
        window=Window(*window, shape=wide(shape), leg=wide(leg)),
        move=jnp.einsum("slba,slb->sla", before, step),
        frame=jnp.einsum("sba,slbc->slac", before[:, 0], before),
        pose=jnp.concatenate([turn[:, :, None], poses[:, past:, 1:]], 2),
        weight=inside[:, past:].astype(jnp.float32),
    )


def _windows(rotation, joints, body_pose, past):
    """Returns rotations, postures and joints of all windows of one segment."""
    turned = jnp.einsum("tab,tjb->tja", rotation, joints)
    rows = np.arange(len(rotation) - past)[:, None] + np.arange(past + 1)
    before = rotation[rows[:, -2]]
    return (
        jnp.einsum("wba,wpbc->wpac", before, rotation[rows]),
        body_pose[rows],
        jnp.einsum("wba,wpjb->wpja", before, turned[rows]),
    )


def mirrored(
    which: Bool[Array, " s"],
    poses: Float[Array, "s f 24 3"],
    path: Float[Array, "s f 3"],
) -> tuple[Float[Array, "s f 24 3"], Float[Array, "s f 3"]]:
    """Exchanges left and right in the segments of `which`, in poses and path."""
    order = np.arange(24)
    for left, right in LEFT_RIGHT:
        order[[left, right]] = right, left
    flip = np.array([1, -1, -1], np.float32)
    other = poses[:, :, order] * flip
    return (
        jnp.where(which[:, None, None, None], other, poses),
        jnp.where(which[:, None, None], path * -flip, path),
    )


def posture_errors(
    keys: Key[Array, " 4"], s: int, frames: int, settings: MotionTraining
) -> Float[Array, "s f 24 3"]:
    """Draws errors of joint angles for `s` segments, rad.

    The first `clean_share` of the segments has no AR(1) error; in the others its
    standard deviation rises linearly with the segment's index, from 0 to nearly
    `drift_deg`. White noise is added to all but the first 70 % of the segments without
    AR(1) error. As the root's error in a video differs from that of the joints, it is a
    random share of this error in some segments, and zero in the others.
    """
    clean = settings.clean_share
    place = np.arange(s) / s
    level = np.clip((place - clean) / max(1 - clean, 1e-6), 0, None)
    sigma = jnp.asarray(np.deg2rad(settings.drift_deg) * level, jnp.float32)
    most = jnp.asarray(
        np.where(place < 0.7 * clean, 0.0, np.deg2rad(settings.white_deg)), jnp.float32
    )
    white = most * jax.random.uniform(keys[0], (s,), jnp.float32)
    noise = jax.vmap(drift, (0, None, 0, 0))(
        jax.random.split(keys[1], s), frames, sigma, white
    )
    share = settings.root_drift * jax.random.uniform(keys[2], (s,), jnp.float32)
    share = jnp.where(
        jax.random.bernoulli(keys[3], _ROOT_ERROR_PROBABILITY, (s,)), share, 0.0
    )
    return noise.at[:, :, 0].multiply(share[:, None, None])


def drift(
    key: PRNGKeyArray, frames: int, sigma: Float[Array, ""], white: Float[Array, ""]
) -> Float[Array, "{frames} 24 3"]:
    """Draws a stationary AR(1) error of every joint angle plus white noise.

    `sigma` and `white` are standard deviations per axis, in the unit of the result.
    """
    slow, fast = jax.random.split(key)
    dtype = sigma.dtype
    innovation = jax.random.normal(slow, (frames, 24, 3), dtype)
    rest = jnp.asarray(np.sqrt(1 - CORRELATION**2), dtype)
    innovation = innovation.at[1:].multiply(rest)
    # x_k = sum_i rho^(k-i) e_i as one product: cheaper than a scan, and exact
    lag = np.arange(frames)[:, None] - np.arange(frames)
    decay = np.where(lag >= 0, CORRELATION ** np.maximum(lag, 0), 0.0)
    walk = jnp.tensordot(jnp.asarray(decay, dtype), innovation, 1)
    noise = sigma * walk + white * jax.random.normal(fast, (frames, 24, 3), dtype)
    return noise * jnp.asarray(JOINT_FACTOR, dtype)[:, None]


def disturb(
    poses: Float[Array, "*b 24 3"], noise: Float[Array, "*b 24 3"]
) -> Float[Array, "*b 24 3"]:
    """Rotates each joint by a further small rotation in its own frame (rad)."""
    return so3.compose(poses, noise)
