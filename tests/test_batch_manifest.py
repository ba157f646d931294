"""Manifests: what a correct one gives, and that each mistake is named with its line."""

import json

import numpy as np
import pytest

from bodyslam_jax.batch import find_inputs
from bodyslam_jax.batch.inputs import read_manifest
from bodyslam_jax.config import Config

HEADER = "name,video,keypoints,bodies,camera,height,groundtruth,options"


@pytest.fixture
def home(tmp_path):
    """Files that manifests name; none of them is opened but `camera.json`."""
    for name in ("a.mp4", "b.MOV", "keypoints.npz", "bodies.npz", "note.txt"):
        (tmp_path / name).write_bytes(b"content")
    (tmp_path / "empty.mp4").touch()
    camera = {
        "model": "PINHOLE",
        "width": 640,
        "height": 480,
        "params": [500, 500, 320, 240],
        "fps": 30,
    }
    (tmp_path / "camera.json").write_text(json.dumps(camera))
    (tmp_path / "broken.json").write_text('{"model": "PINHOLE"}')
    (tmp_path / "truth").mkdir()
    (tmp_path / "truth" / "camera.txt").write_text("0 0 0 0 0 0 0 1\n")
    (tmp_path / "nothing").mkdir()
    sequence = tmp_path / "sequence"
    sequence.mkdir()
    np.savez(sequence / "tracks.npz", frame=np.zeros(1))
    several = tmp_path / "several"
    several.mkdir()
    for name in ("one.mp4", "two.mp4"):
        (several / name).write_bytes(b"content")
    return tmp_path


def manifest(home, *lines, header=HEADER):
    path = home / "clips.csv"
    path.write_text("\n".join([header, *lines]) + "\n")
    return path


def test_a_manifest_gives_inputs_with_their_files_and_settings(home):
    path = manifest(
        home,
        "first,a.mp4,keypoints.npz,bodies.npz,camera.json,1.78±0.01,truth,--fps 25",
        "",
        ',b.MOV,,,,0=1.7 1=1.6,,"--person 0 1 --weights.pixel-sigma 2 --no-overlay"',
        "third one,sequence,,,,,,",
    )
    first, second, third = find_inputs(path)
    assert (first.name, second.name, third.name) == ("first", "b", "third one")
    assert first.path == home / "a.mp4" and first.keypoints == home / "keypoints.npz"
    assert first.groundtruth == home / "truth" and second.camera is None
    settings = first.settings(Config(uncertainty=False))
    assert settings.fps == 25 and settings.height == ("1.78±0.01",)
    assert not settings.uncertainty
    settings = second.settings(Config())
    assert settings.person == (0, 1) and settings.height == ("0=1.7", "1=1.6")
    assert settings.weights.pixel_sigma == 2.0 and not settings.overlay
    assert third.settings(Config()) == Config()


def test_a_manifest_as_spreadsheets_write_it(home):
    text = f"\ufeff{HEADER.title()}\r\n,a.mp4,,,,,,\r\n,,,,,,,\r\n"
    (home / "clips.csv").write_bytes(text.encode())
    (one,) = find_inputs(home / "clips.csv")
    assert one.name == "a"


MISTAKES = {
    "no such video": (",c.mp4,,,,,,", "2: video: {home}/c.mp4: no such file or folder"),
    "no video": ("x,,,,,,,", "2: video: empty"),
    "not a video": (",note.txt,,,,,,", "2: video: {home}/note.txt: .txt, expected"),
    "empty video": (",empty.mp4,,,,,,", "2: video: {home}/empty.mp4: an empty file"),
    "nothing in a folder": (",nothing,,,,,,", "a folder without a video, images or"),
    "several videos": (",several,,,,,,", "which video? one.mp4, two.mp4"),
    "no such keypoints": (",a.mp4,k.npz,,,,,", "2: keypoints: {home}/k.npz: no such"),
    "no keypoints in it": (",a.mp4,nothing,,,,,", "2: keypoints: {home}/nothing: an"),
    "no such bodies": (",a.mp4,,b.npz,,,,", "2: bodies: {home}/b.npz: no such file"),
    "bodies in a folder": (",a.mp4,,truth,,,,", "2: bodies: {home}/truth: a folder"),
    "no such camera": (",a.mp4,,,c.json,,,", "2: camera: {home}/c.json: no such file"),
    "broken camera": (",a.mp4,,,broken.json,,,", "2: camera: {home}/broken.json: "),
    "name that no system has, of a camera": (
        f",a.mp4,,,{'9' * 300},,,",
        "2: camera: File name too long.",
    ),
    "name that no system has, of bodies": (
        f",a.mp4,,{'9' * 300},,,,",
        "2: bodies: File name too long.",
    ),
    "height in cm": (",a.mp4,,,,178,,", "2: height: found 178, expected 0.4 to 2.8 m"),
    "height in words": (",a.mp4,,,,tall,,", "2: height: found 'tall', expected METRES"),
    "no such truth": (",a.mp4,,,,,t,", "2: groundtruth: {home}/t: no such file or"),
    "no truth in it": (
        ",a.mp4,,,,,several,",
        "2: groundtruth: {home}/several: neither",
    ),
    "no such option": (
        ",a.mp4,,,,,,--weights.pixel-sgima 2",
        "2: options: no option --weights.pixel-sgima; did you mean --weights.pixel",
    ),
    "option of an earlier version": (
        ",a.mp4,,,,,,--people-fit.walking-knees no",
        "2: options: --people-fit.walking-knees no longer exists: knees are as",
    ),
    "option of a wrong kind": (",a.mp4,,,,,,--fps fast", "--fps: found 'fast', exp"),
    "option out of range": (",a.mp4,,,,,,--fps -3", "2: options: fps: found -3.0, exp"),
    "option without a name": (",a.mp4,,,,,,25", "2: options: found '25', expected --"),
    "open quote in options": (",a.mp4,,,,,,--fps 'x", '2: options: found "--fps \'x"'),
    "conflicting options": (",a.mp4,,,,,,--focal 9 --fov 65", "focal and fov: both"),
    "too few cells": (",a.mp4", "2: 2 cells, expected 8 as in the header."),
    "too many cells": (",a.mp4,,,,,,,,x", "2: 10 cells, expected 8 as in the head"),
    "name with a slash": (
        "x/y,a.mp4,,,,,,",
        "2: name: 'x/y', expected letters, digits",
    ),
    "hidden name": (".x,a.mp4,,,,,,", "2: name: '.x', expected letters, digits"),
    "long name": (f"{'x' * 300},a.mp4,,,,,,", "2: name: 300 letters, expected at most"),
    "name twice": ("A,a.mp4,,,,,,\na,b.MOV,,,,,,", "3: name: 'a' is that of line 2."),
    "quote that stays open": (',"a.mp4,,,,,,', ":2: not CSV (unexpected end of data)"),
    "no lines": ("", "no lines below the header."),
}


@pytest.mark.parametrize("kind", MISTAKES)
def test_a_mistake_in_a_line_is_named_with_its_line(home, kind):
    line, expected = MISTAKES[kind]
    path = manifest(home, line)
    with pytest.raises(ValueError) as caught:
        read_manifest(path)
    (message,) = str(caught.value).splitlines()
    assert message.startswith(str(path))
    assert expected.format(home=home) in message


@pytest.mark.parametrize(
    "content, expected",
    [
        ("name,vidoe\n,a.mp4\n", "1: no column 'vidoe'; did you mean video?"),
        ("name\nx\n", "1: no column video"),
        ("video,camera,video\na.mp4,,\n", "1: column video appears 2 times."),
        ("name;video\nx;a.mp4\n", "1: columns separated by ;, expected commas."),
        ("", "empty, expected a header"),
        ("video\n\xe4.mp4\n".encode("latin-1"), "is no text"),
        ("video\na\0.mp4\n", "is a zero"),
    ],
)
def test_a_mistake_in_the_header_or_the_file_is_named(home, content, expected):
    path = home / "clips.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(ValueError) as caught:
        read_manifest(path)
    assert expected in str(caught.value) and str(path) in str(caught.value)


def test_the_command_names_all_mistakes_and_runs_nothing(home, command):
    single = {kind: one for kind, one in MISTAKES.items() if "\n" not in one[0]}
    for kind in ("no lines", "quote that stays open"):
        del single[kind]
    lines = [line for line, _ in single.values()]
    path, out = manifest(home, *lines), home / "out"
    code, text = command("batch", path, "--out", out)
    assert code == 1, text
    assert not out.exists()
    printed = [line for line in text.splitlines() if line.startswith("bodyslam: ")]
    assert len(single) >= 20
    for number, (_, expected) in enumerate(single.values(), 2):
        wanted = expected.format(home=home).removeprefix("2: ")
        assert any(f"clips.csv:{number}: " in p and wanted in p for p in printed)
