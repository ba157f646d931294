"""What is around a run: one at a time, into any folder, and only its own words."""

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from bodyslam_jax import export, pipeline
from bodyslam_jax.config import Config
from bodyslam_jax.export import lock
from bodyslam_jax.io import read_sequence
from bodyslam_jax.pipeline import run_folder
from bodyslam_jax.pipeline.stage_cache import fingerprint

HOLD = """
import importlib.util, sys, time
from pathlib import Path
spec = importlib.util.spec_from_file_location("lock", sys.argv[2])  # not all of JAX
lock = importlib.util.module_from_spec(spec)
spec.loader.exec_module(lock)
with lock.locked(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


@pytest.fixture
def holder(tmp_path):
    """Another process that holds the folder."""
    started = []

    def hold(folder: Path) -> subprocess.Popen:
        process = subprocess.Popen(
            [sys.executable, "-c", HOLD, str(folder), lock.__file__],
            stdout=subprocess.PIPE,
            text=True,
        )
        started.append(process)
        assert process.stdout is not None and process.stdout.readline() == "held\n"
        return process

    yield hold
    for process in started:
        process.kill()
        process.wait()
        if process.stdout is not None:
            process.stdout.close()


def test_a_folder_is_held_once_and_left_clean(tmp_path):
    folder = tmp_path / "deep" / "run"
    with export.locked(folder):
        owner = json.loads((folder / ".lock").read_text())
        assert owner == {"host": socket.gethostname(), "pid": os.getpid()}
        with pytest.raises(ValueError, match=f"run: process {os.getpid()} on "):
            with export.locked(folder):
                pass
    assert not folder.exists()
    folder.mkdir()
    (folder / "result").touch()
    with pytest.raises(RuntimeError), export.locked(folder):
        raise RuntimeError
    assert [p.name for p in folder.iterdir()] == ["result"]


def test_the_lock_of_a_killed_process_is_taken_over(tmp_path, holder):
    process = holder(tmp_path / "run")
    with pytest.raises(ValueError, match=f"process {process.pid} on .* is writing"):
        with export.locked(tmp_path / "run"):
            pass
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert (tmp_path / "run" / ".lock").exists()
    with export.locked(tmp_path / "run"):
        pass
    assert not (tmp_path / "run" / ".lock").exists()


@pytest.mark.parametrize("shift", [-3600, 0, 3600 * 24 * 365])
def test_another_machine_holds_as_long_as_its_file_changes(
    tmp_path, monkeypatch, shift
):
    """Where the file system does not pass locks on; whatever its clock says."""
    monkeypatch.setattr(lock, "STALE_AFTER_S", 0.3)
    file = tmp_path / ".lock"
    file.write_text(json.dumps({"host": "node17", "pid": 4}))
    date = time.time() + shift
    os.utime(file, (date, date))
    done = threading.Event()

    def touch():
        for k in range(1000):
            if done.wait(0.05):
                return
            os.utime(file, (date + k, date + k))

    holder = threading.Thread(target=touch)
    holder.start()
    try:
        message = "process 4 on node17 is writing this run"
        with pytest.raises(ValueError, match=message), export.locked(tmp_path):
            pass
    finally:
        done.set()
        holder.join()
    os.utime(file, (date, date))
    with export.locked(tmp_path):  # it is no more
        assert json.loads(file.read_text())["pid"] == os.getpid()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "content",
    [
        "half",  # of a process that was killed as it wrote
        "[" * 4000,
        '{"host": ["a"], "pid": {}}',
        '{"host": "line\\nline\\u001b[2J", "pid": 1e400}',
        '{"pid": 9999999999999999999999}',
        "\x00" * 10000,
        "[]",
    ],
)
def test_a_lock_that_names_nobody_holds_nothing(tmp_path, monkeypatch, content, caplog):
    monkeypatch.setattr(lock, "STALE_AFTER_S", 0.05)
    (tmp_path / ".lock").write_text(content)
    with caplog.at_level("INFO"), export.locked(tmp_path):
        pass
    assert all(len(one.message.splitlines()) == 1 for one in caplog.records)
    assert "\x1b" not in caplog.text
    assert list(tmp_path.iterdir()) == []


def test_a_lock_that_leads_elsewhere_is_not_followed(tmp_path):
    run, other = tmp_path / "run", tmp_path / "precious"
    run.mkdir()
    other.write_text("kept")
    (run / ".lock").symlink_to(other)
    with pytest.raises(ValueError, match="lock: not a file"), export.locked(run):
        pass
    (run / ".lock").unlink()
    (run / ".lock").mkdir()
    with pytest.raises(ValueError, match="lock: not a file"), export.locked(run):
        pass
    (run / ".lock").rmdir()
    os.mkfifo(run / ".lock")
    with pytest.raises(ValueError, match="lock: not a file"), export.locked(run):
        pass
    assert other.read_text() == "kept"


def test_a_lock_is_renewed(tmp_path, monkeypatch):
    monkeypatch.setattr(lock, "RENEWAL_PERIOD_S", 0.01)
    with export.locked(tmp_path):
        file = tmp_path / ".lock"
        os.utime(file, (0, 0))
        for _ in range(500):
            if file.stat().st_mtime > 0:
                break
            time.sleep(0.01)
        assert file.stat().st_mtime > 0


@pytest.fixture
def sequence(tmp_path) -> Path:
    folder = tmp_path / "walk"
    (folder / "keypoints").mkdir(parents=True)
    image = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)
    person = np.random.default_rng(0).uniform([20, 10, 1], [40, 40, 1], (25, 3))
    text = json.dumps({"people": [{"pose_keypoints_2d": person.ravel().tolist()}]})
    for k in range(8):
        cv2.imwrite(str(folder / f"{k:03d}.png"), image)
        (folder / "keypoints" / f"a_{k:012d}_keypoints.json").write_text(text)
    return folder


def reached(*args, **kwargs):
    raise AssertionError("computed")


@pytest.mark.parametrize("what", ["run", "demo"])
def test_a_second_run_into_a_folder_says_so_and_leaves(
    what, sequence, command, holder, monkeypatch, tmp_path
):
    process = holder(tmp_path / "out")
    monkeypatch.setattr(run_folder, "run_stages", reached)
    argv = ["run", sequence] if what == "run" else ["demo"]
    code, err = command(*argv, "--out", tmp_path / "out")
    assert code == 1
    line = err.strip().splitlines()[-1]
    assert f"out: process {process.pid} on {socket.gethostname()}" in line


def test_nobody_and_no_way_to_find_anybody_is_said_at_once(
    sequence, command, monkeypatch, tmp_path
):
    monkeypatch.setattr(run_folder, "run_stages", reached)
    for file in (sequence / "keypoints").iterdir():
        file.unlink()
    (sequence / "keypoints").rmdir()
    for file in sequence.glob("*.png"):
        file.unlink()
    camera = {"model": "PINHOLE", "width": 64, "height": 48, "params": [80, 80, 31, 23]}
    (sequence / "camera.json").write_text(json.dumps(camera))
    frame, landmark = (a.ravel() for a in np.mgrid[:8, :20])
    uv = np.random.default_rng(0).uniform(5, 40, (len(frame), 2))
    np.savez(sequence / "tracks.npz", frame=frame, landmark=landmark, uv=uv)
    code, err = command("run", sequence, "--out", tmp_path / "out")
    assert code == 1 and "neither keypoints nor bodies" in err.splitlines()[-1]
    assert not (tmp_path / "out").exists()
    code, err = command("run", sequence, "--out", tmp_path / "out", "--no-people")
    assert code == 70 and "computed" in err


@pytest.mark.parametrize("inside", [".", "run", "keypoints/run"])
def test_a_run_written_into_its_input_is_not_read_as_input(sequence, inside):
    before = read_sequence(sequence)
    key = fingerprint(before)
    out = sequence / inside
    (out / ".cache").mkdir(parents=True)
    for name in ("overlay.webm", "report.html", "summary.json", "body_0.npz"):
        (out / name).write_text("{}")
    again = read_sequence(sequence)
    assert again.frames == before.frames and again.num_frames == 8
    assert again.warnings == before.warnings
    if inside != ".":
        assert fingerprint(again) == key


def test_reading_leaves_the_input_as_it_is(sequence):
    """As it must where the folder cannot be written."""
    state = lambda: {
        p: (p.stat().st_mtime_ns, p.stat().st_size)
        for p in [sequence, *sequence.rglob("*")]
    }
    before = state()
    read_sequence(sequence)
    assert state() == before


@pytest.mark.parametrize(
    "name", ["00001.MTS", "clip.m2ts", "clip.TS", "clip.3gp", "clip.wmv", "clip.GIF"]
)
def test_a_camcorders_video_is_found_in_its_folder(tmp_path, name):
    codec = cv2.VideoWriter.fourcc(*"MJPG")
    plain = tmp_path / "plain.avi"
    writer = cv2.VideoWriter(str(plain), codec, 25, (64, 48))
    for k in range(4):
        writer.write(np.full((48, 64, 3), 40 * k, np.uint8))
    writer.release()
    folder = tmp_path / "walk"
    folder.mkdir()
    plain.rename(folder / name)
    assert read_sequence(folder).num_frames == 4
    (folder / name).rename(folder / "clip.xyz")
    with pytest.raises(ValueError, match=r"no video.mp4.*\.mts .*\.wmv"):
        read_sequence(folder)


@pytest.mark.slow
def test_alarms_of_slow_compilation_stay_off_the_terminal(tmp_path):
    """XLA's, which it prints of a constant that it takes more than a second to fold."""
    program = """
import sys
from unittest import mock
from bodyslam_jax import cli
def report():
    import jax, jax.numpy as jnp
    add = lambda x: jax.lax.reduce_window(x, 0.0, jax.lax.add, (9, 9), (1, 1), "SAME")
    jax.jit(lambda: add(jnp.ones((80, 80))).sum()).lower().compile()
    return [("compiled", "slowly")]
sys.argv = ["bodyslam", "doctor"]
with mock.patch.multiple(
    "bodyslam_jax.cli.environment", report=report, verdict=lambda rows: "none"
):
    cli.main()
"""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("TF_CPP")}
    environment |= {"BODYSLAM_CACHE": str(tmp_path), "JAX_PLATFORMS": "cpu"}
    quiet = subprocess.run(
        [sys.executable, "-c", program],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
        timeout=300,
    )
    assert quiet.stdout == "compiled  slowly\nverdict   none\n" and quiet.stderr == ""


def test_settings_do_not_matter_for_who_holds_a_folder(tmp_path, sequence, holder):
    """Also by the library, and for any input."""
    holder(tmp_path / "out")
    with pytest.raises(ValueError, match="is writing this run"):
        pipeline.run_to_folder(
            read_sequence(sequence), tmp_path / "out", Config(overlay=False)
        )
