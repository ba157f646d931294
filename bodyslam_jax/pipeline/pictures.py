"""Writes overlay video and 3D scene in one pass through the images."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from bodyslam_jax import io, sfm, view
from bodyslam_jax.body import BodyModel
from bodyslam_jax.config import Config
from bodyslam_jax.pipeline.progress import Stopwatch, counted
from bodyslam_jax.types import Result, Sequence, SfmResult, Tracks

_CODEC_BY_SUFFIX: dict[str, view.Codec] = {"webm": "VP8", "mp4": "H264"}


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
