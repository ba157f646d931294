"""Folders of simulated sequences: the readers find in them what was simulated."""

import dataclasses
import itertools
import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from bodyslam_jax import simulation
from bodyslam_jax.body import load_body_model
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.evaluation import read_groundtruth
from bodyslam_jax.io import read_sequence
from bodyslam_jax.io.bodies.reader import read_bodies

SETTINGS = simulation.Simulation(sequence="M2", length=40, seed=3)


@pytest.fixture(scope="module")
def simulated():
    return simulation.simulate(SETTINGS)


@pytest.fixture(scope="module")
def folder(simulated, tmp_path_factory):
    return simulation.write_sequence(tmp_path_factory.mktemp("a") / "m2", simulated)


def test_readers_find_what_was_simulated(simulated, folder):
    found, wanted = read_sequence(folder), simulation.as_sequence(simulated)
    assert found.warnings == ()
    np.testing.assert_allclose(found.timestamps, wanted.timestamps, atol=1e-9)
    np.testing.assert_array_equal(found.intrinsics.params, wanted.intrinsics.params)
    assert not found.intrinsics.is_guess
    np.testing.assert_array_equal(found.bodies.present, wanted.bodies.present)
    for name in ("poses", "shapes", "trans"):
        got, true = getattr(found.bodies, name), getattr(wanted.bodies, name)
        np.testing.assert_allclose(got, true, atol=1e-12)
    # Keypoint files have three decimals
    np.testing.assert_allclose(found.keypoints.uv, wanted.keypoints.uv, atol=6e-4)
    np.testing.assert_array_equal(
        found.keypoints.confidence > 0, wanted.keypoints.confidence > 5e-4
    )
    np.testing.assert_array_equal(found.tracks.frame, wanted.tracks.frame)
    np.testing.assert_allclose(found.tracks.uv, wanted.tracks.uv, atol=1e-4)


def test_truth_of_the_folder_is_the_truth(simulated, folder):
    found = read_groundtruth(folder, load_body_model())
    wanted = simulation.as_truth(simulated)
    np.testing.assert_allclose(found.T_WC, wanted.T_WC, atol=1e-7)  # nine decimals
    for name in ("poses", "trans", "betas", "joints", "landmarks", "present"):
        np.testing.assert_allclose(
            getattr(found, name), getattr(wanted, name), atol=1e-12
        )


def test_weak_perspective_says_the_same(simulated, folder):
    intrinsics = simulation.as_sequence(simulated).intrinsics
    read = lambda name: read_bodies(folder / name, num_frames=40, intrinsics=intrinsics)
    full, weak = read("bodies.npz"), read("bodies_weak_perspective.npz")
    np.testing.assert_array_equal(full.present, weak.present)
    np.testing.assert_allclose(full.trans, weak.trans, atol=1e-6)
    np.testing.assert_allclose(full.poses, weak.poses, atol=1e-9)


@pytest.mark.parametrize(
    ("noise", "regressed"), [("none", False), ("low", True), ("real", True)]
)
def test_true_bodies_are_not_said_to_be_regressed(
    simulated, tmp_path, noise, regressed
):
    settings = dataclasses.replace(SETTINGS, noise="real", body_noise=noise)
    true = dataclasses.replace(simulated, settings=settings)
    assert simulation.as_sequence(true).bodies.shapes_regressed is regressed
    folder = simulation.write_sequence(tmp_path / "true", true)
    assert read_sequence(folder).bodies.shapes_regressed is regressed


def test_folder_is_written_whole_and_over_nothing_else(simulated, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("x")
    with pytest.raises(ValueError, match="not empty"):
        simulation.write_sequence(tmp_path / "mine", simulated)
    (tmp_path / "file").write_text("x")
    with pytest.raises(ValueError, match="a file"):
        simulation.write_sequence(tmp_path / "file", simulated)
    with pytest.raises(ValueError, match="cannot be written"):
        simulation.write_sequence(tmp_path / "file" / "below", simulated)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "mine"]
    out = simulation.write_sequence(tmp_path / "out", simulated)
    (out / "tracks.npz").unlink()
    assert simulation.write_sequence(out, simulated, tracks=False) == out
    assert not (out / "tracks.npz").exists()
    assert json.loads((out / "simulation.json").read_text())["seed"] == 3


def test_a_write_that_fails_leaves_nothing(simulated, tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("numpy.savez_compressed", full)
    with pytest.raises(ValueError, match="No space left"):
        simulation.write_sequence(tmp_path / "out", simulated)
    assert not list(tmp_path.iterdir())


def _files(folder):
    return {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()}


def test_what_no_simulation_wrote_is_kept(simulated, tmp_path):
    """A run, notes and images; but not the longer and rendered simulation before."""
    out = simulation.write_sequence(tmp_path / "out", simulated)
    new = _files(out)
    mark = json.loads((out / "simulation.json").read_text())
    (out / "simulation.json").write_text(json.dumps(mark | {"render": True}))
    old = {"video.mp4", "keypoints/D1-follow_000000000099_keypoints.json"}
    theirs = {"run/notes.txt", "images/0.png", "keypoints/a.txt", "groundtruth/a.txt"}
    for name in old | theirs:
        (out / name).parent.mkdir(exist_ok=True)
        (out / name).write_text("mine")
    simulation.write_sequence(out, simulated)
    assert _files(out) == new | theirs
    assert all((out / name).read_text() == "mine" for name in theirs)
    # Nor a video or keypoints that are somebody's, by name or behind a link
    (out / "video.mp4").write_text("mine")
    (out / "keypoints").rename(tmp_path / "keypoints")
    (out / "keypoints").symlink_to(tmp_path / "keypoints")
    before = _files(tmp_path / "keypoints")
    simulation.write_sequence(out, simulated)
    assert (out / "video.mp4").read_text() == "mine"
    assert _files(tmp_path / "keypoints") == before and len(before) == 41
    settings = dataclasses.replace(SETTINGS, render=True)
    with pytest.raises(ValueError, match="has video.mp4, which no simulation wrote"):
        simulation.check_folder(out, settings)


@pytest.mark.parametrize("moved", [0, 1, 5, 20, 46])
@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError(28, "No space left")])
def test_interrupted_writing_is_no_sequence_and_is_finished(
    simulated, tmp_path, monkeypatch, moved, error
):
    out = simulation.write_sequence(tmp_path / "out", simulated)
    whole, replace, num = _files(out), os.replace, 0
    (out / "mine.txt").write_text("x")

    def interrupted(*args):
        nonlocal num
        num += ".simulation-" not in str(args[1])  # not within the hidden folder
        if num > moved + 1:  # the mark is the first
            raise error
        replace(*args)

    monkeypatch.setattr("os.replace", interrupted)
    with pytest.raises((KeyboardInterrupt, ValueError)):
        simulation.write_sequence(out, simulated)
    monkeypatch.undo()
    with pytest.raises(InputError):
        read_sequence(out)
    assert "unfinished" in json.loads((out / "simulation.json").read_text())
    assert not list(out.glob(".*"))
    (out / ".simulation-abcd1234").mkdir()  # as `kill -9` leaves it
    simulation.write_sequence(out, simulated)
    assert _files(out) == whole | {"mine.txt"} and not list(out.glob(".*"))


def test_killed_before_the_first_file(simulated, tmp_path):
    (tmp_path / "out" / ".simulation-abcd1234").mkdir(parents=True)
    simulation.write_sequence(tmp_path / "out", simulated)
    assert not list((tmp_path / "out").glob(".*"))


def test_a_link_to_a_folder_is_written_through(simulated, tmp_path):
    (tmp_path / "link").symlink_to(tmp_path / "real")
    for _ in range(2):
        assert simulation.write_sequence(tmp_path / "link", simulated).is_symlink()
    assert (tmp_path / "real" / "camera.json").exists()


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["--length", "0"], "length 0: a sequence needs 2"),
        (["--seed", "-3"], "seed -3: expected 0 or more"),
        (["--detector-bias", "nan"], "bias nan: expected a finite"),
        (["--detector-bias", "inf"], "bias inf: expected a finite"),
        (["--motion", "bad.npz"], "bad.npz: no motion, but a; expected"),
    ],
)
def test_a_refused_option_is_named_and_leaves_nothing(
    argv, message, tmp_path, monkeypatch, command
):
    monkeypatch.chdir(tmp_path)
    np.savez("bad.npz", a=np.zeros(3))
    code, text = command("simulate", "new/out", *argv)
    assert code == 1 and message in text and len(text.strip().splitlines()) == 1
    assert list(Path().iterdir()) == [Path("bad.npz")]


def test_video_shows_the_person_where_the_truth_is(simulated):
    """Where the camera stands still, all that changes is the walker."""
    still = np.repeat(simulated.T_WC[:1], 40, axis=0)
    film = simulation.render(dataclasses.replace(simulated, T_WC=still))
    frames = list(itertools.islice(film, 2))
    change = abs(frames[1].astype(float) - frames[0]).max(axis=2) > 25
    change = cv2.erode(change.astype(np.uint8), np.ones((2, 2), np.uint8)) > 0
    T = simulated.T_WC[0]
    p = (simulated.joints[0] - T[:3, 3]) @ T[:3, :3]
    uv = p[:, :2] / p[:, 2:] * simulated.intrinsics[:2] + simulated.intrinsics[2:]
    rows, columns = np.nonzero(change)
    assert len(rows) > 50
    margin = 0.35 * np.ptp(uv[:, 1])  # the shadow beside the feet is the farthest
    for found, place in ((columns, uv[:, 0]), (rows, uv[:, 1])):
        assert found.min() > place.min() - margin
        assert found.max() < place.max() + margin


@pytest.mark.slow
def test_demo_scene_is_a_sequence_with_a_video(tmp_path):
    folder = simulation.demo_scene(tmp_path / "demo")
    sequence = read_sequence(folder)
    assert sequence.frames == folder / "video.mp4"
    assert sequence.tracks is None
    assert 90 <= sequence.num_frames <= 120
    before = (folder / "video.mp4").stat().st_mtime_ns
    simulation.demo_scene(folder)
    assert (folder / "video.mp4").stat().st_mtime_ns == before
    assert simulation.demo_scene(folder, seed=1) == folder
    assert (folder / "video.mp4").stat().st_mtime_ns != before


def test_two_people_are_written_and_read(tmp_path):
    two = simulation.simulate(dataclasses.replace(SETTINGS, people=2, noise="low"))
    folder = simulation.write_sequence(tmp_path / "two", two)
    truth = read_groundtruth(folder, load_body_model())
    np.testing.assert_allclose(
        truth.joints, simulation.as_truth(two).joints, atol=1e-12
    )
    found = read_sequence(folder)
    assert found.bodies.present.shape == (2, 40)
    people = [
        json.loads(p.read_text())["people"] for p in (folder / "keypoints").iterdir()
    ]
    assert max(map(len, people)) == 2
    # and one person again leaves none of the second
    simulation.write_sequence(folder, simulation.simulate(SETTINGS))
    assert len(read_groundtruth(folder, load_body_model()).joints) == 1


@pytest.mark.slow
def test_the_same_seed_gives_the_same_film_and_another_another():
    settings = dataclasses.replace(SETTINGS, length=3, people=2)
    film = lambda s: np.stack(list(simulation.render(simulation.simulate(s))))
    first = film(settings)
    np.testing.assert_array_equal(first, film(settings))
    other = film(dataclasses.replace(settings, seed=4))
    assert abs(first.astype(int) - other).mean() > 5


@pytest.mark.slow
def test_a_film_has_no_measurements_and_is_kept(simulated, tmp_path):
    short = simulation.simulate(dataclasses.replace(SETTINGS, length=3))
    measured = simulation.write_sequence(tmp_path / "a", short)
    assert read_sequence(measured).keypoints is not None
    folder = simulation.film_scene(tmp_path / "a", short)  # replaces what was measured
    sequence = read_sequence(folder)
    assert sequence.keypoints is None and sequence.bodies is None
    assert sequence.tracks is None and sequence.num_frames == 3
    assert not (folder / "keypoints").exists()
    before = (folder / "video.mp4").stat().st_mtime_ns
    simulation.film_scene(folder, short)
    assert (folder / "video.mp4").stat().st_mtime_ns == before
