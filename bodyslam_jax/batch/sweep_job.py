"""Solves the joint problem of one clip for many weights and start scales, in one
program."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bodyslam_jax import diagnostics, evaluation, graph, io, solver
from bodyslam_jax.batch.grid import SCALE
from bodyslam_jax.batch.inputs import Input
from bodyslam_jax.batch.rows import Row
from bodyslam_jax.body import BodyModel, load_body_model
from bodyslam_jax.config import Config
from bodyslam_jax.diagnostics.statistics import camera_statistics
from bodyslam_jax.pipeline import before_joint, joint_stage, people_stage
from bodyslam_jax.pipeline.contact_stage import hold_standing_feet
from bodyslam_jax.pipeline.joint_problem import Prepared, prepare, schedule_of
from bodyslam_jax.pipeline.progress import Stopwatch
from bodyslam_jax.pipeline.stage_cache import Cache
from bodyslam_jax.pipeline.to_metric import to_metric
from bodyslam_jax.types import Result, SfmResult
from bodyslam_jax.types import Sequence as Clip


@dataclasses.dataclass(frozen=True)
class SweepJob:
    """A clip, its settings, and the points at which its joint problem is solved."""

    source: Input
    config: Config
    setting: dict[str, str]
    """The point of the grid of settings, for the rows."""
    points: tuple[dict[str, float], ...]
    """Values of `scale` and `weights.TERM` at each point."""
    stages: Path
    """Folder for the stages before the joint estimate."""

    @property
    def label(self) -> str:
        """Name of the clip, followed by the values of its settings."""
        parts = [f"{name}={value}" for name, value in self.setting.items()]
        return " ".join([self.source.name, *parts])


def run_sweep(job: SweepJob) -> list[Row]:
    """Returns a row for each point: cost, scale, and errors if there is a truth.

    **Raises:** `ValueError` as the pipeline does, and for a term that the clip's
    problem does not have.
    """
    clip, cameras, body, prepared = _prepared(job)
    weights = {
        name.partition(".")[2]: jnp.asarray([point[name] for point in job.points])
        for name in job.points[0]
        if name != SCALE
    }
    scales = jnp.asarray([point.get(SCALE, 1.0) for point in job.points])
    found = _solve_all(
        prepared.problem, prepared.state, schedule_of(job.config), weights, scales
    )
    truth = None
    if clip.groundtruth is not None:
        truth = evaluation.read_groundtruth(clip.groundtruth, body)
    rows = []
    for k, point in enumerate(job.points):
        one = jax.tree.map(lambda x: x[k], found)
        status = str(np.asarray(found.status)[k])
        weighted = {term: weight[k] for term, weight in weights.items()}
        problem = graph.with_weights(prepared.problem, **weighted)
        problem, _ = graph.rescaled(problem, prepared.state, scales[k])
        same = dataclasses.replace(prepared, problem=problem)
        standing = hold_standing_feet(same, one.state, clip, cameras, body, job.config)
        result = _result(
            job.config, clip, cameras, body, prepared, standing.state, status
        )
        rows.append(
            {
                "name": job.source.name,
                **job.setting,
                **point,
                "status": status,
                "cost": float(one.cost),
                "iterations": sum(int(n) for n in one.num_steps),
                **_figures(result, truth, body),
            }
        )
    return rows


def _solve_one(problem, state, schedule, weights, scale):
    weighted = graph.with_weights(problem, **weights)
    start = graph.rescaled(weighted, state, scale)
    return solver.solve(*start, schedule=schedule)


_solve_all = solver.vmap_over_devices(_solve_one, (None, None, None, 0, 0))


def _prepared(job: SweepJob) -> tuple[Clip, SfmResult, BodyModel, Prepared]:
    """Builds the joint problem as `pipeline.run` does."""
    source, config = job.source, job.config
    clip = io.read_sequence(
        source.path,
        keypoints=source.keypoints,
        bodies=source.bodies,
        camera=source.camera,
        config=config.association,
        known=config,
    )
    if source.groundtruth is not None:
        clip = dataclasses.replace(clip, groundtruth=source.groundtruth)
    cache, body = Cache(job.stages), load_body_model(config.body_model)
    clip = people_stage.detect(clip, config, cache, Stopwatch())
    clip = diagnostics.reconcile(clip, body)
    clip, cameras, bodies = before_joint(clip, body, config, cache)
    return clip, cameras, body, prepare(clip, cameras, bodies, body, config)


def _result(
    config: Config,
    clip: Clip,
    cameras: SfmResult,
    body: BodyModel,
    prepared: Prepared,
    state: graph.State,
    status: str,
) -> Result:
    nothing = np.full((len(state.shapes), 10, 10), np.nan)
    uncertainty = joint_stage.Uncertainty(np.nan, nothing)
    joint = joint_stage.of_state(state, prepared, uncertainty, status, ())
    return to_metric(clip, config, body, cameras, joint)[0]


def _figures(result: Result, truth: Result | None, body: BodyModel) -> dict[str, Any]:
    row: dict[str, Any] = {
        "estimate": result.scale,
        "camera_path": camera_statistics(result).distance,
    }
    if truth is not None:
        errors = evaluation.evaluate(result, truth, body)
        row |= {f"error.{name}": float(errors[name]) for name in ERRORS}
    return row


ERRORS = ("c_ate_se3", "c_ate_sim3", "h_ate_se3", "j_ate_se3", "scale")
"""Errors in the rows of a sweep, by their names in `evaluation`."""
