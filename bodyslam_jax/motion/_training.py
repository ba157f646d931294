"""Training: one `lax.scan` per epoch, resumed after a kill, the same for one seed.

The loss of the paper's preset is its equation 1. The default's is a mean error norm
(not its square: errors have heavy tails) of single steps and of their mean over a
segment, with a penalty on the slope of predicted over true displacement, which a
graph would read as scale; posture and covariance are learnt beside it.
"""

import dataclasses
import hashlib
import json
import logging
import os
from collections.abc import Callable, Sequence
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from bodyslam_jax.body import BodyModel
from bodyslam_jax.config import MotionTraining
from bodyslam_jax.motion._clips import FPS, Clip, resample
from bodyslam_jax.motion._evaluation import run_trials, summary
from bodyslam_jax.motion._network import (
    MetricNetwork,
    Normalisation,
    PaperNetwork,
    apply_layers,
    lower_triangle,
    normalisation,
)
from bodyslam_jax.motion._placing import Trial, place
from bodyslam_jax.motion._predict import MotionModel, in_dtype
from bodyslam_jax.motion._rotations import change
from bodyslam_jax.motion._sampling import Batch, Corpus, corpus, draw

logger = logging.getLogger(__name__)

_AVERAGING = 0.998
"""Of the running mean of weights that is validated and kept."""

_MEASURED = 20
"""Batches from which means and standard deviations are taken."""

DRIFTS = (0.0, 5.0, 9.0)
"""Slow joint-angle errors (degrees) at which a model is judged."""

TARGETS = (0.10, 0.13, 0.18)
"""Ratio of error to step that is hoped for at each of them."""


class Progress(eqx.Module):
    """All that a checkpoint must hold to continue as if nothing had happened."""

    network: MetricNetwork | PaperNetwork
    average: MetricNetwork | PaperNetwork
    """Running mean of the weights."""
    best: MetricNetwork | PaperNetwork
    """The mean that did best on validation."""
    optimiser: optax.OptState
    history: Float[Array, "e 7"]
    """Per epoch: training loss; validation error ratio, then slope, for `DRIFTS`."""
    epoch: Float[Array, ""]


def _trainable(network):
    """What the optimiser may change: all arrays but normalisation and calibration."""
    frozen = lambda x: isinstance(x, Normalisation)
    mask = jax.tree.map(
        lambda x: jax.tree.map(lambda _: False, x) if frozen(x) else True,
        network,
        is_leaf=frozen,
    )
    if isinstance(network, PaperNetwork):
        return eqx.tree_at(lambda n: n.spread, mask, False)
    return eqx.tree_at(lambda n: (n.unit, n.gain), mask, (False, False))


def loss(
    network: MetricNetwork | PaperNetwork, batch: Batch, settings: MotionTraining
) -> Float[Array, ""]:
    """Mean loss of a batch; see the module's docstring."""
    if isinstance(network, PaperNetwork):
        return _paper_loss(network, batch)
    return _metric_loss(network, batch, settings)


def _paper_loss(network: PaperNetwork, batch: Batch) -> Float[Array, ""]:
    """Equation 1: `c_p + λ c_θ`, λ = 1/24, of normalised quantities."""
    out = network.normalised(network.features(batch.window))
    move = batch.move * batch.window.leg[..., None]
    pose = batch.pose.reshape(*move.shape[:-1], 72)
    error = out - network.outputs(jnp.concatenate([move, pose], -1))
    square = (error[..., :3] ** 2).sum(-1) + (error[..., 3:] ** 2).sum(-1) / 24
    return (square * batch.weight).sum() / batch.weight.sum()


def _metric_loss(
    network: MetricNetwork, batch: Batch, settings: MotionTraining
) -> Float[Array, ""]:
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
    """Normalised change of posture."""
    return apply_layers(network.posture, network.posture_inputs(features))


def posture_goal(batch: Batch) -> Float[Array, "s l 24 3"]:
    """The rotation that leads from the (noisy) last posture to the true next one."""
    last = batch.window.body_pose[..., -2, :, :]
    turns = change(last, batch.pose[..., 1:, :])
    return jnp.concatenate([batch.pose[..., :1, :], turns], -2)


def _measure(
    network: MetricNetwork | PaperNetwork, batches: Sequence[Batch]
) -> MetricNetwork | PaperNetwork:
    """Sets normalisation from batches of training data."""
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
) -> MetricNetwork | PaperNetwork:
    """An untrained network of the kind that `settings` asks for."""
    if settings.network == "paper":
        return PaperNetwork.init(key, settings.past, settings.width[0])
    return MetricNetwork.init(
        key, settings.past, settings.width, settings.members, settings.future
    )


def optimiser(settings: MotionTraining, steps: int) -> optax.GradientTransformation:
    """AdamW; every gradient entry is kept below 1."""
    rate = settings.learning_rate
    schedule = (
        optax.warmup_cosine_decay_schedule(0.0, rate, min(100, steps // 10 + 1), steps)
        if settings.decay
        else rate
    )
    return optax.chain(
        optax.clip(1.0), optax.adamw(schedule, weight_decay=settings.weight_decay)
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
    """One epoch: draw, differentiate, update, `steps` times in one scan."""
    update = optimiser(settings, steps * epochs)
    mask = _trainable(progress.network)
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
        keep = jnp.minimum(_AVERAGING, (1 + done) / (10 + done))
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


def train(
    clips: Sequence[Clip],
    body: BodyModel,
    settings: MotionTraining = MotionTraining(),
    *,
    validation: Sequence[Clip] = (),
    checkpoint: Path | None = None,
    report: Callable[[int, int, dict[str, float]], None] | None = None,
    about: dict | None = None,
) -> tuple[MotionModel, Float[np.ndarray, "e 7"]]:
    """Trains a motion model; returns it and the history that `draw_history` draws.

    `validation` clips (of other subjects) choose the epoch whose weights are kept and
    give the covariance its size; without them the last epoch is kept. `checkpoint` is
    a file that every epoch rewrites: the same call continues from it after a kill, and
    it is removed at the end. `report(epoch, epochs, measures)` is called after each
    epoch. The same seed gives the same weights on the same machine.

    **Raises:** `ValueError` if no clip is long enough, if a checkpoint belongs to
    other settings or data, or if training diverges.
    """
    body = in_dtype(body, jnp.float32)
    data = corpus(clips, settings)
    trials = place(body, resample([c for c in validation if c.phase == 0], FPS))
    steps = -(-data.num_windows // (settings.segments * settings.steps))
    key = jax.random.key(settings.seed)
    network = initial_network(jax.random.fold_in(key, 0), settings)
    stacked = jax.jit(lambda key: draw(key, data, body, settings))
    keys = jax.random.split(jax.random.fold_in(key, 2), _MEASURED)
    network = _measure(network, [stacked(k) for k in keys])
    mask = _trainable(network)
    progress = Progress(
        network=network,
        average=network,
        best=network,
        optimiser=optimiser(settings, 1000).init(eqx.filter(network, mask)),
        history=jnp.full((settings.epochs, 7), jnp.nan, jnp.float32),
        epoch=jnp.zeros((), jnp.float32),
    )
    mark = _fingerprint(settings, data, body)
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
            raise ValueError(
                f"training diverged in epoch {epoch + 1}: loss is not finite."
            )
        if trials:
            progress = _validate(progress, model, body, trials, epoch, settings)
            row = np.asarray(progress.history[epoch])
            measures |= {
                f"ratio at {d:g} deg": float(r) for d, r in zip(DRIFTS, row[1:4])
            }
            measures |= {
                f"slope at {d:g} deg": float(r) for d, r in zip(DRIFTS, row[4:])
            }
        else:
            progress = dataclasses.replace(progress, best=progress.average)
        if checkpoint is not None:
            save_checkpoint(checkpoint, progress, mark)
        if report is not None:
            report(epoch + 1, settings.epochs, measures)
    done = model(progress.best)
    if trials:
        done = calibrated(done, body, trials)
    if checkpoint is not None:
        checkpoint.unlink(missing_ok=True)
    return done, np.asarray(progress.history)


def _score(row: Float[np.ndarray, " 6"], drift_deg: float) -> float:
    """What validation prefers: small errors and slopes near 1 at noise as trained."""
    seen = np.array(DRIFTS) <= drift_deg
    errors, bias = row[:3] / TARGETS, np.abs(row[3:] - 1)
    return float(np.mean(errors[seen]) + 5 * np.mean(bias[seen]))


def _validate(progress, model, body, trials, epoch, settings) -> Progress:
    runs = [
        summary(run_trials(model(progress.average), body, trials, d)) for d in DRIFTS
    ]
    row = np.array([run[k] for k in ("ratio", "slope") for run in runs])
    past = np.asarray(progress.history[:epoch, 1:])
    score = lambda r: _score(r, settings.drift_deg)
    better = score(row) < min(map(score, past), default=np.inf)
    return dataclasses.replace(
        progress,
        history=progress.history.at[epoch, 1:].set(jnp.asarray(row, jnp.float32)),
        best=progress.average if better else progress.best,
    )


def calibrated(
    model: MotionModel, body: BodyModel, trials: Sequence[Trial]
) -> MotionModel:
    """Sizes the covariance so that normalised errors have mean square 1.

    Over all noise levels together: the network's own covariance says how they differ.
    The paper's network has none; its constant one is measured here.
    """
    runs = [run_trials(model, body, trials, d) for d in DRIFTS]
    error = np.concatenate([(r.predicted - r.true)[r.valid] for r in runs]).astype(
        float
    )
    if isinstance(model.network, PaperNetwork):
        spread = np.linalg.cholesky(error.T @ error / len(error) + 1e-10 * np.eye(3))
        new = jnp.asarray(spread, jnp.float32)
        return eqx.tree_at(lambda m: m.network.spread, model, new)
    covariance = np.concatenate([r.covariance[r.valid] for r in runs]).astype(float)
    nees = (error * np.linalg.solve(covariance, error[..., None])[..., 0]).sum(-1) / 3
    factor = 0.5 * np.log(nees.mean())
    bias = lambda m: [layers[-1].bias for layers in m.network.spreads]
    shift = jnp.asarray([factor] * 3 + [0.0] * 3, jnp.float32)
    return eqx.tree_at(bias, model, [b + shift for b in bias(model)])


def _fingerprint(settings: MotionTraining, data: Corpus, body: BodyModel) -> str:
    """Changes with anything that would make a checkpoint another run's."""
    mark = hashlib.sha256(json.dumps(dataclasses.asdict(settings)).encode())
    mark.update(body.kind.encode())
    for array in (data.poses, data.path, data.start):
        mark.update(np.asarray(array).tobytes())
    return mark.hexdigest()


def save_checkpoint(path: Path, progress: Progress, mark: str) -> None:
    """Writes everything, then puts it in place in one step."""
    leaves = {
        f"leaf_{i}": np.asarray(x) for i, x in enumerate(jax.tree.leaves(progress))
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".partial.npz")
    with open(partial, "wb") as file:
        np.savez(file, allow_pickle=False, mark=np.array(mark), **leaves)
        file.flush()
        os.fsync(file.fileno())
    os.replace(partial, path)


def load_checkpoint(path: Path, like: Progress, mark: str) -> Progress:
    """Reads what `save_checkpoint` wrote.

    **Raises:** `ValueError` if it is damaged or of another run.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            found = str(archive["mark"])
            leaves = [archive[f"leaf_{i}"] for i in range(len(archive.files) - 1)]
    except (OSError, KeyError, ValueError, EOFError) as error:
        raise ValueError(f"{path}: not a training checkpoint ({error}).") from None
    if found != mark:
        raise ValueError(
            f"{path}: checkpoint of other settings or data; remove it to start anew."
        )
    return jax.tree.unflatten(jax.tree.structure(like), map(jnp.asarray, leaves))


def draw_history(history: Float[np.ndarray, "e 7"], path: Path) -> None:
    """Draws loss, validation error and slope over epochs to an image file."""
    from matplotlib.figure import Figure

    figure = Figure((9, 3), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    epochs = np.arange(1, len(history) + 1)
    left.plot(epochs, history[:, 0], color="k")
    left.set(title="training loss", xlabel="epoch")
    for i, (drift_deg, target) in enumerate(zip(DRIFTS, TARGETS, strict=True)):
        (line,) = middle.plot(epochs, history[:, 1 + i], label=f"{drift_deg:g}° drift")
        middle.axhline(target, color=line.get_color(), lw=0.7, ls=":")
        right.plot(epochs, history[:, 4 + i], color=line.get_color())
    middle.set(title="validation error / step", xlabel="epoch", ylim=(0, 0.4))
    middle.legend()
    right.axhline(1, color="k", lw=0.7)
    right.set(title="validation slope", xlabel="epoch", ylim=(0.8, 1.1))
    figure.savefig(path, dpi=120)
