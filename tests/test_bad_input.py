"""Inputs that cannot be right: one clear line, the right exit code, nothing left over.

The command runs in this process, with solvers that must not be reached: what is wrong
with an input is said before anything is computed from it.
"""

import errno
import json
import os
import pickle
import re
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np
import pytest

from bodyslam_jax import people
from bodyslam_jax.pipeline import sfm_stage

NUM, WIDTH, HEIGHT = 8, 64, 48
CAMERA = {
    "model": "PINHOLE",
    "width": WIDTH,
    "height": HEIGHT,
    "params": [80.0, 80.0, 31.5, 23.5],
    "fps": 25.0,
}


def video(path: Path, num: int = NUM) -> Path:
    codec = cv2.VideoWriter.fourcc(*"mp4v")
    writer = cv2.VideoWriter(str(path), codec, 25, (WIDTH, HEIGHT))
    rng = np.random.default_rng(0)
    for _ in range(num):
        writer.write(rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8))
    writer.release()
    return path


def person(confidence: float = 0.9) -> list[float]:
    points = np.random.default_rng(0).uniform([20, 10, 0], [40, 40, 0], (25, 3))
    points[:, 2] = confidence
    return points.ravel().tolist()


def keypoints(folder: Path, people_of_frames: list[list[list[float]]]) -> Path:
    folder.mkdir(parents=True)
    for k, found in enumerate(people_of_frames):
        data = {"version": 1.3, "people": [{"pose_keypoints_2d": p} for p in found]}
        (folder / f"a_{k:012d}_keypoints.json").write_text(json.dumps(data))
    return folder


def bodies(num: int = NUM) -> dict[str, np.ndarray]:
    return {
        "frame": np.arange(num),
        "poses": np.zeros((num, 72)),
        "betas": np.zeros((num, 10)),
        "trans": np.tile([0.0, 0.0, 3.0], (num, 1)),
    }


def tracks() -> dict[str, np.ndarray]:
    frame, landmark = (a.ravel() for a in np.mgrid[:NUM, :20])
    uv = np.random.default_rng(0).uniform(5, 40, (len(frame), 2))
    return {"frame": frame, "landmark": landmark, "uv": uv}


class Exploit:
    """Runs a command where a pickle is loaded without care."""

    def __init__(self, mark: Path):
        self.mark = mark

    def __reduce__(self):
        return os.system, (f"touch {self.mark}",)


@pytest.fixture
def folder(tmp_path) -> Path:
    """A sequence folder in which all is well."""
    path = tmp_path / "sequence"
    path.mkdir()
    video(path / "video.mp4")
    keypoints(path / "keypoints", [[person()]] * NUM)
    (path / "camera.json").write_text(json.dumps(CAMERA))
    return path


@pytest.fixture
def command(command, monkeypatch):
    """`bodyslam`, which must refuse the input before anything is computed."""

    def reached(*args, **kwargs):
        raise AssertionError("computed from an input that is wrong")

    monkeypatch.setattr(people, "estimate_bodies", reached)
    monkeypatch.setattr(sfm_stage, "estimate", reached)
    return command


def rewrite(path: Path, **changes) -> None:
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


def save(path: Path, arrays: dict[str, np.ndarray], **changes) -> None:
    np.savez(path, **{**arrays, **changes})


def no_frames(folder: Path) -> None:
    data = video(folder / "video.mp4", 1).read_bytes()
    (folder / "video.mp4").write_bytes(data[: data.index(b"mdat")] + b"mdat")


def replace_keypoints(folder: Path, frames: list[list[list[float]]]) -> None:
    for file in (folder / "keypoints").iterdir():
        file.unlink()
    (folder / "keypoints").rmdir()
    keypoints(folder / "keypoints", frames)


def with_masks(folder: Path, count: int, size: tuple[int, int]) -> None:
    (folder / "masks").mkdir()
    for k in range(count):
        cv2.imwrite(str(folder / "masks" / f"{k}.png"), np.zeros(size, np.uint8))


def as_images(folder: Path) -> Path:
    (folder / "video.mp4").unlink()
    images = folder / "images"
    images.mkdir()
    for k in range(NUM):
        cv2.imwrite(str(images / f"{k:03d}.png"), np.zeros((HEIGHT, WIDTH), np.uint8))
    return images


def nan_bodies(folder: Path) -> None:
    poses = np.zeros((NUM, 72))
    poses[3:, 5] = np.nan
    save(folder / "bodies.npz", bodies(), poses=poses)


def nan_tracks(folder: Path) -> None:
    found = tracks()
    found["uv"][7:] = np.inf
    save(folder / "tracks.npz", found)


INPUTS = {
    "a text file as video": (
        lambda f: (f / "video.mp4").write_text("no video"),
        "video.mp4: not a video",
    ),
    "an empty file as video": (
        lambda f: (f / "video.mp4").write_bytes(b""),
        "video.mp4: not a video",
    ),
    "a video cut short": (
        lambda f: (f / "video.mp4").write_bytes(
            (f / "video.mp4").read_bytes()[:400],
        ),
        "video.mp4: not a video",
    ),
    "no frames": (no_frames, "video.mp4: (not a video|a video without)"),
    "one frame": (
        lambda f: (
            video(f / "video.mp4", 1),
            replace_keypoints(f, [[person()]]),
        ),
        "sequence: 1 frames, expected at least 3",
    ),
    "no video at all": (
        lambda f: (f / "video.mp4").unlink(),
        "no video.mp4, images/ or tracks.npz",
    ),
    "two videos": (
        lambda f: (
            video(f / "a.mp4"),
            (f / "video.mp4").rename(f / "b.avi"),
        ),
        "which video",
    ),
    "images of two sizes": (
        lambda f: cv2.imwrite(
            str(as_images(f) / "005.png"), np.zeros((10, 12), np.uint8)
        ),
        "005.png: 12x10 px, but the first image is 64x48",
    ),
    "a damaged image": (
        lambda f: (as_images(f) / "005.png").write_text("no image"),
        "005.png: not an image",
    ),
    "a folder without images": (
        lambda f: [p.unlink() for p in as_images(f).iterdir()],
        "images: no images",
    ),
    "no keypoint files": (
        lambda f: [p.unlink() for p in (f / "keypoints").iterdir()],
        "keypoints: no .*_keypoints.json",
    ),
    "keypoints of a longer video": (
        lambda f: replace_keypoints(f, [[person()]] * (NUM + 4)),
        "keypoints of frames 0 to 11, but the video has 8",
    ),
    "keypoints of a larger video": (
        lambda f: replace_keypoints(
            f, [[(10 * np.array(person())).tolist()]] * NUM
        ),
        "outside the image of 64x48 px: of another video",
    ),
    "all confidences zero": (
        lambda f: replace_keypoints(f, [[person(0.0)]] * NUM),
        "all confidences are zero",
    ),
    "a person in no frame": (
        lambda f: replace_keypoints(f, [[]] * NUM),
        "no person in any frame",
    ),
    "NaN in keypoints": (
        lambda f: replace_keypoints(f, [[[float("nan")] * 75]] * NUM),
        "keypoints with NaN",
    ),
    "half a keypoint": (
        lambda f: replace_keypoints(f, [[person()[:-1]]] * NUM),
        "not triples",
    ),
    "keypoints of a hand": (
        lambda f: replace_keypoints(f, [[person()[:63]]] * NUM),
        "21 keypoints a person",
    ),
    "keypoints of two videos": (
        lambda f: [
            (f / "keypoints" / f"b_{k:012d}_keypoints.json").write_text(
                '{"people": []}'
            )
            for k in range(NUM)
        ],
        "keypoints: a_0+_keypoints.json and b_0+_keypoints.json are both of frame 0",
    ),
    "images of a few pixels": (
        lambda f: [
            cv2.imwrite(str(p), np.zeros((4, 100), np.uint8))
            for p in as_images(f).iterdir()
        ] + [(f / "camera.json").unlink()],
        "images: images of 100x4 px are too small; expected at least 16x16",
    ),
    "broken JSON": (
        lambda f: next((f / "keypoints").iterdir()).write_text('{"people": ['),
        "_keypoints.json, line 1: not JSON",
    ),
    "JSON of something else": (
        lambda f: next((f / "keypoints").iterdir()).write_text('{"a": 1}'),
        "no list `people`",
    ),
    "too few intrinsics": (
        lambda f: rewrite(f / "camera.json", params=[80.0, 31.5, 23.5]),
        "camera.json: 3 params for PINHOLE, not 4",
    ),
    "an unknown camera model": (
        lambda f: rewrite(f / "camera.json", model="FISHEYE"),
        "camera.json: `model` is 'FISHEYE', expected PINHOLE or",
    ),
    "a negative focal length": (
        lambda f: rewrite(f / "camera.json", params=[-80.0, 80.0, 31.5, 23.5]),
        "camera.json: .* not those of a camera",
    ),
    "the camera of another video": (
        lambda f: rewrite(f / "camera.json", width=1280, height=720),
        "camera.json: for 1280x720 px, but video.mp4 has 64x48",
    ),
    "broken camera.json": (
        lambda f: (f / "camera.json").write_text("{"),
        "camera.json, line 1: not JSON",
    ),
    "NaN in bodies": (nan_bodies, "bodies.npz: .*poses"),
    "bodies between frames": (
        lambda f: save(f / "bodies.npz", bodies(), frame=np.arange(NUM) + 0.5),
        "bodies.npz: .*`frame` has 0.5 in it, expected whole numbers",
    ),
    "bodies of a longer video": (
        lambda f: save(f / "bodies.npz", bodies(NUM + 3)),
        "bodies.npz: .*frame.* 8",
    ),
    "bodies of another shape": (
        lambda f: save(f / "bodies.npz", bodies(), betas=np.zeros((NUM, 3))),
        "bodies.npz: .*betas",
    ),
    "a text file as bodies": (
        lambda f: (f / "bodies.npz").write_text("no archive"),
        "bodies.npz: ",
    ),
    "infinity in tracks": (nan_tracks, "tracks.npz: 153 of 160 observations not"),
    "tracks of a longer video": (
        lambda f: save(
            f / "tracks.npz", tracks(), frame=tracks()["frame"] + 5
        ),
        "tracks.npz: tracks up to frame 12, but the video has 8",
    ),
    "tracks without uv": (
        lambda f: np.savez(f / "tracks.npz", frame=np.arange(3)),
        "tracks.npz: no array landmark, uv",
    ),
    "tracks, but no video and no camera": (
        lambda f: (
            (f / "video.mp4").unlink(),
            (f / "camera.json").unlink(),
            save(f / "tracks.npz", tracks()),
        ),
        "need a camera.json",
    ),
    "masks of another video": (
        lambda f: with_masks(f, NUM - 1, (HEIGHT, WIDTH)),
        "masks: 7 masks, but the video has 8 frames",
    ),
    "masks of another size": (
        lambda f: with_masks(f, NUM, (HEIGHT // 2, WIDTH)),
        "0.png: 64x24 px, but the video is 64x48",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", INPUTS)
def test_what_is_wrong_with_an_input_is_said(case, folder, command, tmp_path):
    spoil, message = INPUTS[case]
    spoil(folder)
    out = tmp_path / "run"
    code, err = command("run", folder, "--out", out)
    assert code == 1, err
    line = err.strip().splitlines()[-1]
    assert line.startswith("bodyslam: ") and re.search(message, line), err
    assert "Traceback" not in err
    assert not out.exists(), list(out.rglob("*"))


OPTIONS = {
    "no such input": (["run", "none.mp4"], "none.mp4: no such file"),
    "no such keypoints": (["--keypoints", "none.json"], "none.json: no such file"),
    "no such bodies": (["--bodies", "none.pkl"], "none.pkl: no such file"),
    "no such tracks": (["--tracks", "none.npz"], "none.npz: no such file"),
    "no such camera": (["--camera", "none.json"], "none.json: "),
    "no such settings": (["--settings", "none.yaml"], "none.yaml: no such file"),
    "no such body model": (["--body-model", "none.pkl"], "tried none.pkl"),
    "no such motion model": (["--motion-model", "none.npz"], "none.npz: "),
}


@pytest.mark.parametrize("case", OPTIONS)
def test_a_file_that_is_not_there_is_named(case, folder, command, tmp_path):
    argv, message = OPTIONS[case]
    argv = argv if argv[0] == "run" else ["run", folder, *argv]
    out = tmp_path / "run"
    code, err = command(*argv, "--out", out)
    assert code == 1 and message in err.strip().splitlines()[-1], err
    assert not out.exists()


@pytest.mark.parametrize("option", ["--bodies", "--body-model"])
def test_a_pickle_is_never_run(option, folder, command, tmp_path):
    mark = tmp_path / "mark"
    (tmp_path / "evil.pkl").write_bytes(pickle.dumps({"poses": Exploit(mark)}))
    code, err = command(
        "run", folder, option, tmp_path / "evil.pkl", "--out", tmp_path / "run"
    )
    assert code == 1 and "evil.pkl" in err.strip().splitlines()[-1], err
    assert not mark.exists()


def test_a_file_in_the_place_of_the_run_folder(folder, command, tmp_path):
    out = tmp_path / "run"
    out.write_text("mine")
    code, err = command("run", folder, "--out", out)
    assert code == 1 and "run: cannot be written" in err
    code, err = command("run", folder, "--out", out / "deeper")
    assert code == 1 and "cannot be written" in err
    assert out.read_text() == "mine"


def test_a_folder_of_something_else_is_left_alone(folder, command, tmp_path):
    out = tmp_path / "project"
    out.mkdir()
    (out / "config.yaml").write_text("mine: true")
    code, err = command("run", folder, "--out", out)
    assert code == 1 and "config.yaml, but is not the folder of a run" in err
    assert (out / "config.yaml").read_text() == "mine: true"


@pytest.mark.parametrize("finished", [True, False])
def test_the_run_of_another_input_is_left_alone(finished, folder, command, tmp_path):
    out = tmp_path / "run"
    (out / ".cache").mkdir(parents=True)
    other = {"name": "other", "frames": 300, "width": WIDTH, "height": HEIGHT}
    if finished:
        (out / "summary.json").write_text(json.dumps({"input": other}))
    else:
        (out / ".cache" / "source.json").write_text(json.dumps(other))
    before = {p: p.stat().st_mtime_ns for p in out.rglob("*") if p.is_file()}
    code, err = command("run", folder, "--out", out)
    assert code == 1 and "the run of another input (name other, frames 300" in err
    assert {p: p.stat().st_mtime_ns for p in out.rglob("*") if p.is_file()} == before


def test_a_full_disk(folder, command, tmp_path, monkeypatch):
    def full(*args, **kwargs):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "somewhere")

    monkeypatch.setattr(tempfile, "mkdtemp", full)
    out = tmp_path / "run"
    code, err = command("run", folder, "--out", out)
    assert code == 1 and "run: the disk is full" in err
    assert not out.exists()


def test_a_disk_that_fills_up_between_stages(folder, command, tmp_path, monkeypatch):
    """The stage's file is not there, rather than there and damaged."""

    def full(file, **arrays):
        file.write(b"PK half of an archive")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(np, "savez", full)
    out = tmp_path / "run"
    code, err = command("run", folder, "--out", out)
    assert code == 1 and "No space left on device" in err
    assert not [p for p in out.rglob("*") if p.suffix in (".npz", ".partial")]
    assert not (out / "summary.json").exists()


def test_detection_without_what_it_needs(folder, command, tmp_path, monkeypatch):
    """Neither the network nor the module is there: what to do is said."""
    for file in (folder / "keypoints").iterdir():
        file.unlink()
    (folder / "keypoints").rmdir()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    out = tmp_path / "run"
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    code, err = command("run", folder, "--detect", "yolox", "--offline", "--out", out)
    assert code == 1 and "onnxruntime is not installed" in err
    monkeypatch.setitem(sys.modules, "onnxruntime", object())
    code, err = command("run", folder, "--detect", "yolox", "--offline", "--out", out)
    assert code == 1 and "yolox_s.onnx: " in err and "offline" in err
    assert not out.exists()


def test_something_unforeseen_is_one_line_too(folder, command, tmp_path):
    """The solver that must not be reached is, with an input in which all is well."""
    code, err = command("run", folder, "--out", tmp_path / "run")
    line = err.strip().splitlines()[-1]
    assert code == 70 and "computed from an input that is wrong" in line
    assert "please report it" in line and "Traceback" not in err
    details = Path(line.split()[-1])
    assert "Traceback" in details.read_text() and "bodyslam-jax" in details.read_text()
    assert not (tmp_path / "run" / "summary.json").exists()


EVALUATIONS = {
    "no such run": (lambda t: (t / "none", t / "truth"), "none"),
    "a run half-written": (lambda t: (t / "half", t / "truth"), "half"),
    "no such ground truth": (lambda t: (t / "half", t / "none"), "none"),
    "a ground truth without files": (lambda t: (t / "half", t / "half"), "half"),
}


@pytest.mark.parametrize("case", EVALUATIONS)
def test_evaluation_of_what_is_not_there(case, command, tmp_path):
    make, message = EVALUATIONS[case]
    (tmp_path / "half" / ".cache").mkdir(parents=True)
    (tmp_path / "truth").mkdir()
    (tmp_path / "truth" / "camera.txt").write_text("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n")
    code, err = command("evaluate", *make(tmp_path))
    assert code == 1 and message in err and len(err.strip().splitlines()) == 1, err


@pytest.mark.parametrize(
    "argv",
    [
        ["train-motion", "nowhere", "--out", "w.npz"],
        ["simulate", "blocked/out"],
        ["demo", "--out", "blocked"],
        ["body-model", "check", "nowhere.npz"],
        ["body-model", "convert", "blocked", "out.npz"],
    ],
)
def test_other_commands_say_it_in_one_line_too(argv, command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("blocked").write_text("in the way")
    code, err = command(*argv)
    assert code == 1 and len(err.strip().splitlines()) == 1, err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["blocked"]
