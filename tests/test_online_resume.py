"""A long file that is estimated frame by frame, interrupted, and gone on with."""

import gzip
import os
import pickle
import signal
from pathlib import Path

import cv2
import numpy as np
import pytest

import bodyslam_jax as bs
from bodyslam_jax import io, pipeline, simulation
from bodyslam_jax.cli import live as cli_live
from bodyslam_jax.config import Config, Simulation
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.graph import validation
from bodyslam_jax.io.capture import Capture
from bodyslam_jax.online import checkpoint, online
from bodyslam_jax.online.loops import Correction
from bodyslam_jax.sfm.places import Place
from bodyslam_jax.sfm.pose_graph import Edge
from bodyslam_jax.types import Intrinsics, Result, Sequence

NUM, STOP = 24, 10
"""Frames of the clip, and frame after which it is interrupted."""
CAMERA = Intrinsics(np.array([60.0, 60.0, 31.5, 23.5]), 64, 48)
BARE = Config(people=False)


@pytest.fixture(scope="module")
def clip(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("resume") / "clip.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (64, 48))
    for k in range(NUM):
        writer.write(np.full((48, 64, 3), 10 * k, np.uint8))
    writer.release()
    return path


@pytest.mark.parametrize("passed", [0, 1, 20, NUM])
def test_a_file_is_read_on_from_any_image(clip, passed):
    capture = Capture(str(clip), every=True)
    capture.skip(passed)
    capture.start()
    found = []
    while (image := capture.newest(timeout=5.0)) is not None:
        found.append(image)
    capture.close()
    assert [image.index for image in found] == list(range(passed, NUM))
    assert [i.timestamp for i in found] == pytest.approx([i.index / 30 for i in found])
    levels = [int(np.median(i.image)) for i in found]
    assert levels == pytest.approx([10 * i.index for i in found], abs=3)


@pytest.fixture
def begun(monkeypatch) -> bs.Online:
    """An estimate after some frames, for which nothing had to be compiled."""
    monkeypatch.setattr(online, "compile_all", lambda *given, **rates: None)
    found = bs.Online(BARE, intrinsics=CAMERA, threads=False)
    rng = np.random.default_rng(0)
    points = np.arange(20), rng.uniform(5, 40, (20, 2))
    for k in range(STOP):
        found.update(None, k / 30, points=points)
    return found


def another() -> bs.Online:
    return bs.Online(BARE, intrinsics=CAMERA, threads=False)


def test_a_state_is_written_and_read(begun, tmp_path):
    path = tmp_path / "folder" / "a.state"
    checkpoint.save(begun, path)
    assert [p.name for p in path.parent.iterdir()] == ["a.state"]
    found = another()
    assert checkpoint.resume(found, path)
    assert found.counts == begun.counts and found.counts.frames == STOP
    assert [f.time for f in found.record.frames] == [k / 30 for k in range(STOP)]
    assert found.body is not begun.body and found.world is not begun.world
    late = found.update(None, 0.1, points=(np.zeros(0, int), np.zeros((0, 2))))
    assert late.status == "late"


def test_places_and_loops_are_in_a_state(begun, tmp_path):
    place = Place(np.full((2, 32), 7, np.uint8), np.ones((2, 3)))
    loops = begun.loops
    loops.add(place, 0.1, 3, np.eye(4), np.eye(4))
    loops.keyframes.append(loops.new[0])
    loops.edges.append(Edge(0, 1, np.eye(4), 0.1, np.eye(7), loop=True))
    half = np.array([0.5, 0.25])
    eye = np.tile(np.eye(3), (2, 1, 1))
    loops.correction = Correction(np.array([3, 9]), eye, np.zeros((2, 3)), half)
    checkpoint.save(begun, tmp_path / "a.state")
    found = another()
    assert checkpoint.resume(found, tmp_path / "a.state")
    assert found.loops.correction.unit == 0.25 and found.loops.edges[0].log_ratio == 0.1
    assert found.loops.keyframes[0] is found.loops.new[0]
    assert found.loops.places[0].descriptors.tolist() == place.descriptors.tolist()


def test_there_is_no_state_of_a_second_thread(tmp_path):
    path = tmp_path / "a.state"
    with pytest.raises(InputError, match="threads=False"):
        checkpoint.save(bs.Online(BARE, intrinsics=CAMERA), path)
    assert not path.exists()
    assert not checkpoint.resume(another(), path)


@pytest.mark.parametrize("damage", ["cut", "changed", "empty"])
def test_a_damaged_state_is_told_and_not_used(begun, tmp_path, caplog, damage):
    path = tmp_path / "a.state"
    checkpoint.save(begun, path)
    content = bytearray(path.read_bytes())
    if damage == "changed":  # A digit of a coordinate, say: no pickle tells that.
        at = content.index(begun.record.frames[0].since.tobytes())
        content[at + 6] ^= 1
    kept = {"cut": len(content) - 5, "changed": None, "empty": 0}[damage]
    path.write_bytes(content[:kept])
    found = another()
    assert not checkpoint.resume(found, path)
    assert found.counts.frames == 0
    assert "a.state: not readable" in caplog.text


class Calls:
    """What a pickle may ask for: a function and its arguments."""

    def __init__(self, function, *given) -> None:
        self.wanted = function, given

    def __reduce__(self):
        return self.wanted


def test_a_state_calls_nothing_but_what_makes_arrays(tmp_path, caplog):
    path, victim = tmp_path / "a.state", tmp_path / "victim"
    asked = [
        Calls(os.mkdir, str(victim)),
        Calls(eval, f"__import__('os').mkdir({str(victim)!r})"),
        Calls(Path.touch, victim),
        Calls(np.savetxt, str(victim), np.zeros(3)),
        Calls(bs.load_body_model, None),  # a function of this package
    ]
    for one in asked:
        with gzip.GzipFile(path, "wb") as file:
            pickle.dump({"name": one}, file)
        assert not checkpoint.resume(another(), path)
        assert "not of a state" in caplog.text
        caplog.clear()
    assert not victim.exists()


@pytest.fixture
def heard():
    """Ctrl-C is heard, also where a shell without a terminal started the tests."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("heard")
def test_the_command_goes_on_where_it_was_interrupted(
    clip, command, monkeypatch, tmp_path, caplog
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(online, "compile_all", lambda *given, **rates: None)
    update, used = bs.Online.update, []

    def interrupted(self, image, timestamp):
        used.append(round(30 * timestamp))
        if len(used) == STOP:
            signal.raise_signal(signal.SIGINT)
        return update(self, image, timestamp)

    monkeypatch.setattr(bs.Online, "update", interrupted)
    given = "live", clip, "--every-frame", "--no-page", "--no-people"
    code, said = command(*given)
    assert code == 130 and "the same command continues it" in said
    (state,) = (tmp_path / "runs" / "clip" / ".cache").iterdir()
    assert used == list(range(STOP))
    # Other settings begin at the first frame, in a folder of their own.
    caplog.set_level("INFO")
    used.clear()
    code, _ = command(*given, "--focal", "70")
    assert code == 130 and used == list(range(STOP))
    assert (tmp_path / "runs" / "clip-2").is_dir()
    frames = []

    def finish(self):
        frames.extend(self.record.frames)
        raise InputError("the end is not tested here")

    monkeypatch.setattr(bs.Online, "finish", finish)
    code, _ = command(*given)
    assert code not in (0, 130)
    assert used[STOP:] == list(range(STOP, NUM))
    assert f"goes on after frame {STOP}" in caplog.text
    assert [frame.time for frame in frames] == pytest.approx(np.arange(NUM) / 30)
    assert state.is_file()  # a run that has no result yet


@pytest.mark.parametrize("frames", [2999, 3000])
def test_a_long_video_is_told_what_it_takes(
    clip, command, monkeypatch, tmp_path, caplog, frames
):
    def refuse(*given):
        raise InputError("not computed here")

    long = Sequence("clip", None, np.arange(frames) / 30, CAMERA)
    monkeypatch.setattr(io, "read_sequence", lambda *given, **known: long)
    monkeypatch.setattr(pipeline, "run_to_folder", refuse)
    command("run", clip, "--out", tmp_path / "out")
    found = [line for line in caplog.messages if "GB of memory" in line]
    assert len(found) == (frames == 3000)
    assert all(f"live {clip} --every-frame" in line for line in found)


@pytest.mark.parametrize(
    "gigabytes, given, in_windows",
    [
        (2, (), True),
        (16, (), False),
        (2, ("--windows", "never"), False),
        (16, ("--windows", "always"), True),
        (2, ("--end", "20"), False),
        (2, ("--keypoints", "keypoints.npz"), False),
    ],
)
def test_a_video_beyond_memory_is_estimated_in_windows(
    clip, command, monkeypatch, tmp_path, gigabytes, given, in_windows
):
    done = []

    def whole(*given):
        done.append("whole")
        raise InputError("not computed here")

    def windows(source, *, out, page, every_frame, **shared):
        assert source == str(clip) and out == tmp_path / "out"
        assert every_frame and not page
        done.append("windows")
        return 0

    long = Sequence("clip", None, np.arange(3000) / 30, CAMERA)
    monkeypatch.setattr(io, "read_sequence", lambda *given, **known: long)
    monkeypatch.setattr(pipeline, "run_to_folder", whole)
    monkeypatch.setattr(cli_live, "live", windows)
    monkeypatch.setattr(validation, "memory", lambda: gigabytes * 10**9)
    command("run", clip, "--out", tmp_path / "out", *given)
    assert done == ["windows" if in_windows else "whole"]


def test_windows_are_for_a_video_alone(command, monkeypatch, tmp_path):
    given = Sequence("folder", None, np.arange(10) / 30, CAMERA)
    monkeypatch.setattr(io, "read_sequence", lambda *_, **known: given)
    code, said = command("run", tmp_path, "--windows", "always")
    assert code not in (0, 3) and "--windows always: found a folder" in said


# All of it.


def rows_of(sequence: Sequence):
    """Time, keypoints and points of each frame."""
    tracks, keypoints = sequence.tracks, sequence.keypoints
    assert tracks is not None and keypoints is not None
    for k, time in enumerate(sequence.timestamps):
        at = tracks.frame == k
        seen = keypoints.uv[:, k], keypoints.confidence[:, k, :, None]
        points = tracks.landmark[at], tracks.uv[at]
        yield float(time), np.concatenate(seen, axis=-1), points


@pytest.mark.slow
def test_an_interrupted_estimate_ends_as_one_that_was_not(tmp_path):
    """Exactly: the second one has its windows, filters and maps from the file, in the
    middle of a chunk."""
    made = simulation.simulate(Simulation(sequence="M2", family="follow", length=120))
    sequence, path = simulation.as_sequence(made), tmp_path / "a.state"
    given = {"intrinsics": sequence.intrinsics, "threads": False, "smooth": True}
    first, second = (bs.Online(**given) for _ in range(2))
    for k, (time, keypoints, points) in enumerate(rows_of(sequence)):
        if k == 95:
            checkpoint.save(first, path)
            assert checkpoint.resume(second, path)
            second.prepared = True  # The programs are in this process.
        a = first.update(None, time, keypoints, points=points)
        if k >= 95:
            b = second.update(None, time, keypoints, points=points)
            assert np.array_equal(a.T_WC, b.T_WC) and a.scale == b.scale
            assert np.array_equal(a.people[0].joints, b.people[0].joints)
    results: list[Result] = [one.finish() for one in (first, second)]
    for name in ("T_WC", "poses", "trans", "joints", "landmarks", "present", "scale"):
        a, b = (getattr(result, name) for result in results)
        assert np.array_equal(a, b), name
    assert first.record.frames[100].points is not None
