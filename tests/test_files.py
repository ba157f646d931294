"""The layer by which all input files are opened: what attacks, exhausts or confuses.

Every file here is made by its test; what is expected is one line that names it.
"""

import ast
import io
import json
import os
import struct
import zipfile
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

import bodyslam_jax
from bodyslam_jax.config import Config, Limits
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io import budget, read_sequence
from bodyslam_jax.io.archive import read_npy, read_npz
from bodyslam_jax.io.declared import Sizes, as_array, as_number, as_whole
from bodyslam_jax.io.files import (
    read_csv,
    read_json,
    read_json_fields,
    read_text,
    read_yaml,
    read_zip,
)
from bodyslam_jax.io.images import read_image

PACKAGE = Path(bodyslam_jax.__file__).parent
OWN_FILES = {
    "io/files.py": "the layer",
    "io/images.py": "the layer's part that decodes images",
    "io/video.py": "opens videos, after a look at their headers",
    "io/safe_pickle.py": "interprets pickles",
    "io/atomic.py": "writes",
    "export/formats/amass.py": "writes",
    "export/formats/c3d.py": "writes",
    "export/formats/glb.py": "writes",
    "view/video_file.py": "writes, and counts what it wrote",
    "people/detect.py": "writes what it downloads",
    "online/checkpoint.py": "its own state, by names of arrays and of the package",
    "cli/main.py": "standard output",
    "cli/unexpected.py": "writes",
    "graph/validation.py": "the system's own files",
    "batch/local_engine.py": "the system's own files",
    "export/report.py": "ships with the package",
    "batch/collection.py": "ships with the package",
    "view/scene_data.py": "ships with the package, and a run's page",
    "motion/weights.py": "text in memory",
    "motion/contact_network.py": "text in memory",
    "motion/training/evaluation.py": "text in memory",
    "batch/slurm_engine.py": "values that its own workers write",
    "batch/program_cache.py": "programs that its own workers write",
    # Run and batch folders: files that this package wrote and may find damaged.
    "pipeline/stage_cache.py": "results of stages",
    "export/lock.py": "a lock",
    "export/folder.py": "the mark of a finished run",
    "batch/failures.py": "lines of a batch",
    "batch/record.py": "the mark of a finished job",
    "batch/rows.py": "summaries",
    "batch/grid_sweep.py": "rows of a sweep",
    "batch/inputs.py": "text in memory",
    "experiments/jobs.py": "rows of an experiment",
    "view/serve.py": "the page that it serves",
    "io/capture.py": "cameras and streams, which are no files",
}
"""Modules that may open files by themselves, and why."""
_OPENERS = {
    *("open", "read_text", "read_bytes", "load", "loads", "loadtxt", "genfromtxt"),
    *("fromfile", "memmap", "imread", "imdecode", "VideoCapture", "ZipFile", "parse"),
    *("safe_load", "reader"),
}
_LIBRARIES = {
    *("np", "jnp", "json", "yaml", "zipfile", "cv2", "pickle", "csv", "ElementTree"),
    *("Image", "joblib", "torch", "av", "os", "io", "gzip", "bz2", "lzma", "tomllib"),
}


def _opens(module: Path) -> list[int]:
    """Lines of a module in which a file is opened or its content parsed."""
    found = []
    for node in ast.walk(ast.parse(module.read_text())):
        if not isinstance(node, ast.Call):
            continue
        called = node.func
        if isinstance(called, ast.Name) and called.id == "open":
            found.append(node.lineno)
        if isinstance(called, ast.Attribute) and called.attr in _OPENERS:
            of = called.value.id if isinstance(called.value, ast.Name) else ""
            is_path = called.attr in ("open", "read_text", "read_bytes")
            if of in _LIBRARIES or (is_path and of != "webbrowser"):
                found.append(node.lineno)
    return found


def test_no_reader_opens_a_file_by_itself():
    modules = {str(m.relative_to(PACKAGE)): m for m in PACKAGE.rglob("*.py")}
    found = {
        f"{name}:{line}"
        for name, module in modules.items()
        if name not in OWN_FILES
        for line in _opens(module)
    }
    assert not found, "use io.files, io.archive, io.images, io.video or io.safe_pickle"


def refusal(read, path: Path, *more) -> str:
    """What a reader says of a file: one line that names it."""
    with pytest.raises(InputError) as caught:
        read(path, *more)
    message = str(caught.value)
    assert str(path) in message and "\n" not in message, message
    return message


def test_what_is_no_file_is_not_opened(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    assert "a pipe or a device" in refusal(read_text, tmp_path / "pipe")
    assert "a pipe or a device" in refusal(read_text, Path("/dev/zero"))
    assert "a folder" in refusal(read_text, tmp_path)
    assert "no such file" in refusal(read_text, tmp_path / "none")
    assert "too long" in refusal(read_text, tmp_path / ("x" * 300))


def test_text_in_the_encodings_of_editors(tmp_path):
    for encoding in ("utf-8", "utf-8-sig", "utf-16"):
        (tmp_path / "a.txt").write_bytes("Höhe 1,78".encode(encoding))
        assert read_text(tmp_path / "a.txt") == "Höhe 1,78"
    for content in (b"\xff\x00\x01", b"a\0b", b"\xff\xfea"):
        (tmp_path / "a.txt").write_bytes(content)
        refusal(read_text, tmp_path / "a.txt")


@pytest.mark.parametrize(
    "text, expected",
    [
        ("[" * 100 + "]" * 100, "nested more than 64 deep"),
        ("[" * 100_000, "nested more than 64 deep"),
        ('{"a": 1, "a": 2}', "the name 'a' twice"),
        ('{"a": 1,\n"b": }', "line 2: not JSON"),
        ("", "empty"),
        ("[1] 2", "line 1: not JSON"),
    ],
)
def test_json_that_is_none(tmp_path, text, expected):
    (tmp_path / "a.json").write_text(text)
    assert expected in refusal(read_json, tmp_path / "a.json")


def test_json_of_too_many_values(tmp_path, monkeypatch):
    monkeypatch.setattr(budget, "MAX_ELEMENTS", 1000)
    (tmp_path / "a.json").write_text(json.dumps([0] * 2000))
    assert "2001 values" in refusal(read_json, tmp_path / "a.json")


def test_whole_numbers_of_any_length_are_numbers(tmp_path):
    (tmp_path / "a.json").write_text(f"[1700000000000000000, {'9' * 5000}]")
    assert read_json(tmp_path / "a.json") == [1700000000000000000, float("inf")]


FIELDS = {
    "width": lambda data: data.whole("width", 1, 10_000),
    "fps": lambda data: data.number("fps", 0.1, 1000),
    "params": lambda data: data.array("params", (4,)),
    "model": lambda data: data.text("model", among=("PINHOLE", "OPENCV")),
    "frames": lambda data: list(data.each("frames")),
    "meta": lambda data: data.fields("meta"),
}


@pytest.mark.parametrize(
    "name, value",
    [
        *(("width", x) for x in (True, "64", 64.5, -1, 0, 1e308, None, [64], {})),
        *(("width", x) for x in (float("inf"), float("nan"), 10**400)),
        *(("fps", x) for x in (True, "30", 0, 1e39, float("nan"), [], {"a": 1})),
        ("params", [1, 2, 3]),
        ("params", [[1, 2, 3, 4]]),
        ("params", [1, 2, 3, "4"]),
        ("params", [1, 2, 3, None]),
        ("params", [1, 2, 3, True]),
        ("params", [1, 2, [3], 4]),
        ("params", [1, 2, 3, 1e308]),
        ("params", [1, 2, 3, float("nan")]),
        ("params", [1, 2, 3, 10**400]),
        ("params", {"0": 1}),
        ("params", ["x" * 100_000, 1, 2, 3]),
        *(("model", x) for x in ("FISHEYE", 1, None, ["PINHOLE"])),
        *(("frames", x) for x in ({}, "ab", [1], [{}, None])),
        *(("meta", x) for x in ([], 1, "x")),
    ],
)
def test_a_field_that_is_not_as_declared_is_named(tmp_path, name, value):
    path = tmp_path / "a.json"
    path.write_text(json.dumps({name: value}))
    data = read_json_fields(path)
    assert f"`{name}" in refusal(lambda _: FIELDS[name](data), path)


def test_fields_as_declared(tmp_path):
    path = tmp_path / "a.json"
    path.write_text('{"width": 64.0, "fps": 30, "params": [1, 2.5, 3, 4]}')
    data = read_json_fields(path)
    assert FIELDS["width"](data) == 64 and FIELDS["fps"](data) == 30.0
    assert FIELDS["params"](data).tolist() == [1, 2.5, 3, 4]
    assert "found width, fps" in refusal(lambda _: FIELDS["model"](data), path)


@pytest.mark.parametrize(
    "text, expected",
    [
        ("a: &x [1]\nb: *x", "line 1: a reference"),
        ("[" * 50_000, "nested more than 64 deep"),
        ("a: 1\na: 2", "the name 'a' twice"),
        ("a: !!python/object:os.x {}", "not YAML"),
        ("? [a]\n: 1", "not YAML"),
        (f"a: {'9' * 5000}", "not YAML"),
        ("a: !!float x", "not YAML"),
        ("a:\n\t- b", "line 2"),
        ("a: " + "b" * 300_000, "characters, expected at most"),
    ],
)
def test_yaml_that_is_none(tmp_path, text, expected):
    (tmp_path / "a.yaml").write_text(text)
    assert expected in refusal(read_yaml, tmp_path / "a.yaml")


def test_yaml_of_opencv_and_dates(tmp_path):
    (tmp_path / "a.yaml").write_text(
        "%YAML:1.0\n---\nday: 2026-11-27\nK: !!opencv-matrix\n   rows: 1\n   data: [1.]"
    )
    found = read_yaml(tmp_path / "a.yaml")
    assert found == {"day": "2026-11-27", "K": {"rows": 1, "data": [1.0]}}


def test_csv_with_a_quote_that_stays_open(tmp_path):
    (tmp_path / "a.csv").write_text('a,b\n\n"c')
    assert "line 3" in refusal(read_csv, tmp_path / "a.csv")


def test_arrays_are_those_of_numpy(tmp_path):
    arrays = {
        "f": np.arange(6.0).reshape(2, 3),
        "fortran": np.asfortranarray(np.arange(6).reshape(2, 3)),
        "big": np.arange(3, dtype=">f4"),
        "none": np.zeros((0, 2)),
        "one": np.float64(3),
        "b": np.ones(3, bool),
        "s": np.array(["a", "bc"]),
    }
    for save in (np.savez, np.savez_compressed):
        save(tmp_path / "a.npz", **arrays)
        archive = read_npz(tmp_path / "a.npz")
        for name, array in arrays.items():
            found = archive.raw(name)
            assert found.shape == np.shape(array) and np.array_equal(found, array)
            assert archive.header(name) == (np.shape(array), np.asarray(array).dtype)
    np.save(tmp_path / "a.npy", arrays["f"])
    assert np.array_equal(read_npy(tmp_path / "a.npy"), arrays["f"])


def npy(descr: str, shape: str, content: bytes = b"") -> bytes:
    """A `.npy` whose header says anything."""
    text = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}"
    header = text.ljust(117).encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + content


HEADERS = {
    "more than there is": ("'<f8'", "(1000000000, 1000000000)"),
    "nothing, many times": ("'<f8'", "(0, 1152921504606846976)"),
    "a length of many digits": ("'<f8'", f"({'9' * 60},)"),
    "a negative length": ("'<f8'", "(-1,)"),
    "too many axes": ("'<f8'", f"({'1, ' * 40})"),
    "objects": ("'|O'", "(1,)"),
    "records": ("[('a', '<f8')]", "(1,)"),
    "numbers of no size": ("'|V0'", "(5,)"),
    "text of no size": ("'<U0'", "(5,)"),
    "an unknown type": ("'<f3'", "(1,)"),
    "a call": ("__import__('os')", "(1,)"),
    "a nested tuple": ("(((((1,),),),),)", "(1,)"),
}


@pytest.mark.parametrize("kind", HEADERS)
def test_headers_of_arrays_that_lie(tmp_path, kind):
    content = npy(*HEADERS[kind], content=b"\0" * 64)
    (tmp_path / "a.npy").write_bytes(content)
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("a.npy", content)
    number = lambda array: as_array(tmp_path / "a.npy", "a", array, (1,))
    refusal(lambda path: number(read_npy(path)), tmp_path / "a.npy")
    refusal(lambda path: read_npz(path).array("a", (1,)), tmp_path / "a.npz")


def zipped(**members: bytes) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(f"{name}.npy", content)
    return file.getvalue()


def _bomb(path: Path) -> None:
    zeros = npy("'<f8'", "(1000000,)") + bytes(8_000_000)
    path.write_bytes(zipped(a=zeros, b=zeros))


def _liar(path: Path) -> None:
    """The archive says that a file of 8 MB has 200 bytes."""
    content = bytearray(zipped(a=npy("'<f8'", "(9,)") + bytes(8_000_000)))
    for mark, at in ((b"PK\x03\x04", 22), (b"PK\x01\x02", 24)):
        start = content.index(mark) + at
        content[start : start + 4] = struct.pack("<I", 200)
    path.write_bytes(content)


def _method(path: Path) -> None:
    content = bytearray(zipped(a=npy("'<f8'", "(1,)", bytes(8))))
    for mark, at in ((b"PK\x03\x04", 8), (b"PK\x01\x02", 10)):
        start = content.index(mark) + at
        content[start : start + 2] = struct.pack("<H", 97)
    path.write_bytes(content)


def _broken(path: Path) -> None:
    content = bytearray(zipped(a=npy("'<f8'", "(999,)", os.urandom(7992))))
    content[300:360] = b"\x55" * 60
    path.write_bytes(content)


def _twice(path: Path) -> None:
    one = npy("'<f8'", "(1,)", bytes(8))
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.npy", one)
        archive.writestr("A.npy", one)
    path.write_bytes(path.read_bytes().replace(b"A.npy", b"a.npy"))


ARCHIVES = {
    "expands beyond the budget": (_bomb, "unpacks to 0.016 GB"),
    "a size that is not its own": (_liar, "or damaged"),
    "an unknown compression": (_method, "compressed by method 97"),
    "damaged content": (_broken, "or damaged"),
    "two files of one name": (_twice, "'a.npy' twice"),
    "no archive": (lambda path: path.write_bytes(b"hello"), "not a NumPy archive"),
    "nothing": (lambda path: path.write_bytes(b""), "not a NumPy archive"),
    "no arrays": (lambda path: path.write_bytes(zipped()), "no array in it"),
}


@pytest.mark.parametrize("kind", ARCHIVES)
def test_archives_that_attack(tmp_path, kind):
    make, expected = ARCHIVES[kind]
    make(tmp_path / "a.npz")
    with budget.granted(Limits(input_gigabytes=0.01)):
        read = lambda path: read_npz(path).raw("a")
        assert expected in refusal(read, tmp_path / "a.npz")


def test_a_file_beyond_the_budget_names_the_option(tmp_path):
    (tmp_path / "a.json").write_text(json.dumps("x" * 2_000_000))
    with budget.granted(Limits(input_gigabytes=0.001)):
        assert "--limits.input-gigabytes" in refusal(read_json, tmp_path / "a.json")
    assert len(read_json(tmp_path / "a.json")) == 2_000_000


def test_small_numbers_are_counted_as_the_large_ones_that_they_become(tmp_path):
    path = tmp_path / "a.npz"
    np.savez_compressed(path, a=np.zeros(900_000, np.int8))
    with budget.granted(Limits(input_gigabytes=0.001)):
        read = lambda _: read_npz(path).array("a")
        assert "0.0072 GB" in refusal(read, path)


def test_a_member_of_a_zip_that_is_not_there(tmp_path):
    (tmp_path / "a.zip").write_bytes(zipped(a=b"x"))
    read = lambda path: read_zip(path).read("metadata")
    assert "no metadata in it; found a.npy" in refusal(read, tmp_path / "a.zip")


def test_declared_arrays(tmp_path):
    path, sizes = tmp_path / "a.npz", Sizes()
    assert as_array(path, "frame", [0, 1], ("m",), kind="whole").dtype == np.int64
    as_array(path, "frame", np.zeros(3), ("m",), sizes=sizes)
    wrong = lambda *shape: as_array(path, "uv", np.zeros(shape), ("m", 2), sizes=sizes)
    assert wrong(3, 2).shape == (3, 2)
    assert "(4, 2), expected (3, 2)" in refusal(lambda _: wrong(4, 2), path)
    refuse = lambda value, **how: refusal(
        lambda _: as_array(path, "a", np.asarray(value), **how), path
    )
    assert "1 of 2 numbers" in refuse([0.0, np.nan])
    assert "1e+30" in refuse([1e30])
    assert "-1, expected 0 to 9" in refuse([-1.0], low=0, high=9)
    assert "whole numbers" in refuse([1.5], kind="whole")
    assert "complex128" in refuse([1j]) and "<U1" in refuse(["1"])
    assert "true or false" in refuse([2], kind="boolean")
    missing = as_array(path, "a", np.array([1.0, np.inf, 1e300]), finite=False)
    assert np.array_equal(missing, [1.0, np.nan, np.nan], equal_nan=True)
    assert as_whole(path, "a", np.int32(3)) == 3 and as_number(path, "a", 2) == 2.0


@pytest.mark.parametrize("suffix", ["png", "jpg", "bmp", "webp", "tif"])
def test_images_are_those_of_opencv(tmp_path, suffix):
    path = tmp_path / f"a.{suffix}"
    image = np.random.default_rng(0).integers(0, 255, (20, 30, 3), np.uint8)
    cv2.imwrite(str(path), image)
    assert np.array_equal(read_image(path), cv2.imread(str(path)))


def _png(width: int, height: int, length: int | None = None) -> bytes:
    """A PNG whose header and first block of pixels say anything."""
    _, data = cv2.imencode(".png", np.zeros((20, 20), np.uint8))
    data = bytearray(data.tobytes())
    data[16:24] = struct.pack(">II", width, height)
    data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    if length is not None:
        at = data.index(b"IDAT") - 4
        data[at : at + 4] = struct.pack(">I", length)
    return bytes(data)


@pytest.mark.parametrize(
    "content, expected",
    [
        (_png(30_000, 30_000), "million pixels"),
        (_png(12_000, 12_000), "12000x12000 px by its header"),
        (_png(20, 20, length=2**31 + 200), "cut short or damaged"),
        (b"", "not an image"),
        (b"\x89PNG\r\n\x1a\n", "not an image"),
    ],
    ids=["absurd", "too large", "a block of 2 GB", "nothing", "no header"],
)
def test_images_that_are_never_decoded(tmp_path, content, expected):
    (tmp_path / "a.png").write_bytes(content)
    assert expected in refusal(read_image, tmp_path / "a.png")


CAMERA = {"model": "PINHOLE", "width": 64, "height": 48, "params": [60, 60, 32, 24]}


def _folder(path: Path, frame: int, count: int = 40) -> Path:
    (path / "camera.json").write_text(json.dumps(CAMERA | {"fps": 30}))
    frames = np.append(np.arange(count - 1), frame)
    uv = np.full((count, 2), 20.0)
    np.savez(path / "tracks.npz", frame=frames, landmark=np.zeros(count), uv=uv)
    return path


@pytest.mark.parametrize(
    "frame, expected",
    [
        (100_000_000, "--limits.frames"),
        (90_000, "of 40 frames only"),
        (-5, "-5, expected 0 or more"),
    ],
)
def test_a_frame_far_beyond_the_observations_is_refused(tmp_path, frame, expected):
    folder = _folder(tmp_path, frame)
    with pytest.raises(InputError, match="tracks.npz: ") as caught:
        read_sequence(folder)
    assert expected in str(caught.value)


def test_bodies_of_a_frame_far_beyond_are_refused(tmp_path):
    folder = _folder(tmp_path, 39)
    bodies = {
        "frame": np.append(np.arange(9), 100_000_000),
        "betas": np.zeros((10, 10)),
    }
    bodies |= {"poses": np.zeros((10, 72)), "trans": np.full((10, 3), 3.0)}
    np.savez(folder / "bodies.npz", **bodies)
    with pytest.raises(InputError, match=r"bodies.npz: bodies of frame 100000000"):
        read_sequence(folder)


def test_the_option_allows_more_frames(tmp_path):
    folder = _folder(tmp_path, 150)
    assert read_sequence(folder).num_frames == 151
    few = Config(limits=Limits(frames=100))
    with pytest.raises(InputError, match="expected less than 100 without a video"):
        read_sequence(folder, known=few)
