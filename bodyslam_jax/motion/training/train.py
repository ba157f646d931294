"""Trains a motion model: one `lax.scan` per epoch, resumable, deterministic in the
seed.

A checkpoint is written atomically after every epoch and is tied to its training run.

The losses:

- The paper's network is trained with equation 1.
- The loss of the default network is the mean error norm (not squared, as errors have
  heavy tails) of single displacements and of their mean over a segment, with a penalty
  on the slope of predicted over true displacement, as a biased slope biases the scale.
  Losses of posture and covariance are added.
- A user's function (`make_motion_model`) is trained with the negative log-likelihood of
  true displacements.
"""

import dataclasses
import hashlib
import json
import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from bodyslam_jax.body import BodyModel
from bodyslam_jax.config import MotionTraining
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.geometry import so3
from bodyslam_jax.io import atomic
from bodyslam_jax.io.archive import read_npz
from bodyslam_jax.motion.capture.clips import FPS, Clip, Trial, place, resample
from bodyslam_jax.motion.network import (
    MotionNetwork,
    Normalisation,
    apply_layers,
    lower_triangle,
    normalisation,
)
from bodyslam_jax.motion.own_model import FunctionNetwork
from bodyslam_jax.motion.paper_network import PaperNetwork
from bodyslam_jax.motion.position_network import MetricNetwork
from bodyslam_jax.motion.prediction import MotionModel, in_dtype
from bodyslam_jax.motion.training.evaluation import calibrated, named, score, validated
from bodyslam_jax.motion.training.sampling import Batch, Corpus, corpus, draw

logger = logging.getLogger(__name__)
Tree = TypeVar("Tree")
_NORMALISATION_BATCHES = 20
"""Number of batches from which means and standard deviations are computed."""


def optimiser(settings: MotionTraining, steps: int) -> optax.GradientTransformation:
    """Returns AdamW, with entries of the gradient limited to `clip`."""
    rate = settings.learning_rate
    schedule = (
        optax.warmup_cosine_decay_schedule(0.0, rate, min(100, steps // 10 + 1), steps)
        if settings.decay
        else rate
    )
    adam = optax.adamw(schedule, weight_decay=settings.weight_decay)
    limit = optax.identity() if settings.clip is None else optax.clip(settings.clip)
    return optax.chain(limit, adam)


class Progress(eqx.Module):
    """The state of a training run, which checkpoints store."""

    network: MotionNetwork
    average: MotionNetwork
    """Running mean of the weights."""
    best: MotionNetwork
    """The running mean with the best validation score."""
    optimiser: optax.OptState
    history: Float[Array, "e 7"]
    """Per epoch: training loss; validation error ratio, then slope, for `DRIFTS_DEG`;
    NaN without validation."""
    epoch: Float[Array, ""]


def fingerprint(settings: MotionTraining, data: Corpus, body: BodyModel) -> str:
    """Returns a hash of settings, data and body, by which a checkpoint of another run
    is rejected."""
    mark = hashlib.sha256(json.dumps(dataclasses.asdict(settings)).encode())
    mark.update(body.kind.encode())
    for array in (data.poses, data.path, data.start):
        mark.update(np.asarray(array).tobytes())
    return mark.hexdigest()


def save_checkpoint(path: Path, progress: object, mark: str) -> None:
    """Writes the arrays of `progress` and the fingerprint `mark`, atomically."""
    leaves = {
        f"leaf_{i}": np.asarray(x) for i, x in enumerate(jax.tree.leaves(progress))
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    atomic.write_npz(path, {"mark": np.array(mark), **leaves}, compressed=False)


def load_checkpoint(path: Path, like: Tree, mark: str) -> Tree:
    """Reads a checkpoint with the structure of `like`.

    **Raises:** `InputError` if it is damaged or its fingerprint is not `mark`.
    """
    archive = read_npz(path, "a training checkpoint")
    if archive.text("mark") != mark:
        raise InputError(
            f"{path}: checkpoint of other settings or data; remove it to start anew."
        )
    leaves = [archive.raw(f"leaf_{i}") for i in range(len(archive.names) - 1)]
    wanted = [np.shape(leaf) for leaf in jax.tree.leaves(like)]
    if [leaf.shape for leaf in leaves] != wanted:
        raise InputError(f"{path}: its arrays are not those of this training.")
    return jax.tree.unflatten(jax.tree.structure(like), map(jnp.asarray, leaves))


def trainable(network):
    """Returns the mask of trained arrays: all but those of normalisation and
    calibration."""
    frozen = lambda x: isinstance(x, Normalisation)
    mask = jax.tree.map(
        lambda x: jax.tree.map(lambda _: False, x) if frozen(x) else True,
        network,
        is_leaf=frozen,
    )
    if isinstance(network, PaperNetwork):
        return eqx.tree_at(lambda n: n.spread, mask, False)
    if isinstance(network, FunctionNetwork):
        return eqx.tree_at(lambda n: n.spread, mask, False)
    if not isinstance(network, MetricNetwork):
        return mask
    return eqx.tree_at(lambda n: (n.unit, n.gain), mask, (False, False))


def _measure(
    network: PaperNetwork | MetricNetwork, batches: Sequence[Batch]
) -> MotionNetwork:
    """Sets the normalisation of an untrained network from batches of training data."""
    rows = lambda f: np.concatenate(
        [np.asarray(f(b)).reshape(b.weight.size, -1) for b in batches]
    )
    if isinstance(network, PaperNetwork):
        move = rows(lambda b: b.move * b.window.leg[..., None])
        outputs = normalisation(np.concatenate([move, rows(lambda b: b.pose)], -1))
        inputs = normalisation(rows(lambda b: network.features(b.window)))
        return eqx.tree_at(lambda n: (n.inputs, n.outputs), network, (inputs, outputs))
    unit = np.sqrt((rows(lambda b: b.move) ** 2).sum(-1).mean())
    return eqx.tree_at(
        lambda n: (n.inputs, n.posture_inputs, n.posture_outputs, n.unit),
        network,
        (
            normalisation(rows(lambda b: network.features(b.window))),
            normalisation(rows(lambda b: network.posture_features(b.window))),
            normalisation(rows(posture_goal)),
            jnp.asarray(unit, jnp.float32),
        ),
    )


def initial_network(
    key: PRNGKeyArray, settings: MotionTraining
) -> PaperNetwork | MetricNetwork:
    """Returns an untrained network of the kind in `settings`."""
    if settings.network == "paper":
        return PaperNetwork.init(key, settings.past, settings.width[0])
    return MetricNetwork.init(
        key, settings.past, settings.width, settings.members, settings.future
    )


def start(network: MotionNetwork, settings: MotionTraining) -> Progress:
    """Returns the state before the first epoch."""
    moving = eqx.filter(network, trainable(network))
    return Progress(
        network=network,
        average=network,
        best=network,
        optimiser=optimiser(settings, 1000).init(moving),  # steps do not matter here
        history=jnp.full((settings.epochs, 7), jnp.nan, jnp.float32),
        epoch=jnp.zeros((), jnp.float32),
    )


@eqx.filter_jit
def run_epoch(
    progress: Progress,
    data: Corpus,
    body: BodyModel,
    settings: MotionTraining,
    steps: int,
    epochs: int,
) -> Progress:
    """Trains for one epoch: draws a batch and updates, `steps` times in one scan."""
    update = optimiser(settings, steps * epochs)
    mask = trainable(progress.network)
    key = jax.random.fold_in(jax.random.key(settings.seed), 1)
    key = jax.random.fold_in(key, progress.epoch.astype(jnp.int32))
    devices = jax.local_devices()
    count = max(d for d in range(1, len(devices) + 1) if settings.segments % d == 0)
    mesh = jax.sharding.Mesh(np.array(devices[:count]), ("data",))
    split = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("data"))

    def step(carry, number):
        network, average, state = carry
        batch = draw(jax.random.fold_in(key, number), data, body, settings)
        if count > 1:
            batch = jax.lax.with_sharding_constraint(batch, split)
        moving, fixed = eqx.partition(network, mask)
        value, gradient = jax.value_and_grad(
            lambda moving: loss(eqx.combine(moving, fixed), batch, settings)
        )(moving)
        with jax.numpy_dtype_promotion("standard"):  # optax raises floats to integers
            updates, state = update.update(gradient, state, moving)
        network = eqx.combine(optax.apply_updates(moving, updates), fixed)
        done = progress.epoch * steps + number.astype(jnp.float32)
        keep = jnp.minimum(settings.averaging, (1 + done) / (10 + done))
        average = jax.tree.map(lambda a, b: keep * a + (1 - keep) * b, average, network)
        return (network, average, state), value

    carry = (progress.network, progress.average, progress.optimiser)
    carry, values = jax.lax.scan(step, carry, jnp.arange(steps))
    network, average, state = carry
    at = progress.epoch.astype(jnp.int32)
    return dataclasses.replace(
        progress,
        network=network,
        average=average,
        optimiser=state,
        history=progress.history.at[at, 0].set(values.mean()),
        epoch=progress.epoch + 1,
    )


def _validate(
    progress: Progress,
    model: MotionModel,
    body: BodyModel,
    trials: Sequence[Trial],
    settings: MotionTraining,
) -> Progress:
    """Records the validation score of the mean weights; keeps them if it is the
    best."""
    epoch = int(progress.epoch) - 1
    row = validated(model, body, trials)
    judged = lambda row: score(row, settings.drift_deg)
    before = [judged(r) for r in np.asarray(progress.history[:epoch, 1:])]
    better = not any(value <= judged(row) for value in before)  # NaN: not validated
    return dataclasses.replace(
        progress,
        history=progress.history.at[epoch, 1:].set(jnp.asarray(row, jnp.float32)),
        best=progress.average if better else progress.best,
    )


def train(
    clips: Sequence[Clip],
    body: BodyModel,
    settings: MotionTraining = MotionTraining(),
    *,
    validation: Sequence[Clip] = (),
    checkpoint: Path | None = None,
    report: Callable[[int, int, dict[str, float]], None] | None = None,
    about: dict | None = None,
    network: MotionNetwork | None = None,
) -> tuple[MotionModel, Float[np.ndarray, "e 7"]]:
    """Trains a motion model; returns it and the history that `draw_history` draws.

    `validation` clips (of other subjects) choose the epoch whose weights are kept and
    calibrate the covariance; without them the last epoch is kept. `checkpoint` is a
    file that every epoch rewrites, from which the same call resumes after an
    interruption; remove it when the weights are saved. `report(epoch, epochs,
    measures)` is called after each epoch. The same seed gives the same weights on the
    same machine. `network` replaces an untrained one as in `settings`: a custom
    network, or a trained one that is trained further, whose normalisation is kept.

    **Raises:** `InputError` if no clip is long enough, if a checkpoint belongs to
    other settings or data, or if training diverges.
    """
    body = in_dtype(body, jnp.float32)
    data = corpus(clips, settings)
    trials = place(body, resample([c for c in validation if c.phase == 0], FPS))
    steps = -(-data.num_windows // (settings.segments * settings.steps))
    key = jax.random.key(settings.seed)
    if network is None:
        untrained = initial_network(jax.random.fold_in(key, 0), settings)
        keys = jax.random.split(jax.random.fold_in(key, 2), _NORMALISATION_BATCHES)
        network = _measure(untrained, [draw(k, data, body, settings) for k in keys])
    progress = start(network, settings)
    mark = fingerprint(settings, data, body)
    if checkpoint is not None and checkpoint.exists():
        progress = load_checkpoint(checkpoint, progress, mark)
        logger.info("continuing %s at epoch %d", checkpoint, int(progress.epoch))
    model = lambda network: MotionModel(
        network, body.kind, FPS, settings.past, json.dumps(about or {})
    )
    while int(progress.epoch) < settings.epochs:
        epoch = int(progress.epoch)
        progress = run_epoch(progress, data, body, settings, steps, settings.epochs)
        measures = {"loss": float(progress.history[epoch, 0])}
        if not np.isfinite(measures["loss"]):
            raise InputError(
                f"training diverged in epoch {epoch + 1}: loss is not finite."
            )
        last = epoch + 1 == settings.epochs
        if trials and (last or (epoch + 1) % settings.validate_every == 0):
            now = model(progress.average)
            progress = _validate(progress, now, body, trials, settings)
            measures |= named(np.asarray(progress.history[epoch, 1:]))
        elif not trials:
            progress = dataclasses.replace(progress, best=progress.average)
        if checkpoint is not None:
            save_checkpoint(checkpoint, progress, mark)
        if report is not None:
            report(epoch + 1, settings.epochs, measures)
    done = model(progress.best)
    if trials:
        done = calibrated(done, body, trials)
    return done, np.asarray(progress.history)


def loss(
    network: MotionNetwork, batch: Batch, settings: MotionTraining
) -> Float[Array, ""]:
    """Returns the mean loss of a batch; see the module's docstring."""
    if isinstance(network, PaperNetwork):
        return _paper_loss(network, batch)
    if isinstance(network, MetricNetwork):
        return _metric_loss(network, batch, settings)
    return _likelihood(network, batch)


def _likelihood(network: MotionNetwork, batch: Batch) -> Float[Array, ""]:
    """Returns the loss of a custom network: negative log-likelihood of displacements,
    and squared errors (rad²) of postures and of the root's rotation."""
    guess = network(batch.window)
    error = guess.translation - batch.move * batch.window.leg[..., None]
    whitened = jax.scipy.linalg.solve_triangular(
        guess.cholesky, error[..., None], lower=True
    )[..., 0]
    diagonal = jnp.diagonal(guess.cholesky, axis1=-2, axis2=-1)
    each = 0.5 * (whitened**2).sum(-1) + jnp.log(jnp.abs(diagonal)).sum(-1)
    each += ((guess.body_pose - batch.pose[..., 1:, :]) ** 2).mean((-1, -2))
    each += ((guess.rotation - batch.pose[..., 0, :]) ** 2).mean(-1)
    return (each * batch.weight).sum() / batch.weight.sum()


def _paper_loss(network: PaperNetwork, batch: Batch) -> Float[Array, ""]:
    """Returns equation 1, `c_p + λ c_θ` with λ = 1/24, of normalised quantities."""
    out = network.normalised(network.features(batch.window))
    move = batch.move * batch.window.leg[..., None]
    pose = batch.pose.reshape(*move.shape[:-1], 72)
    error = out - network.outputs(jnp.concatenate([move, pose], -1))
    square = (error[..., :3] ** 2).sum(-1) + (error[..., 3:] ** 2).sum(-1) / 24
    return (square * batch.weight).sum() / batch.weight.sum()


def _metric_loss(
    network: MetricNetwork, batch: Batch, settings: MotionTraining
) -> Float[Array, ""]:
    """Returns the loss of the default network; see the module's docstring."""
    weight, window = batch.weight, batch.window
    total = weight.sum()
    moves, spreads = network.moves(window, network.features(window))
    error = (moves - batch.move) / network.unit
    norm = lambda x, soft: jnp.sqrt((x * x).sum(-1) + soft**2)
    single = (norm(error, 0.05) * weight).sum((1, 2)) / total
    # mean error over the segment, turned into one frame
    turned = jnp.einsum("slab,mslb->msla", batch.frame, error) * weight[..., None]
    count = weight.sum(-1)
    mean = turned.sum(2) / jnp.maximum(count, 1.0)[:, None]
    along = (norm(mean, 0.05) * count).sum(1) / total
    # slope of predicted over true displacement, by noise level
    groups = lambda x: (x * weight).reshape(*x.shape[:-2], 4, -1).sum(-1)
    true = groups((batch.move**2).sum(-1))
    slope = groups((moves * batch.move).sum(-1)) / jnp.maximum(true, 1e-6)
    bias = ((slope - 1) ** 2).sum(-1)
    mean_loss = single + settings.segment_weight * along + settings.slope_weight * bias

    whitened = jax.scipy.linalg.solve_triangular(
        lower_triangle(spreads.mean(0)),
        jax.lax.stop_gradient(error.mean(0))[..., None],
        lower=True,
    )[..., 0]
    entries = jnp.clip(spreads.mean(0)[..., :3], -12.0, 6.0)
    likelihood = 0.5 * (jnp.minimum(whitened**2, 50.0)).sum(-1) + entries.sum(-1)

    features = network.posture_features(window)
    out = apply_posture(network, features)
    goal = network.posture_outputs(posture_goal(batch).reshape(*out.shape))
    posture = ((out - goal) ** 2).mean(-1)
    return mean_loss.sum() + ((likelihood + posture) * weight).sum() / total


def apply_posture(
    network: MetricNetwork, features: Float[Array, "*b d"]
) -> Float[Array, "*b 72"]:
    """Returns the predicted change of posture, normalised."""
    return apply_layers(network.posture, network.posture_inputs(features))


def posture_goal(batch: Batch) -> Float[Array, "s l 24 3"]:
    """Returns the rotations from the (noisy) last posture to the true next one, rad."""
    last = batch.window.body_pose[..., -2, :, :]
    turns = so3.between(last, batch.pose[..., 1:, :])
    return jnp.concatenate([batch.pose[..., :1, :], turns], -2)
