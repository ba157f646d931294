"""Runs that keep stages, result and pictures in a locked folder, the demonstration, and
the initial values of the joint estimate as a run folder keeps them."""

from collections.abc import Iterator
from pathlib import Path
from typing import TypeVar

import jax.numpy as jnp
import numpy as np

from bodyslam_jax import evaluation, export, io, sfm, simulation, view
from bodyslam_jax.body import BodyModel, joints, load_body_model, rest_joints
from bodyslam_jax.config import Config
from bodyslam_jax.evaluation import before_after
from bodyslam_jax.export.summary import describe
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.io.budget import granted
from bodyslam_jax.pipeline.people_stage import check_people, with_warnings
from bodyslam_jax.pipeline.progress import Stopwatch, counted
from bodyslam_jax.pipeline.run import run_stages, with_compatible_body
from bodyslam_jax.pipeline.stage_cache import Cache, load
from bodyslam_jax.types import (
    Bodies,
    JointEstimate,
    Result,
    Sequence,
    SfmResult,
    Tracks,
)

_SCENE_FOLDER = "scene"
"""Subfolder of the run folder that holds the input of the demonstration."""
_CODEC_BY_SUFFIX: dict[str, view.Codec] = {"webm": "VP8", "mp4": "H264"}
T = TypeVar("T")


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
    Networks are those that have not been trained on the walker.

    Args:
        from_pixels: True to detect people in the images, with the networks of the
            package; False to use simulated keypoints and bodies.

    **Raises:** `ValueError` if `out` cannot be written.
    """
    config, warnings = with_compatible_body(config.for_simulated_people())
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


def check_overlay(config: Config) -> None:
    """Checks that the encoder of the overlay is installed.

    **Raises:** `ValueError` if it is not.
    """
    if config.overlay:
        view.check_codec(_CODEC_BY_SUFFIX[config.overlay_video])


def write_pictures(
    folder: Path,
    sequence: Sequence,
    cameras: SfmResult,
    result: Result,
    body: BodyModel,
    config: Config,
    watch: Stopwatch,
) -> bytes | None:
    """Writes overlay and `scene.html`; returns a frame of the overlay (JPEG), `None`
    without a video.

    Args:
        sequence: the input, with the keypoints of the people of `result` in its order.
    """
    observations = _map_observations(cameras)
    middle = view.middle_frame(result)
    number = len(cameras.landmarks)
    sampler = view.VideoSampler(sequence.num_frames, observations, number, middle)
    if sequence.frames is not None:
        stage = "overlay" if config.overlay else "images"
        every = counted(_images(sequence, cameras), stage, sequence.num_frames)
        images = sampler.watch(every)
        with watch(stage):
            if config.overlay:
                measured = config.overlay_measurements
                view.write_overlay(
                    folder / f"overlay.{config.overlay_video}",
                    images,
                    result,
                    body,
                    observations if measured else None,
                    codec=_CODEC_BY_SUFFIX[config.overlay_video],
                    keypoints=sequence.keypoints if measured else None,
                )
            for _ in images:  # The sampler sees those that the overlay did not need.
                pass
    with watch("scene"):
        view.write_scene(folder / "scene.html", result, body, sampler.samples())
    if sampler.whole is None:
        return None
    return view.still(sampler.whole, result, body, middle)


def _images(sequence: Sequence, cameras: SfmResult) -> Iterator[np.ndarray]:
    """Returns the images; for a camera that zooms, with the zoom undone."""
    images = io.frames(sequence)
    if cameras.zoom is None:
        return images
    return sfm.without_zoom(images, cameras.zoom, cameras.intrinsics[2:4])


def _map_observations(cameras: SfmResult) -> Tracks:
    """Returns the inlier observations of the landmarks."""
    tracks, keep = cameras.tracks, cameras.keep
    return Tracks(tracks.frame[keep], tracks.landmark[keep], tracks.uv[keep])


def start_of_joint(run: Path, result: Result, body: BodyModel) -> Result | None:
    """Returns cameras and map of structure from motion and bodies of the people stage,
    with the first scale, from the stages kept in a run folder.

    The first located camera coincides with that of `result`. Returns `None` if the
    folder keeps no such stages, or those of another result.
    """
    cameras = _stage(run, "cameras", SfmResult)
    bodies = _stage(run, "people", Bodies)
    joint = _stage(run, "joint", JointEstimate)
    if cameras is None or bodies is None or joint is None:
        return None
    shape = result.present.shape
    if bodies.present.shape != shape or cameras.T_WC.shape != result.T_WC.shape:
        return None
    scale = joint.start.value
    T_WC = cameras.T_WC.copy()
    T_WC[:, :3, 3] *= scale
    first = int(np.argmax(result.located))
    move = result.T_WC[first] @ np.linalg.inv(T_WC[first])
    T_WC = move @ T_WC
    landmarks = scale * cameras.landmarks @ move[:3, :3].T + move[:3, 3]
    poses = bodies.poses.copy()
    poses[..., :3] = so3.log(T_WC[:, :3, :3] @ so3.exp(poses[..., :3]))
    # A person has one shape: the median, as the people stage has one per frame.
    betas = np.stack(
        [
            np.median(beta[there], axis=0) if there.any() else np.zeros(10)
            for beta, there in zip(bodies.shapes, bodies.present, strict=True)
        ]
    ).reshape(len(bodies.present), 10)
    rest = np.asarray(rest_joints(body, jnp.asarray(betas, body.dtype)), np.float64)
    pelvis = rest[:, None, 0] + bodies.trans
    pelvis = np.einsum("tij,htj->hti", T_WC[:, :3, :3], pelvis) + T_WC[:, :3, 3]
    trans = pelvis - rest[:, None, 0]
    cast = lambda x: jnp.asarray(x, body.dtype)
    posed = joints(body, cast(poses), cast(betas[:, None]), cast(trans))
    return Result(
        timestamps=result.timestamps,
        T_WC=T_WC,
        scale=scale,
        intrinsics=cameras.intrinsics,
        landmarks=landmarks if cameras.kind == "moving" else landmarks[:0],
        poses=poses,
        trans=trans,
        betas=betas,
        joints=np.asarray(posed, np.float64),
        present=bodies.present,
        summary={k: result.summary[k] for k in ("input", "frames_used")},
    )


def _stage(run: Path, name: str, kind: type[T]) -> T | None:
    """Loads a stage from a run folder; `None` if there is none, or it is unreadable."""
    found = sorted((run / ".cache").glob(f"{name}-*.npz"))
    if len(found) != 1:
        return None
    try:
        return load(found[0], kind)
    except Exception:  # the page is shown without what cannot be read
        return None
