"""A run whose stages and result are kept in a folder, which one process holds."""

from pathlib import Path

from bodyslam_jax import evaluation, export
from bodyslam_jax.body import load_body_model
from bodyslam_jax.config import Config
from bodyslam_jax.evaluation import before_after
from bodyslam_jax.export.summary import describe
from bodyslam_jax.io.budget import granted
from bodyslam_jax.pipeline.default_body import with_compatible_body
from bodyslam_jax.pipeline.people_stage import check_people, with_warnings
from bodyslam_jax.pipeline.pictures import check_overlay, write_pictures
from bodyslam_jax.pipeline.progress import Stopwatch
from bodyslam_jax.pipeline.run import run_stages
from bodyslam_jax.pipeline.stage_cache import Cache
from bodyslam_jax.types import Result, Sequence


def run_to_folder(sequence: Sequence, out: Path, config: Config = Config()) -> Result:
    """`run`, with finished stages kept in `out` and everything of the contract written.

    Where the sequence has a ground truth, the report contains the errors.

    **Raises:** `ValueError` if `out` cannot be written, holds something else, or is
    being written by another process.
    """
    gender = sequence.bodies.gender if sequence.bodies else None
    config, warnings = with_compatible_body(config, gender)
    sequence = with_warnings(sequence, warnings)
    cache = stage_cache_of(sequence, out)
    check_people(sequence, config)
    export.check_folder(out, cache.source, cache.owner())
    with export.locked(out), granted(config.limits):
        return run_in_locked_folder(sequence, out, config, cache)


def stage_cache_of(sequence: Sequence, out: Path) -> Cache:
    """The cache of stages in the run folder `out`, for this sequence."""
    return Cache(out / ".cache", describe(sequence))


def run_in_locked_folder(
    sequence: Sequence, out: Path, config: Config, cache: Cache
) -> Result:
    """`run_to_folder` for a caller that holds the folder's lock."""
    check_overlay(config)
    export.clear_partial(out)
    body = load_body_model(config.body_model)
    result, cameras, measured = run_stages(sequence, config, cache)
    if sequence.groundtruth is not None:
        truth = evaluation.read_groundtruth(sequence.groundtruth, body)
        errors = before_after.errors(result, cameras, truth, body)
        result.summary["errors"] = errors
        result.summary["headline"] += before_after.headline(errors)
    watch = Stopwatch()
    with export.run_folder(out) as partial:
        still = write_pictures(partial, measured, cameras, result, body, config, watch)
        result.summary["durations_s"] |= watch.seconds
        with watch("report"):
            export.write_files(partial, result, config)
            export.write_report(partial / "report.html", result, body, still)
    return result
