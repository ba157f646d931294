"""Tables and plots of the accuracy of motion models."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from bodyslam_jax.body import PARENTS, BodyModel, local_joints
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io.markup import markdown_table
from bodyslam_jax.motion.capture.clips import FPS, Clip, place, resample
from bodyslam_jax.motion.prediction import MotionModel, Rollout
from bodyslam_jax.motion.training.evaluation import (
    DRIFTS_DEG,
    TARGET_RATIOS,
    baseline_mean,
    evaluate_model,
    run_trials,
)

COLUMNS = (
    "error_mm step_mm ratio slope slope_30 spread nees coverage_95 corr_1 corr_30 "
    "posture_deg posture_mm"
).split()
"""Measures that `write_table` prints."""


def compare(
    models: Mapping[str, MotionModel],
    body: BodyModel,
    clips: Sequence[Clip],
    *,
    training: Sequence[Clip] = (),
    seeds: int = 3,
) -> list[dict[str, str | float]]:
    """Evaluates several models on the same steps of the same clips, with baselines.

    Returns one row per model, drift (degrees) and motion class; one of constant
    velocity; and one of the mean displacement of `training` clips, if given.
    `write_table` formats them.

    **Raises:** `InputError` without models.
    """
    if not models:
        raise InputError("compare: no models, expected one or more.")
    skip = max(model.past for model in models.values()) + 1
    rows, steady = [], {}
    for name, model in models.items():
        for drift_deg in DRIFTS_DEG:
            found = evaluate_model(
                model, body, clips, drift_deg, seeds=seeds, skip=skip
            )
            rows += [
                {"model": name, "drift": drift_deg, "class": kind, **measures}
                for kind, measures in found.items()
                if kind != "constant velocity"
            ]
            steady = found["constant velocity"]
    rows.append(
        {
            "model": "constant velocity (given the last displacement)",
            "drift": 0.0,
            "class": "all",
            **steady,
        }
    )
    if training:
        model = next(iter(models.values()))
        rows.append(
            {
                "model": "mean of the training set",
                "drift": 0.0,
                "class": "all",
                **evaluate_model(
                    model,
                    body,
                    clips,
                    skip=skip,
                    constant=baseline_mean(training),
                )["constant"],
            }
        )
    return rows


def write_table(rows: Sequence[Mapping[str, str | float]]) -> str:
    """Formats the rows of `compare` as a Markdown table."""
    head = ["model", "drift °", "class", *COLUMNS]
    lines = [head]
    for row in rows:
        cells = [str(row["model"]), f"{row['drift']:g}", str(row["class"])]
        for column in COLUMNS:
            value = row.get(column)
            digits = 1 if column.endswith(("_mm", "_deg")) else 3
            is_number = isinstance(value, float) and np.isfinite(value)
            cells.append(f"{value:.{digits}f}" if is_number else "")
        lines.append(cells)
    return markdown_table(lines)


def draw_errors(
    model: MotionModel,
    body: BodyModel,
    clips: Sequence[Clip],
    path: Path,
) -> None:
    """Draws histograms of the translation error in x, y, z of H, as figure 7 of the
    paper, to an image file."""
    trials = place(body, resample([c for c in clips if c.phase == 0], FPS))
    from matplotlib.figure import Figure  # takes half a second to import

    figure = Figure((9, 2.8), layout="constrained")
    axes = figure.subplots(1, 3, sharey=True)
    bins = np.linspace(-30, 30, 61)
    for drift_deg in DRIFTS_DEG:
        steps = run_trials(model, body, trials, drift_deg)
        error = 1e3 * (steps.predicted - steps.true)[steps.valid]
        for axis, values in zip(axes, error.T, strict=True):
            label = f"{drift_deg:g}°: {values.mean():.1f} ± {values.std():.1f}"
            axis.hist(values, bins, density=True, histtype="step", label=label)
    for axis, name in zip(axes, ("x (left)", "y (up)", "z (forward)"), strict=True):
        axis.set(xlabel=f"error in {name}, mm")
        axis.legend(fontsize=7, title="drift: mean ± sd", title_fontsize=7)
    axes[0].set_ylabel("density, 1/mm")
    figure.suptitle("recorded motion, simulated drift of postures", fontsize=9)
    figure.savefig(path, dpi=120)


def draw_rollout(
    motion: Rollout,
    body: BodyModel,
    shape: Float[np.ndarray, " 10"],
    path: Path,
    every: int = 15,
) -> None:
    """Draws stick figures of a motion, seen from its right and from above, to an image
    file."""
    dtype = motion.body_pose.dtype
    local = local_joints(body, motion.body_pose, jnp.asarray(shape, dtype))
    world = jnp.einsum("tab,tjb->tja", motion.orientation, local)
    joints = np.asarray(world + motion.trans[:, None])
    heading = np.asarray(motion.orientation[0, :, 2])
    up = np.asarray(motion.orientation[0, :, 1])
    side = np.cross(up, heading)
    from matplotlib.figure import Figure  # takes half a second to import

    figure = Figure((9, 4), layout="constrained")
    axes = figure.subplots(2, 1, sharex=True)
    for axis, vertical in zip(axes, (up, side), strict=True):
        for k in range(0, len(joints), every):
            color = "0.6" if k == 0 else f"C{k // every % 10}"
            for joint in range(1, 24):
                ends = joints[k, [joint, PARENTS[joint]]]
                axis.plot(ends @ heading, ends @ vertical, color=color, lw=1)
        axis.set_aspect("equal")
    axes[1].set(xlabel="m ahead", ylabel="m to the left")
    axes[0].set(ylabel="m up", title=f"every {every / FPS:.2g} s")
    figure.savefig(path, dpi=120)


def draw_history(history: Float[np.ndarray, "e 7"], path: Path) -> None:
    """Draws loss, validation error and slope over epochs to an image file."""
    from matplotlib.figure import Figure  # takes half a second to import

    figure = Figure((9, 3), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    epochs = np.arange(1, len(history) + 1)
    left.plot(epochs, history[:, 0], color="k")
    left.set(title="training loss", xlabel="epoch")
    if (history[:, 0] > 0).all():  # a likelihood may be negative
        left.set_yscale("log")
    judged = np.isfinite(history[:, 1])
    at, rows = epochs[judged], history[judged]
    for i, (drift_deg, target) in enumerate(
        zip(DRIFTS_DEG, TARGET_RATIOS, strict=True)
    ):
        (line,) = middle.plot(at, rows[:, 1 + i], label=f"{drift_deg:g}° drift")
        middle.axhline(target, color=line.get_color(), lw=0.7, ls=":")
        right.plot(at, rows[:, 4 + i], color=line.get_color())
    middle.set(title="validation error / step", xlabel="epoch")
    right.axhline(1, color="k", lw=0.7)
    right.set(title="validation slope", xlabel="epoch")
    if len(rows):  # the first epochs may be far out
        middle.legend()
        late = rows[len(rows) // 5 :]
        middle.set_ylim(0, 1.1 * max(*TARGET_RATIOS, late[:, 1:4].max()))
        low, high = late[:, 4:].min(), late[:, 4:].max()
        right.set_ylim(min(low, 0.95) - 0.02, max(high, 1.05) + 0.02)
    figure.savefig(path, dpi=120)
