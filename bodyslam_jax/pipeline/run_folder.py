"""Runs that keep stages and result in a locked folder, and the demonstration."""

from pathlib import Path

from bodyslam_jax import evaluation, export, io, simulation
from bodyslam_jax.body import load_body_model
from bodyslam_jax.config import Config
from bodyslam_jax.evaluation import before_after
from bodyslam_jax.export.summary import describe
from bodyslam_jax.io.budget import granted
from bodyslam_jax.pipeline.people_stage import check_people, with_warnings
from bodyslam_jax.pipeline.pictures import check_overlay, write_pictures
from bodyslam_jax.pipeline.progress import Stopwatch
from bodyslam_jax.pipeline.run import run_stages, with_compatible_body
from bodyslam_jax.pipeline.stage_cache import Cache
from bodyslam_jax.types import Result, Sequence

_SCENE_FOLDER = "scene"
"""Subfolder of the run folder that holds the input of the demonstration."""


def run_to_folder(sequence: Sequence, out: Path, config: Config = Config()) -> Result:
    """Runs all stages, keeps finished ones in `out` and writes all files of a run
    folder.

    If the sequence has a ground truth, the report contains the errors.

    **Raises:** as `run`; `ValueError` if `out` cannot be written, holds something else,
    or is being written by another process.
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
    """Returns the cache of stages in the run folder `out`, for this sequence."""
    return Cache(out / ".cache", describe(sequence))


def run_in_locked_folder(
    sequence: Sequence, out: Path, config: Config, cache: Cache
) -> Result:
    """Does the work of `run_to_folder` for a caller that holds the folder's lock."""
    check_overlay(config)
    export.clear_partial(out)
    body = load_body_model(config.body_model)
    result, cameras, measured = run_stages(sequence, config, cache)
    beside = None
    if sequence.groundtruth is not None:
        truth = evaluation.read_groundtruth(sequence.groundtruth, body)
        errors = before_after.errors(result, cameras, truth, body)
        result.summary["errors"] = errors
        beside = before_after.beside(result, truth, body)
        result.summary["headline"] += before_after.headline(errors, beside)
    watch = Stopwatch()
    with export.run_folder(out) as partial:
        still = write_pictures(partial, measured, cameras, result, body, config, watch)
        result.summary["durations_s"] |= watch.seconds
        with watch("report"):
            export.write_files(partial, result, config)
            export.write_report(partial / "report.html", result, body, still, beside)
    return result


def demo(
    out: Path,
    config: Config = Config(),
    *,
    from_pixels: bool = True,
) -> Result:
    """Renders a walker filmed by a moving camera and runs the pipeline on the images.

    The scene is written to `out/scene`, a sequence folder with its ground truth.

    Args:
        from_pixels: True to detect people in the images, with the networks of the
            package; False to use simulated keypoints and bodies.

    **Raises:** `ValueError` if `out` cannot be written.
    """
    config, warnings = with_compatible_body(config)
    cache = Cache(out / ".cache", {"name": _SCENE_FOLDER})
    export.check_folder(out, cache.source, cache.owner())
    with export.locked(out):
        folder = out / _SCENE_FOLDER
        with Stopwatch()("rendering"):
            simulation.demo_scene(folder, people=not from_pixels)
            sequence = with_warnings(io.read_sequence(folder), warnings)
        cache = stage_cache_of(sequence, out)
        export.check_folder(out, cache.source, cache.owner())
        return run_in_locked_folder(sequence, out, config, cache)
