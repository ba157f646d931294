import dataclasses
import os
import shutil
import tracemalloc
import zipfile
from pathlib import Path

import jaxtyping
import numpy as np
import pytest

from bodyslam_jax.config import Config, Simulation
from bodyslam_jax.pipeline import stage_cache
from bodyslam_jax.pipeline.stage_cache import Cache, fingerprint, load, save
from bodyslam_jax.types import Intrinsics, Sequence, Tracks


def _sequence() -> Sequence:
    tracks = Tracks(
        np.array([0, 1]), np.array([0, 0]), np.array([[1.0, 2.0], [3.0, 4.0]])
    )
    intrinsics = Intrinsics(np.array([500.0, 500.0, 319.5, 239.5]), 640, 480)
    times = np.arange(2) / 30
    return Sequence("made up", Path("a.mp4"), times, intrinsics, tracks=tracks)


def test_what_was_saved_is_what_is_loaded(tmp_path):
    save(tmp_path / "x.npz", _sequence())
    found = load(tmp_path / "x.npz", Sequence)
    assert found.name == "made up" and found.frames == Path("a.mp4")
    assert found.bodies is None and found.warnings == ()
    np.testing.assert_array_equal(found.tracks.uv, _sequence().tracks.uv)
    assert isinstance(found.intrinsics, Intrinsics) and found.intrinsics.width == 640


def test_a_stage_is_computed_once_per_key(tmp_path):
    calls = []
    compute = lambda: calls.append(1) or _sequence().tracks
    cache = Cache(tmp_path)
    cache.stage("tracks", "a", Tracks, compute)
    cache.stage("tracks", "a", Tracks, compute)
    assert len(calls) == 1
    cache.stage("tracks", "b", Tracks, compute)
    assert len(calls) == 2
    assert [p.name for p in tmp_path.iterdir()] == ["tracks-b.npz"]


def test_a_damaged_stage_is_computed_again(tmp_path, caplog):
    cache = Cache(tmp_path)
    cache.stage("tracks", "a", Tracks, lambda: _sequence().tracks)
    (tmp_path / "tracks-a.npz").write_bytes(b"PK\x03\x04 cut short")
    found = cache.stage("tracks", "a", Tracks, lambda: _sequence().tracks)
    assert found.uv.shape == (2, 2) and "computed again" in caplog.text


def _rewrite(path: Path, **arrays) -> None:
    """Replaces members of a stage file, as a tool that knows archives would."""
    with np.load(path) as archive:
        kept = {name: archive[name] for name in archive.files}
    np.savez(path, **(kept | arrays))


HARM = {
    "not finite": {".uv": np.full((2, 2), np.nan)},
    "another shape": {".uv": np.zeros((2, 3))},
    "another length": {".frame": np.zeros(3, np.int64)},
    "another type": {".frame": np.array(["a", "b"])},
    "another value": {".uv": np.ones((2, 2))},
    "more": {"more": np.zeros(3)},
    "no header": {"__header__": np.zeros(4, np.uint8)},
    "deep header": {"__header__": np.frombuffer(b"[" * 100_000, np.uint8)},
    "header of a list": {"__header__": np.frombuffer(b"[1]", np.uint8)},
    "no hash": {"__sha256__": np.zeros(0, np.uint8)},
}


@pytest.mark.parametrize("harm", HARM)
def test_a_stage_that_is_not_as_written_is_computed_again(tmp_path, caplog, harm):
    cache, path = Cache(tmp_path), tmp_path / "tracks-a.npz"
    cache.stage("tracks", "a", Tracks, lambda: _sequence().tracks)
    _rewrite(path, **HARM[harm])
    found = cache.stage("tracks", "a", Tracks, lambda: _sequence().tracks)
    np.testing.assert_array_equal(found.uv, _sequence().tracks.uv)
    (line,) = caplog.messages
    assert str(path) in line and "computed again" in line and "\n" not in line
    assert load(path, Tracks, sealed=True).uv.shape == (2, 2)


@pytest.mark.parametrize(
    "change",
    [
        {"uv": np.full((2, 2), np.inf)},
        {"uv": np.zeros((2, 3))},
        {"uv": np.zeros((2, 2), complex)},
        {"frame": np.zeros(2)},
        {"frame": np.zeros(1, int)},
        {"landmark": None},
        {"landmark": "text"},
        {"warnings": (1,)},
        {"warnings": "text"},
    ],
)
def test_a_stage_of_values_that_a_field_cannot_have_is_no_stage(tmp_path, change):
    """Also if the file is sealed."""
    kept = vars(_sequence().tracks) | change
    save(tmp_path / "x.npz", dataclasses.make_dataclass("Tracks", kept)(**kept))
    # Under the tests' type checker the constructor may be the one that complains.
    with pytest.raises((ValueError, jaxtyping.TypeCheckError)):
        load(tmp_path / "x.npz", Tracks)


def _bomb(path: Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("__header__.npy", bytes(1 << 24))


def _huge(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        header = "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000, 99), }"
        text = header.encode().ljust(118) + b"\n"
        archive.writestr(".uv.npy", b"\x93NUMPY\x01\x00\x77\x00" + text)


def _unfinished_header(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(".uv.npy", b"\x93NUMPY\x01\x00\x05\x00{'a((")


FILES = {
    "a folder": lambda path: (path / "x").mkdir(parents=True),
    "a pipe": lambda path: os.mkfifo(path),
    "empty": lambda path: path.write_bytes(b""),
    "compressed": _bomb,
    "larger than its file": _huge,
    "half a header": _unfinished_header,
    "an .npy": lambda path: path.write_bytes(b"\x93NUMPY\x01\x00v\x00{"),
}


@pytest.mark.parametrize("kind", FILES)
def test_what_is_no_stage_is_computed_again_at_no_cost(tmp_path, caplog, kind):
    path = tmp_path / "tracks-a.npz"
    FILES[kind](path)
    tracemalloc.start()
    try:
        found = Cache(tmp_path).stage("tracks", "a", Tracks, lambda: _sequence().tracks)
        assert tracemalloc.get_traced_memory()[1] < 1 << 22
    finally:
        tracemalloc.stop()
    assert found.uv.shape == (2, 2) and "computed again" in caplog.text
    assert load(path, Tracks).uv.shape == (2, 2)


@pytest.mark.parametrize("error", [RecursionError, MemoryError, NotImplementedError])
def test_no_error_in_reading_a_stage_ends_a_run(tmp_path, monkeypatch, error):
    def fail(*args, **more):
        raise error

    cache = Cache(tmp_path)
    cache.stage("tracks", "a", Tracks, lambda: _sequence().tracks)
    monkeypatch.setattr(stage_cache, "load", fail)
    found = cache.stage("tracks", "a", Tracks, lambda: _sequence().tracks)
    assert found.uv.shape == (2, 2)


@pytest.mark.parametrize("content", ["[" * 100_000, "[]", "\udcff", "1" * 5000, ""])
def test_a_damaged_description_of_the_input_is_none(tmp_path, content):
    (tmp_path / "source.json").write_bytes(content.encode(errors="surrogateescape"))
    assert Cache(tmp_path).owner() in (None, {})


def test_stages_that_escaped_before_are_computed_again(tmp_path):
    files = Path(__file__).parents[2] / "shared" / "cases" / "files"
    if not files.is_dir():
        pytest.skip("needs shared files")
    for file in files.glob("stage_cache_escape_*.npz"):
        shutil.copy(file, tmp_path / "tracks-a.npz")
        found = Cache(tmp_path).stage("tracks", "a", Tracks, lambda: _sequence().tracks)
        assert found.uv.shape == (2, 2)


@pytest.mark.parametrize("names", ["frame", "frame landmark uv more"])
def test_a_stage_with_other_fields_is_computed_again(tmp_path, caplog, names):
    """A stage file of another state of the package that calls itself the same."""
    then = dataclasses.make_dataclass("Tracks", names.split())
    save(tmp_path / "tracks-a.npz", then(*(np.zeros(1) for _ in names.split())))
    cache = Cache(tmp_path)
    found = cache.stage("tracks", "a", Tracks, lambda: _sequence().tracks)
    assert found.uv.shape == (2, 2) and "computed again" in caplog.text


def test_a_field_with_a_default_is_missed_too(tmp_path):
    then = dataclasses.make_dataclass("Numbers", [("a", int)])
    now = dataclasses.make_dataclass("Numbers", [("a", int), ("b", int, 0)])
    save(tmp_path / "x.npz", then(1))
    assert load(tmp_path / "x.npz", then).a == 1
    with pytest.raises(ValueError, match="another version"):
        load(tmp_path / "x.npz", now)


@pytest.mark.parametrize("change", ["name", "array", "setting"])
def test_fingerprint_sees_every_change(change):
    base = _sequence()
    other = {
        "name": dataclasses.replace(base, name="other"),
        "array": dataclasses.replace(base, timestamps=base.timestamps + 1e-9),
        "setting": dataclasses.replace(base, warnings=("w",)),
    }[change]
    assert fingerprint(base) == fingerprint(_sequence()) != fingerprint(other)


def test_fingerprint_of_a_file_is_its_content(tmp_path):
    first, second = tmp_path / "a" / "v.mp4", tmp_path / "b" / "v.mp4"
    for path, content in ((first, b"one"), (second, b"two")):
        path.parent.mkdir()
        path.write_bytes(content)
    assert fingerprint(first) != fingerprint(second)
    second.write_bytes(b"one")
    assert fingerprint(first) == fingerprint(second)


@pytest.mark.parametrize(
    "settings",
    [
        lambda file: Config(motion_model=file),
        lambda file: Config(body_model=file),
        lambda file: Simulation(motion=file),
    ],
)
def test_fingerprint_of_settings_sees_into_their_files(tmp_path, settings):
    """As where a motion model is trained anew and written over the last one."""
    first, second = tmp_path / "a" / "model.npz", tmp_path / "b" / "model.npz"
    for path in (first, second):
        path.parent.mkdir()
        path.write_bytes(b"one")
    before = fingerprint((settings(str(first)),))
    assert before == fingerprint((settings(str(second)),))
    first.write_bytes(b"two")
    assert before != fingerprint((settings(str(first)),))
    assert before != fingerprint((settings(None),))


def test_fingerprint_sees_the_body_that_the_machine_has(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    before = fingerprint(Config())
    for content in (b"one", b"two"):
        (tmp_path / "SMPL_NEUTRAL.npz").write_bytes(content)
        monkeypatch.setenv("BODYSLAM_BODY_MODEL", str(tmp_path))
        file = stage_cache.body_model_file(None)
        assert file == tmp_path / "SMPL_NEUTRAL.npz"
        found = fingerprint(Config())
        assert found != before
        assert found == fingerprint(Config(body_model=str(file)))
        before = found


def test_fingerprint_sees_the_package(monkeypatch):
    """Another state of the source may compute something else."""
    before = fingerprint(1)
    monkeypatch.setattr(stage_cache, "package_hash", lambda: b"edited")
    assert fingerprint(1) != before
