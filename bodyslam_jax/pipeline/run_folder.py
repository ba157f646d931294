"""A run whose stages and result are kept in a folder, which one process holds."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from bodyslam_jax import evaluation, export, io, sfm, view
from bodyslam_jax.body import load_body_model
from bodyslam_jax.config import Config
from bodyslam_jax.evaluation import before_after
from bodyslam_jax.export.summary import describe
from bodyslam_jax.pipeline.default_body import with_compatible_body
from bodyslam_jax.pipeline.people_stage import check_people, with_warnings
from bodyslam_jax.pipeline.progress import Stopwatch
from bodyslam_jax.pipeline.run import run_stages
from bodyslam_jax.pipeline.stage_cache import Cache
from bodyslam_jax.types import Result, Sequence, SfmResult, Tracks


def run_to_folder(sequence: Sequence, out: Path, config: Config = Config()) -> Result:
    """`run`, with finished stages kept in `out` and everything of the contract written.

    Where the sequence has a ground truth, the report contains the errors.

    **Raises:** `ValueError` if `out` cannot be written, holds something else, or is
    being written by another process.
    """
    config, warnings = with_compatible_body(config)
    sequence = with_warnings(sequence, warnings)
    cache = stage_cache_of(sequence, out)
    check_people(sequence, config)
    export.check_folder(out, cache.source, cache.owner())
    with export.locked(out):
        return run_in_locked_folder(sequence, out, config, cache)


def stage_cache_of(sequence: Sequence, out: Path) -> Cache:
    """The cache of stages in the run folder `out`, for this sequence."""
    return Cache(out / ".cache", describe(sequence))


def run_in_locked_folder(
    sequence: Sequence, out: Path, config: Config, cache: Cache
) -> Result:
    """`run_to_folder` for a caller that holds the folder's lock."""
    export.clear_partial(out)
    body = load_body_model(config.body_model)
    result, cameras = run_stages(sequence, config, cache)
    if sequence.groundtruth is not None:
        truth = evaluation.read_groundtruth(sequence.groundtruth, body)
        errors = before_after.errors(result, cameras, truth, body)
        result.summary["errors"] = errors
        result.summary["headline"] += before_after.headline(errors)
    watch = Stopwatch()
    observations = _map_observations(cameras)
    middle = view.middle_frame(result)
    sampler = view.VideoSampler(
        sequence.num_frames, observations, len(cameras.landmarks), middle
    )
    with export.run_folder(out) as partial:
        if sequence.frames is not None:
            images = sampler.watch(_images(sequence, cameras))
            with watch("overlay" if config.overlay else "images"):
                if config.overlay:
                    file = partial / "overlay.webm"
                    view.write_overlay(file, images, result, body, observations)
                for _ in images:  # Those that the overlay did not need.
                    pass
        with watch("scene"):
            samples = sampler.samples()
            view.write_scene(partial / "scene.html", result, body, samples)
        result.summary["durations_s"] |= watch.seconds
        export.write_files(partial, result, config)
        still = None
        if sampler.whole is not None:
            still = view.still(sampler.whole, result, body, middle)
        export.write_report(partial / "report.html", result, body, still)
    return result


def _images(sequence: Sequence, cameras: SfmResult) -> Iterator[np.ndarray]:
    """The images, with the zoom undone if the camera zooms."""
    images = io.frames(sequence)
    if cameras.zoom is None:
        return images
    return sfm.without_zoom(images, cameras.zoom, cameras.intrinsics[2:4])


def _map_observations(cameras: SfmResult) -> Tracks:
    """The inlier observations of the landmarks."""
    tracks, keep = cameras.tracks, cameras.keep
    return Tracks(tracks.frame[keep], tracks.landmark[keep], tracks.uv[keep])
