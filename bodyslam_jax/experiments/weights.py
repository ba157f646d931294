"""Learns weights through the solver, for `bodyslam experiment weights`.

The solution depends on the weights by the implicit function theorem (`solver.solve` has
its derivative), so an error after alignment can be minimised by gradient descent on
training sequences. A weight is the logarithm of a factor on a standard deviation, or on
the scale of a robust loss: λ = σ^-2, so log λ decreases by twice as much.
"""

import dataclasses
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from bodyslam_jax import evaluation, graph, solver
from bodyslam_jax.body import BodyModel
from bodyslam_jax.config.errors import InputError, error_line
from bodyslam_jax.experiments.scenario import errors, without_map
from bodyslam_jax.pipeline import stage_cache
from bodyslam_jax.pipeline.case import Case, trajectories
from bodyslam_jax.pipeline.joint_problem import Prepared
from bodyslam_jax.solver.compilation import compiled

log = logging.getLogger(__name__)
WEIGHTS: dict[str, tuple[type[graph.Factor], str]] = {
    "keypoints": (graph.KeypointReprojection, "sigma"),
    "keypoints loss": (graph.KeypointReprojection, "loss"),
    "human_motion": (graph.HumanMotion, "whitening"),
    "body_pose": (graph.BodyPosePrior, "sigma"),
    "shape": (graph.ShapePrior, "sigma"),
    "root_orientation": (graph.RootOrientation, "sigma"),
    "angular_acceleration": (graph.AngularAccelerationPrior, "sigma"),
    "upright": (graph.UprightPrior, "sigma"),
    "root_smoothness": (graph.RootSmoothness, "sigma"),
    "ground": (graph.GroundContact, "sigma"),
    "landmarks": (graph.Reprojection, "sigma"),
    "landmarks loss": (graph.Reprojection, "loss"),
}
"""The field of a factor that each weight multiplies, by the name of its term."""
SCALE_UNIT, JOINT_UNIT_M = 0.05, 0.05
"""Units of the training error: of log s, and of J-ATE."""
SCHEDULE = (solver.Stage(),)
"""Single stage, because the start is the solution for similar weights."""
PRIOR_COST = 0.02
"""Cost of a weight that differs by a factor e: a prior, because there are few
sequences."""


class Trial(eqx.Module):
    """A training sequence: a problem, a state near its solution, and ground truth."""

    problem: graph.Problem
    state: graph.State
    truth: evaluation.Trajectories
    body: BodyModel
    registered: Array


@dataclasses.dataclass(frozen=True)
class Learned:
    """Values of `w` weights after `n` steps on the training sequences."""

    names: tuple[str, ...]
    log: Float[np.ndarray, " w"]
    """Logarithm of the factor on each standard deviation or robust scale."""
    history: Float[np.ndarray, " n"]
    """Mean error over the training sequences before each step."""
    path: Float[np.ndarray, "n w"]


@dataclasses.dataclass(frozen=True)
class Progress:
    """State of the optimisation after a step, as arrays."""

    names: tuple[str, ...]
    standing: tuple[np.ndarray, ...]
    """Weights, moments of Adam, and the current solution of each sequence."""
    history: Float[np.ndarray, " n"]
    path: Float[np.ndarray, "n w"]


def make_trial(case: Case, prepared: Prepared, *, hold_cameras: bool) -> Trial:
    """Returns the problem of a case with its solution for the current weights.

    With `hold_cameras` there are no landmarks, which makes a solve far cheaper.
    """
    problem, state = prepared.problem, prepared.state
    if hold_cameras:
        problem, state = without_map(problem, state, hold_cameras=True)
    solution = solver.solve(problem, state, schedule=solver.PAPER_SCHEDULE)
    registered = jnp.asarray(case.cameras.registered)
    return Trial(problem, solution.state, case.truth, case.body, registered)


def names_of(problem: graph.Problem) -> tuple[str, ...]:
    """Returns the names of the weights (keys of `WEIGHTS`) whose factors the problem
    has."""
    kinds = {type(factor) for factor in problem.factors}
    return tuple(name for name, (kind, _) in WEIGHTS.items() if kind in kinds)


def reweighted(
    problem: graph.Problem, names: Sequence[str], log: Float[Array, " w"]
) -> graph.Problem:
    """Returns the problem with the standard deviations of its terms multiplied by
    `exp(log)`.

    **Raises:** `InputError` for a name that is not among `WEIGHTS`.
    """
    unknown = set(names) - set(WEIGHTS)
    if unknown:
        raise InputError(f"weights {sorted(unknown)}, expected of {list(WEIGHTS)}.")
    factors = list(problem.factors)
    for name, value in zip(names, log, strict=True):
        kind, field = WEIGHTS[name]
        for i, factor in enumerate(factors):
            if isinstance(factor, kind):
                factors[i] = _scaled(factor, field, jnp.exp(value))
    return eqx.tree_at(lambda p: p.factors, problem, tuple(factors))


def _scaled(factor: graph.Factor, field: str, by: Array) -> graph.Factor:
    if field == "loss":
        return eqx.tree_at(lambda f: f.loss.scale, factor, factor.loss.scale * by)
    old = getattr(factor, field)
    if field == "whitening":
        new = old / by
    else:
        # An infinite sigma marks missing data and has no derivative.
        missing = jnp.isinf(old)
        new = jnp.where(missing, jnp.inf, jnp.where(missing, 1.0, old) * by)
    return eqx.tree_at(lambda f: getattr(f, field), factor, new)


def outcome(
    trial: Trial,
    names: Sequence[str],
    log: Float[Array, " w"],
    schedule: tuple[solver.Stage, ...] = SCHEDULE,
) -> tuple[graph.State, Float[Array, ""], dict[str, Float[Array, ""]]]:
    """Returns solution, cost and errors for these weights; pure and differentiable."""
    problem = reweighted(trial.problem, names, log)
    solution = solver.solve(problem, trial.state, schedule=schedule)
    motion = problem.motion
    present = trial.truth.present if motion is None else motion.present
    estimate = trajectories(
        solution.state, trial.body, present, trial.registered, trial.truth.fps
    )
    return solution.state, solution.cost, errors(estimate, trial.truth)


def training_error(found: dict[str, Float[Array, ""]]) -> Float[Array, ""]:
    """Returns `(log s / 0.05)² + J-ATE / 0.05 m`, a smooth function of the solution.

    `s` is the estimated over the true scale; J-ATE is after SE(3) alignment.
    """
    return (jnp.log(found["scale"]) / SCALE_UNIT) ** 2 + found[
        "j_ate_se3"
    ] / JOINT_UNIT_M


@compiled
def error_and_gradient(
    trial: Trial, names: tuple[str, ...], log: Float[Array, " w"], state: graph.State
) -> tuple[Float[Array, ""], Float[Array, " w"], graph.State]:
    """Returns the training error, its gradient with respect to the weights, and the
    solution."""
    near = eqx.tree_at(lambda t: t.state, trial, state)

    def of(log):
        found, _, measured = outcome(near, names, log)
        return training_error(measured), found

    (value, found), gradient = jax.value_and_grad(of, has_aux=True)(log)
    return value, gradient, found


def learn_weights(
    trials: Sequence[Trial],
    *,
    steps: int = 12,
    rate: float = 0.15,
    names: tuple[str, ...] | None = None,
    progress: Path | None = None,
) -> Learned:
    """Minimises the mean training error over `trials` by Adam.

    Each solve starts from the trial's solution in the preceding step. The state after
    each step is stored in the file `progress`, from which interrupted learning resumes
    with the same result.

    **Raises:** `InputError` if there is no trial, or if `progress` has other weights.
    """
    if not trials:
        raise InputError("no sequence to learn from.")
    names = names or names_of(trials[0].problem)
    value = jnp.zeros(len(names))
    method = optax.adam(rate)
    standing = (value, method.init(value), [trial.state for trial in trials])
    history, path = [], []
    if progress is not None and (kept := _read(progress, names)) is not None:
        form = jax.tree.structure(standing)
        standing = jax.tree.unflatten(form, [jnp.asarray(x) for x in kept.standing])
        history, path = list(kept.history), list(kept.path)
    for step in range(len(history), steps):
        value, memory, states = standing
        error, slope, states = _mean_error(trials, names, value, states)
        history.append(error)
        path.append(np.asarray(value))
        log.info("weights: step %d of %d, error %.4g", step + 1, steps, error)
        # optax raises Python numbers to powers of arrays.
        with jax.numpy_dtype_promotion("standard"):
            change, memory = method.update(slope, memory)
        moved = jnp.asarray(optax.apply_updates(value, change))
        value = jnp.clip(moved, -2.0, 2.0)
        standing = (value, memory, states)
        if progress is not None:
            leaves = tuple(np.asarray(x) for x in jax.tree.leaves(standing))
            progress.parent.mkdir(parents=True, exist_ok=True)
            kept = Progress(names, leaves, np.array(history), np.array(path))
            stage_cache.save(progress, kept)
    best = int(np.nanargmin(history))
    return Learned(names, path[best], np.array(history), np.array(path))


def _mean_error(
    trials: Sequence[Trial],
    names: tuple[str, ...],
    value: Float[Array, " w"],
    states: Sequence[graph.State],
) -> tuple[float, Float[Array, " w"], list[graph.State]]:
    """Returns the mean training error, its gradient with respect to the log weights
    `value` (including the prior's), and each trial's new solution."""
    total, slope, found = 0.0, PRIOR_COST * 2 * value, []
    for k, (trial, state) in enumerate(zip(trials, states, strict=True)):
        error, gradient, state = error_and_gradient(trial, names, value, state)
        total += float(error) / len(trials)
        # A failed solve has no gradient; that of one sequence is clipped to length 1.
        if not np.all(np.isfinite(gradient)):
            log.warning("training sequence %d: no gradient, left out of this step", k)
            gradient = jnp.zeros_like(gradient)
        size = jnp.maximum(jnp.linalg.norm(gradient), 1e-12)
        slope = slope + gradient * jnp.minimum(1.0, 5.0 / size) / len(trials)
        found.append(state)
    return total, slope, found


def _read(progress: Path, names: tuple[str, ...]) -> Progress | None:
    """Reads the progress of an earlier run; `None` if there is none that can be
    read."""
    if not progress.exists():
        return None
    try:
        kept = stage_cache.load(progress, Progress)
    except (
        Exception
    ) as error:  # weights can be learnt again, whatever the file contains
        reason = error_line(error)
        log.warning("%s: not readable (%s); learnt from the start", progress, reason)
        return None
    if kept.names != names:
        raise InputError(f"{progress}: weights {kept.names}, expected {names}.")
    log.info("weights: %d steps taken from an earlier run", len(kept.history))
    return kept


def described(learned: Learned) -> dict[str, Any]:
    """Returns names, logarithms and factors of the weights, and the history of
    learning."""
    return {
        "names": list(learned.names),
        "log": learned.log.tolist(),
        "factor": np.exp(learned.log).tolist(),
        "history": learned.history.tolist(),
        "path": learned.path.tolist(),
    }


def judge(trial: Trial, learned: Learned) -> dict[str, float]:
    """Returns the errors with the original and with the learnt weights, by keys such as
    `before/scale`."""
    row = {}
    for when, log in (
        ("before", np.zeros_like(learned.log)),
        ("after", learned.log),
    ):
        found = _errors_with(trial, learned.names, jnp.asarray(log))
        row |= {f"{when}/{name}": float(value) for name, value in found.items()}
    return row


@compiled
def _errors_with(
    trial: Trial, names: tuple[str, ...], log: Float[Array, " w"]
) -> dict[str, Float[Array, ""]]:
    """Returns the errors for these weights, and the training error computed from
    them."""
    _, _, found = outcome(trial, names, log)
    return found | {"error": training_error(found)}
