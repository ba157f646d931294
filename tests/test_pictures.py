"""Overlay, scene and still of a run, from one pass through its video."""

import dataclasses

import cv2
import export_cases
import jax.numpy as jnp
import numpy as np
import pytest

from bodyslam_jax import view
from bodyslam_jax.body import load_body_model
from bodyslam_jax.config import Config
from bodyslam_jax.pipeline import run_folder
from bodyslam_jax.pipeline.progress import Stopwatch
from bodyslam_jax.types import Intrinsics, Keypoints, Sequence, SfmResult, Tracks

WIDTH, HEIGHT = export_cases.SIZE


@pytest.fixture(scope="module")
def body():
    return load_body_model(dtype=jnp.float32)


@pytest.fixture(scope="module")
def result():
    return export_cases.make_result(load_body_model())


@pytest.fixture
def measured(tmp_path, result):
    """A video of red images, keypoints, and the map with its observations."""
    seen = export_cases.observe(result)
    (tmp_path / "images").mkdir()
    red = np.full((HEIGHT, WIDTH, 3), (0, 0, 250), np.uint8)
    t = len(result.timestamps)
    for k in range(t):
        cv2.imwrite(str(tmp_path / "images" / f"{k:03d}.png"), red)
    uv = np.full((2, t, 25, 2), 100.0)
    sequence = Sequence(
        name="made",
        frames=tmp_path / "images",
        timestamps=result.timestamps,
        intrinsics=Intrinsics(result.intrinsics, WIDTH, HEIGHT),
        keypoints=Keypoints(uv, np.ones((2, t, 25))),
    )
    num = len(result.landmarks)
    cameras = SfmResult(
        kind="moving",
        T_WC=result.T_WC,
        registered=np.ones(t, bool),
        landmarks=result.landmarks,
        tracks=Tracks(seen.frame, seen.landmark, seen.uv),
        keep=np.ones(len(seen.frame), bool),
        prior_information=np.zeros((num, 3, 3)),
        prior_mean=result.landmarks,
        pixel_sigma=0.3,
        intrinsics=result.intrinsics,
        focal_sigma=float("nan"),
        costs=(2.0, 1.0),
        warnings=(),
    )
    return sequence, cameras


def _write(folder, measured, result, body, config):
    folder.mkdir()
    sequence, cameras = measured
    watch = Stopwatch()
    args = (sequence, cameras, result, body, config, watch)
    return run_folder.write_pictures(folder, *args), watch.seconds


def _frame(path):
    return cv2.VideoCapture(str(path)).read()[1]


def test_overlay_scene_and_still(tmp_path, measured, result, body):
    still, seconds = _write(tmp_path / "run", measured, result, body, Config())
    assert set(seconds) == {"overlay", "scene"}
    image = cv2.imdecode(np.frombuffer(still, np.uint8), cv2.IMREAD_COLOR)
    assert image.shape == (HEIGHT, WIDTH, 3)
    # These people come into every corner, so that the insets are beside the image.
    height, width, _ = _frame(tmp_path / "run" / "overlay.webm").shape
    assert height == HEIGHT and width > WIDTH
    (run,) = view.read_runs(tmp_path / "run" / "scene.html")
    assert run["images"]["frame"] == list(range(len(result.timestamps)))
    assert run["map"]["colors"]["shape"] == [len(result.landmarks), 3]


def test_measurements_are_drawn_on_request(tmp_path, measured, result, body):
    plain, shown = Config(), Config(overlay_measurements=True)
    _write(tmp_path / "plain", measured, result, body, plain)
    _write(tmp_path / "shown", measured, result, body, shown)
    frames = [_frame(tmp_path / n / "overlay.webm") for n in ("plain", "shown")]
    at_keypoints = np.s_[98:103, 98:103]
    assert frames[1][at_keypoints].mean() > frames[0][at_keypoints].mean() + 50


def test_without_overlay_or_video_the_scene_is_written(
    tmp_path, measured, result, body
):
    config = Config(overlay=False)
    still, seconds = _write(tmp_path / "run", measured, result, body, config)
    assert still is not None and set(seconds) == {"images", "scene"}
    assert not list((tmp_path / "run").glob("overlay.*"))
    sequence, cameras = measured
    blind = dataclasses.replace(sequence, frames=None)
    still, seconds = _write(tmp_path / "blind", (blind, cameras), result, body, config)
    assert still is None and (tmp_path / "blind" / "scene.html").exists()


def test_h264_is_checked_for_before_anything_is_computed(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    run_folder.check_overlay(Config(overlay_video="mp4", overlay=False))
    run_folder.check_overlay(Config())
    with pytest.raises(ValueError, match="PyAV is not installed"):
        run_folder.check_overlay(Config(overlay_video="mp4"))
