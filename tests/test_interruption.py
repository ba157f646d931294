"""A run that is interrupted anywhere, and finished by the same command."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from test_frontend_motion import plane_images
from test_people_detect import constant_network, raw_output

from bodyslam_jax import cli, io, people, pipeline, sfm
from bodyslam_jax.cli import interrupts
from bodyslam_jax.config import Config
from bodyslam_jax.pipeline import people_stage
from bodyslam_jax.pipeline.stage_cache import Cache

NUM = 8


@pytest.fixture
def sequence(tmp_path) -> Path:
    """A camera on a tripod before a textured wall, and somebody's keypoints."""
    folder = tmp_path / "tripod"
    (folder / "images").mkdir(parents=True)
    (folder / "keypoints").mkdir()
    image = plane_images(1)[0]
    points = np.random.default_rng(0).uniform([140, 60, 1], [180, 200, 1], (25, 3))
    text = json.dumps({"people": [{"pose_keypoints_2d": points.ravel().tolist()}]})
    for k in range(NUM):
        cv2.imwrite(str(folder / "images" / f"{k:03d}.png"), image)
        (folder / "keypoints" / f"a_{k:012d}_keypoints.json").write_text(text)
    return folder


def test_stages_that_were_done_are_not_done_again(
    sequence, command, monkeypatch, tmp_path, caplog
):
    """Stopped while people are fitted; then tracks and cameras are there already."""

    def interrupt(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(people, "estimate_bodies", interrupt)
    out = tmp_path / "run"
    code, said = command("run", sequence, "--out", out)
    assert code == 130 and "the same command continues it" in said
    assert [p.name for p in out.iterdir()] == [".cache"]

    def tracked_again(*args, **kwargs):
        raise AssertionError("tracked again")

    monkeypatch.setattr(sfm, "track", tracked_again)
    monkeypatch.setattr(sfm, "reconstruct", tracked_again)
    caplog.set_level("INFO")
    code, _ = command("run", sequence, "--out", out)
    assert code == 130
    assert "tracks: taken from an earlier run" in caplog.text
    assert "cameras: taken from an earlier run" in caplog.text
    # Other settings of tracking are another stage; other settings of people are not.
    code, said = command("run", sequence, "--out", out, "--tracking.num-points", "99")
    assert code == 70 and "tracked again" in said
    code, _ = command("run", sequence, "--out", out, "--people-fit.max-gap", "0.2")
    assert code == 130


@pytest.fixture
def heard():
    """Ctrl-C raises, also where a shell without a terminal started the tests."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("heard")
def test_an_interrupt_waits_until_jax_is_loaded():
    reached = False
    with pytest.raises(KeyboardInterrupt), interrupts.deferred():
        signal.raise_signal(signal.SIGINT)
        reached = True
    assert reached
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_an_interrupt_that_became_another_error_is_an_interrupt(
    sequence, command, monkeypatch, tmp_path
):
    """As where it hits the import of a compiled module, which then fails in its way."""

    def broken(*args, **kwargs):
        raise SystemError("initialization failed")

    monkeypatch.setattr(sfm, "track", broken)
    assert command("run", sequence, "--out", tmp_path / "run")[0] == 70
    monkeypatch.setattr(interrupts, "arrived", lambda: True)
    code, said = command("run", sequence, "--out", tmp_path / "run")
    assert code == 130 and "the same command continues it" in said


STUBBORN = """
import time
from bodyslam_jax.cli import interrupts
interrupts.install()
while True:
    try:
        print("ready", flush=True)
        time.sleep(60)
    except KeyboardInterrupt:
        pass  # as compiled code and callbacks of the garbage collector do
"""


@pytest.mark.usefixtures("heard")
@pytest.mark.skipif(os.name == "nt", reason="signals are POSIX's")
def test_an_interrupt_that_is_not_noticed_ends_the_process_all_the_same():
    process = subprocess.Popen(
        [sys.executable, "-c", STUBBORN], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert process.stdout is not None and process.stdout.readline() == b"ready\n"
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=30)
    assert process.returncode == 130
    assert said.decode() == "bodyslam: interrupted; the same command continues it\n"


def test_a_stage_that_is_interrupted_while_it_is_written_is_done_again(tmp_path):
    cache = Cache(tmp_path, {"name": "a"})
    kind = people_stage.Detections
    value = kind(np.array([1, 0, 2]), np.ones((3, 25, 3)))
    cache.stage("detection", "k", kind, lambda: value)
    (file,) = tmp_path.glob("*.npz")
    file.write_bytes(file.read_bytes()[:100])  # as after a crash of the machine
    again = cache.stage("detection", "k", kind, lambda: value)
    np.testing.assert_array_equal(again.points, value.points)
    found = cache.stage("detection", "k", kind, lambda: pytest.fail("computed again"))
    assert [len(p) for p in found.by_frame()] == [1, 0, 2]
    assert cache.owner() == {"name": "a"}


def test_people_are_detected_where_nobody_gave_keypoints(
    sequence, tmp_path, monkeypatch
):
    """YOLOX and RTMPose that always say the same; found once, then kept."""
    raw = raw_output((40, 32, 20, 40, 0.9, 8))[None]
    x, y = np.zeros((1, 26, 96), np.float32), np.zeros((1, 26, 128), np.float32)
    joint = np.arange(26)
    x[0, joint, 30 + joint], y[0, joint, 4 * joint] = 0.7, 0.8
    (tmp_path / "box.onnx").write_bytes(
        constant_network((1, 3, 64, 96), {"output": raw})
    )
    (tmp_path / "pose.onnx").write_bytes(
        constant_network((1, 3, 64, 48), {"simcc_x": x, "simcc_y": y})
    )
    for file in (sequence / "keypoints").iterdir():
        file.unlink()
    (sequence / "keypoints").rmdir()
    seen = []

    def stop(found, *args):
        seen.append(found)
        raise KeyboardInterrupt

    monkeypatch.setattr(sfm, "track", stop)
    config = cli.read_settings(_settings(tmp_path), Config())
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            pipeline.run(
                io.read_sequence(sequence), config, cache=Cache(tmp_path / "c")
            )
        monkeypatch.setattr(people, "detect_people", lambda *a, **k: pytest.fail("!"))
    for found in seen:
        assert found.keypoints.uv.shape == (1, NUM, 25, 2)
        # The image is 320 by 240, the canvas 96 by 64: the person's box is 75 by 150
        # px around (150, 120), and 1.25 of that over the 64 rows of the crop.
        step = 1.25 * 150 / 64
        wanted = [150 - 24 * step + 15 * step, 120 - 32 * step]  # bins are half pixels
        np.testing.assert_allclose(found.keypoints.uv[0, 3, 0], wanted, atol=0.5)


def _settings(folder: Path) -> Path:
    path = folder / "settings.yaml"
    lines = [f"  {n}: {folder / f}" for n, f in NETWORKS]
    path.write_text("\n".join(["detect: yolox", "offline: true", "detection:", *lines]))
    return path


NETWORKS = (("detector", "box.onnx"), ("pose", "pose.onnx"))


@pytest.mark.usefixtures("heard")
@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="signals are POSIX's")
def test_signals_at_any_moment(sequence, tmp_path):
    """Ctrl-C after ever longer waits; what is left never looks finished until it is."""
    out = tmp_path / "run"
    argv = [sys.executable, "-m", "bodyslam_jax", "run", str(sequence)]
    argv += ["--out", str(out), "--no-uncertainty"]
    env = os.environ | {"PYTHONFAULTHANDLER": "1"}
    codes, told = [], []
    for wait in (3, 12, 30, 80, 600):
        process = subprocess.Popen(argv, stderr=subprocess.PIPE, text=True, env=env)
        try:
            process.wait(wait)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGINT)
        said = process.communicate(timeout=120)[1]
        codes.append(process.returncode)
        told.append(said)
        assert "Traceback" not in said and "Fatal" not in said, said
        # It is moved there whole: Ctrl-C may come while that is told, or just after.
        if (out / "summary.json").exists():
            break
        time.sleep(0.1)
    assert set(codes) <= {0, 3, 130, -signal.SIGINT}, (codes, told)
    assert not {0, 3} & set(codes[:-1]), (codes, told)
    assert (out / "report.html").exists()
    written = json.loads((out / "summary.json").read_text())
    assert written["camera_motion"] == "static" and (out / "result.npz").exists()
