"""Trains the contact network on motion capture.

Postures have the same simulated errors as for the motion model (`sampling.py`), and
bodies have random shapes. Labels are those of the exact motion on the subject's own
shape.

Contacts of heels and toes in motion capture are labelled by their height and speed. In
captured motion the ground is known to a centimetre and speeds to a few centimetres
a second, so that a simple rule is accurate. In a video neither is known. The contact
network learns to predict these labels from postures.

`judge_contact` has the precision and recall of the network, and of a rule by height and
speed on the same postures.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from bodyslam_jax.body import BodyModel, keypoints, local_joints, rest_joints
from bodyslam_jax.body.skeleton import BODY25_TOES_AND_HEELS
from bodyslam_jax.config import ContactTraining, MotionTraining
from bodyslam_jax.geometry import so3
from bodyslam_jax.motion.capture.clips import (
    FPS,
    Clip,
    Trial,
    interleave,
    padded,
    place,
    resample,
)
from bodyslam_jax.motion.contact_network import (
    ContactModel,
    contact_features,
    predict_contact,
)
from bodyslam_jax.motion.network import normalisation
from bodyslam_jax.motion.prediction import in_dtype, leg_length
from bodyslam_jax.motion.training.evaluation import disturbed
from bodyslam_jax.motion.training.sampling import (
    RATE_FACTOR,
    disturb,
    mirrored,
    posture_errors,
)

_FOOT_POINTS = np.array(BODY25_TOES_AND_HEELS)
_NORMALISATION_BATCHES = 16
"""Number of batches from which means and standard deviations are computed."""
MAX_CONTACT_SPEED = 0.35
"""Speed below which a point is in contact, leg lengths per second (0.3 m/s)."""
MAX_CONTACT_HEIGHT = 0.06
"""Distance from the floor below which a point is in contact, leg lengths (5 cm)."""
_FLOOR_WINDOW_S = 1.0
"""Interval before and after a frame over which the floor is the median height of the
lowest slow point, s: stairs and stools have their own height."""
_SPEED_WINDOW_S = 1 / 15
"""Interval over which speed is measured, s."""


class ContactCorpus(eqx.Module):
    """All training frames, and the frames where a segment may begin."""

    poses: Float[Array, "n 24 3"]
    """Axis-angle, rad."""
    stands: Float[Array, "n 4"]
    """1 for a point in contact, else 0."""
    start: Int[Array, " c"]
    """Candidates for a segment's first frame."""
    last: Int[Array, " c"]
    """Last frame of the clip that a candidate belongs to."""
    cumulative: Float[Array, " c"]
    """Cumulative distribution over the candidates."""


def foot_points(body: BodyModel, trial: Trial) -> Float[np.ndarray, "t 4 3"]:
    """Returns toes and heels of a captured motion on the body model, leg lengths."""
    shape = np.asarray(trial.shape)
    origin = np.asarray(rest_joints(body, jnp.asarray(shape)))[0]
    wide = lambda poses, trans: keypoints(
        body,
        poses.reshape(-1, 72),
        jnp.broadcast_to(jnp.asarray(shape, poses.dtype), (len(poses), 10)),
        trans - jnp.asarray(origin, trans.dtype),
    )
    dtype = body.template.dtype
    points = padded(
        wide, trial.clip.poses.astype(dtype), np.asarray(trial.trans).astype(dtype)
    )
    return points[:, _FOOT_POINTS] / float(leg_length(body, jnp.asarray(shape, dtype)))


def contact_corpus(
    clips: Sequence[Clip], body: BodyModel, settings: ContactTraining
) -> ContactCorpus:
    """Collects clips, at `RATE_FACTOR` times the model's rate, with their labels."""
    share = {"walk": 1.0, "run": settings.run_weight}
    dense = resample(interleave(list(clips)), FPS * RATE_FACTOR)
    span = RATE_FACTOR * (2 * settings.half + settings.steps)
    poses, stands, starts, lasts, weights, offset = [], [], [], [], [], 0
    for trial in place(body, dense):
        t = len(trial.trans)
        points = foot_points(body, trial)
        poses.append(trial.clip.poses)
        stands.append(standing_points(points, trial.clip.fps))
        first = np.arange(0, max(t - span, 1)) + offset
        starts.append(first)
        lasts.append(np.full(len(first), offset + t - 1))
        weight = share.get(trial.clip.motion, settings.other_weight)
        weights.append(np.full(len(first), weight))
        offset += t
    weight = np.concatenate(weights)
    return ContactCorpus(
        poses=jnp.asarray(np.concatenate(poses), jnp.float32),
        stands=jnp.asarray(np.concatenate(stands), jnp.float32),
        start=jnp.asarray(np.concatenate(starts), jnp.int32),
        last=jnp.asarray(np.concatenate(lasts), jnp.int32),
        cumulative=jnp.asarray(np.cumsum(weight) / weight.sum(), jnp.float32),
    )


def draw_contacts(
    key: PRNGKeyArray, data: ContactCorpus, body: BodyModel, settings: ContactTraining
) -> tuple[Float[Array, "s l d"], Float[Array, "s l 4"], Float[Array, "s l"]]:
    """Draws features, labels and weights of `s` segments of `l` windows."""
    s, l, half = settings.segments, settings.steps, settings.half
    noise = MotionTraining(
        drift_deg=settings.drift_deg, clean_share=settings.clean_share
    )
    keys = jax.random.split(key, 10)
    at = jax.random.uniform(keys[0], (s,), jnp.float32)
    row = jnp.minimum(jnp.searchsorted(data.cumulative, at), len(data.start) - 1)
    strides = jnp.asarray(noise.strides, jnp.int32)
    stride = strides[jax.random.randint(keys[1], (s,), 0, len(strides))]
    count = jnp.arange(2 * half + l, dtype=jnp.int32)
    frames = data.start[row, None] + stride[:, None] * count
    inside = frames <= data.last[row, None]
    frames = jnp.minimum(frames, data.last[row, None])
    poses, stands = data.poses[frames], data.stands[frames]
    flip = jax.random.bernoulli(keys[2], 0.5, (s,))
    poses, _ = mirrored(flip, poses, jnp.zeros((*poses.shape[:2], 3), poses.dtype))
    swapped = stands[..., np.array([2, 3, 0, 1])]
    stands = jnp.where(flip[:, None, None], swapped, stands)
    shape = noise.shape_sigma * jax.random.normal(keys[3], (s, 10), jnp.float32)
    errors = posture_errors(keys[4:8], s, len(count), noise)
    seen = disturb(poses, errors)
    joints = local_joints(body, seen[:, :, 1:], shape[:, None])
    joints = joints / leg_length(body, shape)[:, None, None, None]
    rows = np.arange(l)[:, None] + np.arange(2 * half + 1)
    rows = jnp.broadcast_to(jnp.asarray(rows, jnp.int32), (s, l, 2 * half + 1))
    # Some windows are truncated, as at the first and last frames of a person.
    cut = jax.random.randint(keys[8], (s, l, 2), 0, 4 * half, jnp.int32)
    cut = jnp.minimum(cut, half)
    middle = rows[..., half]
    low, high = middle - cut[..., 0], middle + cut[..., 1]
    rows = jnp.clip(rows, low[..., None], high[..., None])
    features = jax.vmap(contact_features)(so3.exp(seen[:, :, 0]), joints, rows)
    return (
        features,
        stands[:, half : half + l],
        inside[:, 2 * half :].astype(seen.dtype),
    )


def _loss(model: ContactModel, batch) -> Float[Array, ""]:
    """Returns the weighted mean cross-entropy of a batch."""
    features, stands, weight = batch
    logits = model.logits(features)
    entropy = optax.sigmoid_binary_cross_entropy(logits, stands).mean(-1)
    return jnp.sum(weight * entropy) / jnp.sum(weight)


def train_contact(
    clips: Sequence[Clip],
    body: BodyModel,
    settings: ContactTraining = ContactTraining(),
    report=None,
) -> ContactModel:
    """Trains a contact network for this body on captured motion.

    Training takes some minutes on one processor; `report(step, loss)` is called every
    100 updates. All given clips are used: hold subjects out with `split`.
    """
    body32 = in_dtype(body, jnp.float32)
    data = contact_corpus(clips, body, settings)
    key = jax.random.key(settings.seed)
    model = ContactModel.init(key, body.kind, FPS, settings.half, settings.width)
    sample = eqx.filter_jit(draw_contacts)
    samples = [
        np.asarray(sample(jax.random.fold_in(key, i), data, body32, settings)[0])
        for i in range(_NORMALISATION_BATCHES)
    ]
    flat = np.concatenate(samples).reshape(-1, samples[0].shape[-1])
    model = eqx.tree_at(lambda m: m.inputs, model, normalisation(flat))
    rate = optax.warmup_cosine_decay_schedule(
        0.0, settings.learning_rate, 100, settings.updates
    )
    update = optax.adamw(rate, weight_decay=1e-3)
    state = update.init(model.layers)

    @eqx.filter_jit
    def run(layers, state, average, first, data, body32, inputs):
        def step(carry, number):
            layers, state, average = carry
            one = jax.random.fold_in(jax.random.fold_in(key, 7), number)
            batch = draw_contacts(one, data, body32, settings)
            given = eqx.tree_at(lambda m: m.inputs, model, inputs)
            of = lambda x: _loss(eqx.tree_at(lambda m: m.layers, given, x), batch)
            value, gradient = jax.value_and_grad(of)(layers)
            with jax.numpy_dtype_promotion("standard"):
                change, state = update.update(gradient, state, layers)
            layers = optax.apply_updates(layers, change)
            mix = lambda a, b: 0.998 * a + 0.002 * b
            return (layers, state, jax.tree.map(mix, average, layers)), value

        return jax.lax.scan(
            step,
            (layers, state, average),
            first + jnp.arange(_REPORT_UPDATES, dtype=jnp.int32),
        )

    layers, average = model.layers, model.layers
    for first in range(0, settings.updates, _REPORT_UPDATES):
        (layers, state, average), values = run(
            layers, state, average, jnp.int32(first), data, body32, model.inputs
        )
        if report is not None:
            report(first + _REPORT_UPDATES, float(values.mean()))
    return eqx.tree_at(lambda m: m.layers, model, average)


_REPORT_UPDATES = 100
"""Number of updates between two reports."""


def standing_points(
    points: Float[np.ndarray, "t p 3"], fps: float
) -> Bool[np.ndarray, "t p"]:
    """Returns which points of both feet are in contact, in a world whose y axis is up.

    `points` are heels and toes in leg lengths. Speed counts in all directions.
    """
    frame = np.arange(len(points))
    half = max(1, round(_SPEED_WINDOW_S * fps / 2))
    before = np.maximum(frame - half, 0)
    after = np.minimum(frame + half, len(points) - 1)
    moved = np.linalg.norm(points[after] - points[before], axis=-1)
    slow = moved * fps / np.maximum(after - before, 1)[:, None] < MAX_CONTACT_SPEED
    lowest = np.where(slow, points[..., 1], np.inf).min(axis=1)
    floor = _running_median(lowest, round(_FLOOR_WINDOW_S * fps))
    return slow & (np.abs(points[..., 1] - floor[:, None]) < MAX_CONTACT_HEIGHT)


def _running_median(x: Float[np.ndarray, " t"], half: int) -> Float[np.ndarray, " t"]:
    """Returns the median of the finite values within `half` rows; infinite without
    any."""
    padded = np.pad(x, half, constant_values=np.inf)
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1)
    ordered = np.sort(windows, axis=1)
    count = np.isfinite(ordered).sum(axis=1)
    middle = np.maximum(count - 1, 0) // 2
    return np.where(count > 0, ordered[np.arange(len(x)), middle], np.inf)


def judge_contact(
    model: ContactModel,
    body: BodyModel,
    dataset: Sequence[Clip],
    drift_deg: float = 0.0,
) -> dict[str, float]:
    """Evaluates a contact network on clips whose postures have errors as in training.

    The standard deviation of slow errors is `drift_deg` per joint axis (1.5 times that
    at hands and feet), and white noise is added; errors of the root's
    orientation are half as large.

    Returns `precision` and `recall` of points with a probability above one half,
    `share` (of points in contact), `probability` (mean) and `slip`: root mean square
    speed, in the exact motion, of the points classified as in contact, leg lengths per
    second. `rule_precision`, `rule_recall` and `rule_slip` are those of the rule of
    `contact_labels`, applied to the same postures and the exact path of the pelvis.
    """
    clips = resample([clip for clip in dataset if clip.phase == 0], FPS)
    trials = place(body, clips)
    counts = [len(trial.trans) for trial in trials]
    length = -(-max(counts) // 64) * 64
    pad = lambda x: np.concatenate([x, np.repeat(x[-1:], length - len(x), axis=0)])
    stack = lambda arrays: jnp.asarray(np.stack(arrays), jnp.float32)
    poses = stack([pad(trial.clip.poses) for trial in trials])
    trans = stack([pad(trial.trans) for trial in trials])
    shape = stack([trial.shape for trial in trials])
    present = np.arange(length) < np.array(counts)[:, None]
    body, model = in_dtype(body, jnp.float32), in_dtype(model, jnp.float32)
    seen = poses
    if drift_deg > 0:
        sigma = jnp.float32(np.deg2rad(drift_deg))
        keys = jax.random.split(jax.random.key(0), len(trials))
        seen = disturbed(poses, keys, sigma, jnp.float32(0.5))
    exact = np.asarray(_points(body, poses, trans, shape))
    noisy = np.asarray(_points(body, seen, trans, shape))
    guess = np.asarray(_contacts(model, body, seen, shape, jnp.asarray(present)))
    rows = lambda x: np.concatenate([a[:n] for a, n in zip(x, counts, strict=True)])
    label = lambda points: np.concatenate(
        [standing_points(p[:n], FPS) for p, n in zip(points, counts, strict=True)]
    )
    true, rule, guess = label(exact), label(noisy), rows(guess)
    speed = rows(np.linalg.norm(np.gradient(exact, axis=1), axis=-1) * FPS)
    found = {"share": float(true.mean()), "probability": float(guess.mean())}
    for name, stands in (("", guess > 0.5), ("rule_", rule)):
        hits = np.count_nonzero(stands & true)
        found[f"{name}precision"] = hits / max(np.count_nonzero(stands), 1)
        found[f"{name}recall"] = hits / max(np.count_nonzero(true), 1)
        slip = speed[stands]
        found[f"{name}slip"] = float(np.sqrt((slip**2).mean())) if slip.size else np.nan
    return found


@eqx.filter_jit
def _points(
    body: BodyModel,
    poses: Float[Array, "c t 24 3"],
    trans: Float[Array, "c t 3"],
    shape: Float[Array, "c 10"],
) -> Float[Array, "c t 4 3"]:
    """Returns positions of toes and heels, leg lengths."""
    shift = trans - rest_joints(body, shape)[:, None, 0]
    flat = poses.reshape(*poses.shape[:2], 72)
    points = keypoints(body, flat, shape[:, None], shift)[..., _FOOT_POINTS, :]
    return points / leg_length(body, shape)[:, None, None, None]


@eqx.filter_jit
def _contacts(
    model: ContactModel,
    body: BodyModel,
    poses: Float[Array, "c t 24 3"],
    shape: Float[Array, "c 10"],
    present: Bool[Array, "c t"],
) -> Float[Array, "c t 4"]:
    """Returns the predicted contact probabilities of all clips."""
    one = lambda p, s, there: predict_contact(
        model, body, so3.exp(p[:, 0]), p[:, 1:], s, there
    )
    return jax.vmap(one)(poses, shape, present)
