"""What is fuzzed: for each reader a well-formed input, and how it is read.

`read` runs in the processes of `fuzz_worker`, `seed` in the one that mutates.
"""

import contextlib
import dataclasses
import json
import struct
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from bodyslam_jax import evaluation, io, view
from bodyslam_jax.batch import record, rows
from bodyslam_jax.batch.inputs import read_manifest
from bodyslam_jax.body import load_body_model
from bodyslam_jax.cli.settings import read_settings
from bodyslam_jax.config import Config, Known
from bodyslam_jax.export import lock
from bodyslam_jax.export.formats import read_observations
from bodyslam_jax.io import images, masks, video
from bodyslam_jax.io.bodies.reader import read_bodies
from bodyslam_jax.io.camera.calibration import read_camera
from bodyslam_jax.io.camera.path import read_camera_path
from bodyslam_jax.io.keypoints.reader import read_detections
from bodyslam_jax.io.safe_pickle import restricted_load
from bodyslam_jax.io.tracks import read_tracks
from bodyslam_jax.motion import load_motion_model, read_motion
from bodyslam_jax.motion.contact_network import load_contact_model
from bodyslam_jax.pipeline.stage_cache import Cache, save
from bodyslam_jax.types import Intrinsics, Result, Tracks

NUM, WIDTH, HEIGHT = 8, 64, 48
TIMES = np.arange(NUM) / 30
CAMERA = Intrinsics(np.array([80.0, 82.0, 30.0, 25.0]), WIDTH, HEIGHT)


@dataclasses.dataclass(frozen=True)
class Target:
    """A reader and one kind of its files."""

    name: str
    file: str
    """Path of the mutated file in a folder of its own."""
    form: str
    """As in `fuzz_mutations.DUMPS`, or the kind of bytes that `seed` gives."""
    seed: Callable[[], Any]
    """The content: values of the form, or bytes."""
    read: Callable[[Path], Any]
    beside: Callable[[], dict[str, bytes]] = dict
    """Other files of the folder, which are not mutated."""
    may_be_nan: tuple[str, ...] = ()
    """Ends of places in the result that may be NaN."""


def _bodies(path: Path, num_frames: int | None = NUM) -> Any:
    return read_bodies(path, num_frames=num_frames, intrinsics=CAMERA, fps=30.0)


def _detections(path: Path) -> Any:
    return read_detections(path, num_frames=NUM, width=WIDTH, height=HEIGHT)


def _camera(path: Path) -> Any:
    return read_camera(path, (WIDTH, HEIGHT))


def _path(path: Path) -> Any:
    warn = lambda text: None
    return read_camera_path(path, timestamps=TIMES, metric=False, warn=warn)


def _tracks(path: Path) -> Any:
    return read_tracks(path, num_frames=NUM, size=(WIDTH, HEIGHT))


def _sequence(path: Path) -> Any:
    return io.read_sequence(path.parent, known=Known(fps=30.0))


def _masks(path: Path) -> Any:
    return [masks.read_named(path, name) for name in masks.mask_names(path)[:4]]


def _footage(path: Path) -> Any:
    found = video.look_at(path)
    return found, [frame.shape for frame in video.frames(path)]


def _stage(path: Path) -> Any:
    """Whatever the file holds, the stage is there."""
    kept = Tracks(np.zeros(2, int), np.zeros(2, int), np.ones((2, 2)))
    found = Cache(path.parent).stage("tracks", "a", Tracks, lambda: kept)
    assert isinstance(found, Tracks) and len(found.frame) == len(found.uv)
    return found


def _observations(path: Path) -> Any:
    landmarks = np.zeros((3, 3))
    empty = np.zeros((0, NUM, 72))
    fields = {"poses": empty, "trans": empty[..., :3], "betas": np.zeros((0, 10))}
    fields |= {"joints": np.zeros((0, NUM, 24, 3)), "present": np.zeros((0, NUM), bool)}
    T_WC = np.tile(np.eye(4), (NUM, 1, 1))
    result = Result(TIMES, T_WC, 1.0, CAMERA.params, landmarks, **fields)
    return read_observations(path.parents[1], result)


def _lock(path: Path) -> None:
    lock.STALE_AFTER_S = 0.02
    with lock.locked(path.parent):
        pass


def _batch(path: Path) -> Any:
    """The table of a batch, of which one file is damaged; the others stay in it."""
    home = path.parents[2] if path.parent.parent.name == "runs" else path.parent
    found = rows.read_rows(home)
    assert any(row["name"] == "whole" and row["status"] == "ok" for row in found)
    columns = rows.present(rows.columns(), found)
    forms = (rows.to_csv, rows.to_markdown, rows.to_latex)
    texts = [form(columns, found) for form in forms]
    return [{k: v for k, v in row.items()} for row in found], texts


def _record(path: Path) -> Any:
    return record.read(path.parent), record.begun_for(path.parent)


def _scene(path: Path) -> Any:
    return len(view.scene_page(view.read_runs(path)))


def _run(path: Path) -> Any:
    """A run folder, and what is shown of it."""
    result = evaluation.read_result(path.parent)
    shown = view.scene_data(result, _body())
    return result, {k: v for k, v in shown.items() if not isinstance(v, dict)}


_BODY = []


def _body() -> Any:
    if not _BODY:
        _BODY.append(load_body_model())
    return _BODY[0]


def _truth(path: Path) -> Any:
    return evaluation.read_groundtruth(path.parent, _body())


def _3dpw(path: Path) -> None:
    with tempfile.TemporaryDirectory() as out:
        evaluation.convert_3dpw(path, Path(out) / "sequence")


def warm_up() -> None:
    """Loads what readers import late, and compiles what they run."""
    _body()
    with tempfile.TemporaryDirectory() as folder:
        for target in TARGETS:
            path = Path(folder) / target.name / target.file
            write(target, path, dumped(target))
            # Whether it is read is a test's to say.
            with contextlib.suppress(ValueError):
                target.read(path)


def dumped(target: Target) -> bytes:
    """The well-formed input."""
    import random

    import fuzz_mutations

    seed = target.seed()
    if target.form in fuzz_mutations.DUMPS:
        return fuzz_mutations.DUMPS[target.form](seed, random.Random(0))
    return bytes(seed)


def write(target: Target, path: Path, content: bytes) -> None:
    """The input at `path`, which ends in `target.file`, and what belongs beside it."""
    home = path
    for _ in Path(target.file).parts:
        home = home.parent
    for name, other in target.beside().items():
        (home / name).parent.mkdir(parents=True, exist_ok=True)
        (home / name).write_bytes(other)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)


# Well-formed inputs


def _tool(name: str) -> Callable[[], Any]:
    def seed() -> Any:
        from test_frontend_readers import _tool_files

        return _tool_files()[name][1]

    return seed


def _contract() -> Any:
    from test_frontend_readers import bodies

    return bodies() | {"person": np.zeros(NUM, int)}


def _torch() -> bytes:
    from test_frontend_readers import _torch_file

    return _torch_file(np.arange(6), (3, 2), (1, 3))


def _joblib_array() -> Any:
    import base64
    import zlib

    from test_frontend_readers import JOBLIB

    return zlib.decompress(base64.b64decode(JOBLIB))


def _detector(name: str) -> Callable[[], Any]:
    def seed() -> Any:
        from test_frontend_readers import JSON_FILES

        return JSON_FILES[name]

    return seed


def _person() -> np.ndarray:
    from test_frontend_readers import person

    return person()


def _openpose() -> Any:
    points = _person().ravel().tolist()
    one = {"person_id": [-1], "pose_keypoints_2d": points}
    return {"version": 1.3, "people": [one, one]}


def _openpose_others() -> dict[str, bytes]:
    text = json.dumps(_openpose()).encode()
    return {f"k/a_{k:012d}_keypoints.json": text for k in range(NUM) if k != 3}


def _vitpose() -> Any:
    points = _person()[:, [1, 0, 2]].tolist()
    names = {str(k): f"joint {k}" for k in range(25)}
    return {"keypoints": [{"0": points, "1": points}] * NUM, "skeleton": names}


def _camera_json() -> Any:
    params = [80.0, 82.0, 30.0, 25.0, -0.1, 0.01, 0.0, 0.0]
    size = {"width": WIDTH, "height": HEIGHT}
    return {"model": "OPENCV", **size, "params": params, "fps": 30.0}


COLMAP_CAMERAS = b"""# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
# Number of cameras: 1
1 PINHOLE 64 48 80.0 82.0 30.5 25.5
"""


def _colmap_images() -> bytes:
    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME"]
    for k in range(NUM):
        lines += [f"{k + 1} 1.0 0.0 0.0 0.0 {0.1 * k} 0.0 0.5 1 frame_{k:06d}.jpg"]
        lines += ["10.5 12.5 -1 20.0 22.0 4"]
    return ("\n".join(lines) + "\n").encode()


def _colmap_cameras_bin() -> bytes:
    head = struct.pack("<QiiQQ", 1, 1, 1, WIDTH, HEIGHT)
    return head + struct.pack("<4d", 80.0, 82.0, 30.5, 25.5)


def _colmap_images_bin() -> bytes:
    content = struct.pack("<Q", NUM)
    for k in range(NUM):
        content += struct.pack("<i7di", k + 1, 1, 0, 0, 0, 0.1 * k, 0, 0.5, 1)
        content += f"frame_{k:06d}.jpg".encode() + b"\0"
        content += struct.pack("<Q", 2) + 2 * struct.pack("<ddq", 1.0, 2.0, -1)
    return content


def _nerf() -> Any:
    frames = []
    for k in range(NUM):
        T = np.diag([1.0, -1.0, -1.0, 1.0])
        T[0, 3] = 0.1 * k
        one = {"file_path": f"images/frame_{k:06d}.jpg", "transform_matrix": T.tolist()}
        frames.append(one)
    size = {"w": WIDTH, "h": HEIGHT, "fl_x": 80.0, "fl_y": 82.0, "cx": 30.0, "cy": 25.0}
    return {"camera_model": "OPENCV", **size, "k1": 0.01, "frames": frames}


def _record3d() -> Any:
    poses = [[0.0, 0.0, 0.0, 1.0, 0.1 * k, 0.0, 0.0] for k in range(NUM)]
    K = [80.0, 0.0, 0.0, 0.0, 82.0, 0.0, 30.0, 25.0, 1.0]
    return {"w": WIDTH, "h": HEIGHT, "fps": 30, "K": K, "poses": poses}


def _r3d() -> bytes:
    import io as io_
    import zipfile

    stream = io_.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("metadata", json.dumps(_record3d()))
    return stream.getvalue()


def _stray() -> Any:
    head = ["timestamp", "frame", "x", "y", "z", "qx", "qy", "qz", "qw"]
    rows = [[7000 + k / 30, k, 0.1 * k, 0, 0, 0, 0, 0, 1] for k in range(NUM)]
    return [head, *rows]


def _tum() -> bytes:
    lines = [f"{k / 30} {0.1 * k} 0 0.5 0 0 0 1" for k in range(NUM)]
    return "\n".join(["# t x y z qx qy qz qw", *lines, ""]).encode()


def _track_arrays() -> Any:
    frame, landmark = (a.ravel() for a in np.mgrid[:NUM, :20])
    uv = np.random.default_rng(0).uniform(5, 40, (len(frame), 2))
    return {"frame": frame, "landmark": landmark, "uv": uv}


def _whole_sequence() -> dict[str, bytes]:
    import io as io_

    def npz(arrays: Any) -> bytes:
        stream = io_.BytesIO()
        np.savez(stream, **arrays)
        return stream.getvalue()

    camera = json.dumps(_camera_json()).encode()
    arrays = {"tracks.npz": npz(_track_arrays()), "bodies.npz": npz(_contract())}
    return {"s/camera.json": camera, **{f"s/{n}": x for n, x in arrays.items()}}


def _image(suffix: str) -> Callable[[], bytes]:
    def seed() -> bytes:
        import cv2

        picture = np.random.default_rng(0).integers(
            0, 255, (HEIGHT, WIDTH, 3), np.uint8
        )
        return cv2.imencode(suffix, picture)[1].tobytes()

    return seed


def _film() -> bytes:
    from test_frontend_readers import video as write_video

    with tempfile.TemporaryDirectory() as folder:
        return write_video(Path(folder) / "a.mp4").read_bytes()


def _settings() -> Any:
    import yaml

    from bodyslam_jax.export import to_yaml

    return yaml.safe_load(to_yaml(Config(height=("1.78±0.01",), person=(0, 1))))


def _written(write_file: str, *args: Any) -> Callable[[], bytes]:
    """The content of a file that a function of the tests for motion writes."""

    def seed() -> bytes:
        import test_motion_data

        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"a{args[0]}"
            made = [
                getattr(test_motion_data, a) if isinstance(a, str) else a
                for a in args[1:]
            ]
            getattr(test_motion_data, write_file)(path, *made)
            return path.read_bytes()

    return seed


def _arrays_of(content: Callable[[], bytes]) -> Callable[[], Any]:
    def seed() -> Any:
        import io as io_

        with np.load(io_.BytesIO(content()), allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}

    return seed


def _asset(name: str) -> Callable[[], bytes]:
    from bodyslam_jax.motion import weights

    return lambda: (Path(weights.__file__).parent / "assets" / name).read_bytes()


BVH = b"""HIERARCHY
ROOT Hips
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Yrotation Xrotation
%sMOTION
Frames: 12
Frame Time: 0.008333
%s"""


def _bvh() -> bytes:
    def leg(side: str, x: int) -> str:
        names = (f"{side}UpLeg", f"{side}Leg", f"{side}Foot", f"{side}ToeBase")
        offsets = (f"{x} -4 0", "0 -40 0", "0 -40 0", "0 -5 15")
        text = ""
        for name, offset in zip(names, offsets, strict=True):
            text += f"JOINT {name}\n{{\nOFFSET {offset}\n"
            text += "CHANNELS 3 Zrotation Yrotation Xrotation\n"
        return text + "End Site\n{\nOFFSET 0 0 5\n}\n" + "}\n" * 4

    legs = leg("Left", 9) + leg("Right", -9) + "}\n"
    row = " ".join(["0 90 0"] + ["1 2 3"] * 9)
    return BVH % (legs.encode(), "\n".join([row] * 12).encode() + b"\n")


def _smpl() -> Any:
    from body_cases import make_raw

    return make_raw()


def _run_arrays() -> Any:
    rng = np.random.default_rng(0)
    h, T_WC = 2, np.tile(np.eye(4), (NUM, 1, 1))
    return {
        "timestamps": TIMES,
        "T_WC": T_WC,
        "scale": np.array(1.5),
        "intrinsics": CAMERA.params,
        "landmarks": rng.normal(size=(6, 3)),
        "poses": rng.normal(0, 0.3, (h, NUM, 72)),
        "trans": rng.normal(size=(h, NUM, 3)),
        "betas": rng.normal(size=(h, 10)),
        "joints": rng.normal(size=(h, NUM, 24, 3)),
        "present": np.ones((h, NUM), bool),
        "joint_sigma": np.full((h, NUM, 24), 0.02),
        "root_sigma": np.full((h, NUM, 3), 0.1),
    }


def _summary() -> Any:
    person = {"status": "ok", "reasons": [], "stature_m": 1.7, "speed_m_s": 1.0}
    return {
        "status": "doubtful",
        "reasons": [{"message": "feet slide.", "advice": "look", "status": "doubtful"}],
        "input": {
            "name": "a",
            "frames": NUM,
            "width": WIDTH,
            "height": HEIGHT,
            "fps": 30.0,
        },
        "settings": {"body_model": None},
        "camera_motion": "moving",
        "camera_path_m": 2.5,
        "scale": {"value": 1.5, "sigma": 0.1},
        "people": [person, person | {"stature_sigma_m": 0.03, "place_sigma_m": 0.1}],
        "frames_used": [0, NUM - 1],
        "durations_s": {"joint": 3.0, "cameras": 2.0},
        "errors": {"joint estimate, in metres": {"c_ate_se3": 0.05, "h_ate_se3": "no"}},
    }


def _run_file(name: str) -> Callable[[], dict[str, bytes]]:
    def beside() -> dict[str, bytes]:
        import io as io_

        stream = io_.BytesIO()
        np.savez(stream, **_run_arrays())
        files = {"r/result.npz": stream.getvalue()}
        files["r/summary.json"] = json.dumps(_summary()).encode()
        return {other: content for other, content in files.items() if other != name}

    return beside


def _whole_run() -> dict[str, bytes]:
    """Of a batch: a run that stays as it is."""
    summary = json.dumps(_summary() | {"status": "ok"}).encode()
    return {"runs/whole/summary.json": summary}


def _failed() -> bytes:
    line = {"name": "b", "status": "error", "message": "b.mp4: no frames."}
    return b"".join(json.dumps(line | {"name": n}).encode() + b"\n" for n in "bcd")


def _job() -> Any:
    hashes = {"source": "a" * 16, "settings": "b" * 16, "stamp": "c" * 16}
    return {**hashes, "status": "ok", "message": "", "seconds": 1.5, "summary": _HASH}


_HASH = "44136fa355b3678a"
"""Of `{}`: its SHA-256 begins so."""


def _stage_file() -> bytes:
    arrays = _track_arrays()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.npz"
        save(path, Tracks(arrays["frame"], arrays["landmark"], arrays["uv"]))
        return path.read_bytes()


def _observed() -> Any:
    return {
        ".tracks.frame": np.arange(6),
        ".tracks.landmark": np.arange(6) % 3,
        ".tracks.uv": np.ones((6, 2)),
        ".keep": np.ones(6, bool),
        ".landmarks": np.zeros((3, 3)),
        ".zoom": np.zeros(NUM),
    }


def _page() -> bytes:
    run = json.dumps(
        {"name": "a", "times": {"data": "AAAA"}, "people": [{"number": 0}]}
    )
    return f'<p><script type="application/json" class="run">{run}</script>'.encode()


def _manifest() -> Any:
    head = ["name", "video", "camera", "height", "options"]
    return [head, ["a", "s", "camera.json", "1.78", "--fps 25"], ["b", "s", "", "", ""]]


def _clip() -> dict[str, bytes]:
    found = {n: x for n, x in _whole_sequence().items()}
    return found | {"camera.json": json.dumps(_camera_json()).encode()}


def _motion_of_dataset() -> Any:
    return {
        "poses": np.zeros((NUM, 72)),
        "trans": np.zeros((NUM, 3)),
        "betas": np.zeros(10),
        "joints": np.zeros((NUM, 24, 3)),
        "mocap_framerate": np.array(30.0),
        "present": np.ones(NUM, bool),
    }


def _3dpw_data() -> Any:
    rng = np.random.default_rng(0)
    return {
        "sequence": "x",
        "cam_poses": np.tile(np.eye(4), (NUM, 1, 1)),
        "cam_intrinsics": np.array([[80.0, 0, 30], [0, 82, 25], [0, 0, 1]]),
        "poses": [rng.normal(0, 0.3, (NUM, 72))],
        "trans": [rng.normal(size=(NUM, 3))],
        "betas": [rng.normal(size=10)],
        "jointPositions": [rng.normal(size=(NUM, 72))],
        "campose_valid": [np.ones(NUM, bool)],
        "genders": ["m"],
        "poses2d": [rng.uniform(5, 40, (NUM, 3, 18))],
    }


def _3dpw_images() -> dict[str, bytes]:
    picture = _image(".jpg")()
    return {f"imageFiles/x/image_{k:05d}.jpg": picture for k in range(NUM)}


def _emdb_data() -> Any:
    rng = np.random.default_rng(0)
    T_CW = np.tile(np.eye(4), (NUM, 1, 1))
    K = np.array([[80.0, 0, 30], [0, 82, 25], [0, 0, 1]])
    size = {"width": WIDTH, "height": HEIGHT}
    return {
        "gender": "neutral",
        "n_frames": NUM,
        "good_frames_mask": np.arange(NUM) != 2,
        "camera": {"intrinsics": K, "extrinsics": T_CW, **size},
        "smpl": {
            "poses_root": rng.normal(0, 0.3, (NUM, 3)),
            "poses_body": rng.normal(0, 0.3, (NUM, 69)),
            "trans": rng.normal(size=(NUM, 3)),
            "betas": np.zeros(10),
        },
    }


def _emdb(path: Path) -> None:
    with tempfile.TemporaryDirectory() as out:
        model = path.parent.parent / "SMPL_NEUTRAL.npz"
        evaluation.convert_emdb(path.parent, Path(out) / "sequence", model)


def _folder_of_images(
    name: str, without: int | None = None
) -> Callable[[], dict[str, bytes]]:
    def beside() -> dict[str, bytes]:
        picture = _image(".png")()
        return {f"{name}/{k:05d}.png": picture for k in range(NUM) if k != without}

    return beside


def _track_info() -> Any:
    return {
        "meta": {"seq_interval": [0, NUM], "data_interval": [0, NUM]},
        "tracks": {"1": {"index": 0, "vis_mask": [True] * NUM}},
    }


def _npz_of(seed: Callable[[], Any], name: str) -> Callable[[], dict[str, bytes]]:
    def beside() -> dict[str, bytes]:
        import random

        import fuzz_mutations

        return {name: fuzz_mutations.DUMPS["npz"](seed(), random.Random(0))}

    return beside


def _points(form: str) -> Any:
    points = np.stack([np.stack([_person(), _person() + [9, 0, 0]])] * NUM, axis=1)
    if form == "a":
        return {"keypoints": points}
    return {"uv": points[..., :2], "confidence": points[..., 2]}


_BODY_FILES = {
    "VIBE": "pickle",
    "WHAM": "pickle",
    "4D-Humans": "pickle",
    "GVHMR": "pickle",
    "PromptHMR": "pickle",
    "CLIFF": "npz",
    "SLAHMR": "npz",
    "GLAMR": "npz",
    "AMASS": "npz",
    "TRAM": "npy",
}
_SUFFIX = {"pickle": ".pkl", "npz": ".npz", "npy": ".npy"}

TARGETS: list[Target] = [
    *(
        Target(f"bodies_{tool}", f"b{_SUFFIX[form]}", form, _tool(tool), _bodies)
        for tool, form in _BODY_FILES.items()
    ),
    Target(
        *("bodies_SLAHMR_info", "s/track_info.json", "json", _track_info),
        lambda path: _bodies(path.parent / "b.npz"),
        _npz_of(_tool("SLAHMR"), "s/b.npz"),
    ),
    Target(
        *("bodies_TRAM_folder", "hps/hps_track_0.npy", "npy", _tool("TRAM")),
        lambda path: _bodies(path.parent),
    ),
    Target("bodies_npz", "bodies.npz", "npz", _contract, _bodies),
    Target(
        *("bodies_alone", "bodies.npz", "npz", _contract),
        lambda path: _bodies(path, None),
    ),
    Target("bodies_joblib", "b.pkl", "joblib", _tool("WHAM"), _bodies),
    Target(
        "pickle",
        "a.pkl",
        "pickle",
        _tool("4D-Humans"),
        restricted_load,
        may_be_nan=("",),
    ),
    Target(
        "pickle_joblib",
        "a.pkl",
        "bytes",
        _joblib_array,
        restricted_load,
        may_be_nan=("",),
    ),
    Target("pickle_torch", "a.pt", "pt", _torch, restricted_load, may_be_nan=("",)),
    Target("keypoints_npz", "k.npz", "npz", lambda: _points("a"), _detections),
    Target("keypoints_uv", "k.npz", "npz", lambda: _points("b"), _detections),
    Target(
        *("keypoints_openpose", "k/a_000000000003_keypoints.json", "json", _openpose),
        lambda path: _detections(path.parent),
        _openpose_others,
    ),
    *(
        Target(f"keypoints_{name}", "k.json", "json", _detector(name), _detections)
        for name in ("alphapose", "coco", "mmpose")
    ),
    Target("keypoints_vitpose", "k.json", "json", _vitpose, _detections),
    Target("camera_json", "camera.json", "json", _camera_json, _camera),
    Target("camera_colmap", "cameras.txt", "text", lambda: COLMAP_CAMERAS, _camera),
    Target("camera_colmap_bin", "cameras.bin", "bytes", _colmap_cameras_bin, _camera),
    Target("camera_nerfstudio", "transforms.json", "json", _nerf, _camera),
    Target("camera_record3d", "metadata.json", "json", _record3d, _camera),
    Target("camera_r3d", "a.r3d", "zip", _r3d, _camera),
    Target(
        *("camera_stray", "camera_matrix.csv", "csv"),
        lambda: [[80.0, 0.0, 30.0], [0.0, 82.0, 25.0], [0.0, 0.0, 1.0]],
        _camera,
    ),
    Target("path_tum", "camera.txt", "text", _tum, _path),
    Target("path_colmap", "images.txt", "text", _colmap_images, _path),
    Target("path_colmap_bin", "images.bin", "bytes", _colmap_images_bin, _path),
    Target("path_nerfstudio", "transforms.json", "json", _nerf, _path),
    Target("path_record3d", "metadata.json", "json", _record3d, _path),
    Target("path_r3d", "a.r3d", "zip", _r3d, _path),
    Target("path_stray", "odometry.csv", "csv", _stray, _path),
    Target("tracks", "tracks.npz", "npz", _track_arrays, _tracks),
    *(
        Target(f"sequence_{name}", f"s/{file}", form, seed, _sequence, _whole_sequence)
        for name, file, form, seed in (
            ("camera", "camera.json", "json", _camera_json),
            ("tracks", "tracks.npz", "npz", _track_arrays),
            ("bodies", "bodies.npz", "npz", _contract),
        )
    ),
    Target(
        *("masks_npz", "m.npz", "npz"),
        lambda: {"masks": np.eye(HEIGHT, WIDTH, dtype=np.uint8)[None].repeat(NUM, 0)},
        _masks,
    ),
    Target("masks_png", "m.png", "bytes", _image(".png"), masks.read_mask),
    *(
        Target(
            f"image_{kind}", f"i.{kind}", "bytes", _image(f".{kind}"), images.read_image
        )
        for kind in ("png", "jpg", "webp", "bmp", "tiff")
    ),
    Target(
        *("images_folder", "images/00003.png", "bytes", _image(".png")),
        lambda path: _footage(path.parent),
        _folder_of_images("images", 3),
    ),
    Target("video", "v.mp4", "bytes", _film, _footage),
    Target(
        *("settings", "config.yaml", "yaml", _settings),
        lambda path: dataclasses.asdict(read_settings(path, Config())),
        may_be_nan=("",),  # settings may be infinite
    ),
    Target("manifest", "clips.csv", "csv", _manifest, read_manifest, _clip),
    Target("motion_bvh", "a.bvh", "text", _bvh, read_motion),
    Target(
        *("motion_amass", "a.npz", "npz"),
        _arrays_of(_written("write_amass", ".npz")),
        read_motion,
    ),
    Target(
        *("motion_model", "m.npz", "npz"),
        _arrays_of(_asset("default.npz")),
        load_motion_model,
    ),
    Target(
        *("contact_model", "c.npz", "npz"),
        _arrays_of(_asset("contact.npz")),
        load_contact_model,
    ),
    Target("body_npz", "b.npz", "npz", _smpl, load_body_model),
    Target("body_pickle", "b.pkl", "pickle", _smpl, load_body_model),
    Target(
        "run_result",
        "r/result.npz",
        "npz",
        _run_arrays,
        _run,
        _run_file("r/result.npz"),
    ),
    Target(
        *("run_summary", "r/summary.json", "json", _summary, _run),
        _run_file("r/summary.json"),
        may_be_nan=("",),  # what no reader uses
    ),
    Target(
        *("truth_body", "t/body.npz", "npz", _motion_of_dataset, _truth),
        lambda: {"t/camera.txt": _tum()},
    ),
    Target("truth_camera", "t/camera.txt", "text", _tum, _truth),
    Target(
        "3dpw", "sequenceFiles/test/x.pkl", "pickle", _3dpw_data, _3dpw, _3dpw_images
    ),
    Target(
        *("emdb", "e/a_data.pkl", "pickle", _emdb_data, _emdb),
        lambda: _folder_of_images("e/images")() | _npz_of(_smpl, "SMPL_NEUTRAL.npz")(),
    ),
    Target(
        *("truth_landmarks", "t/landmarks.npy", "npy"),
        lambda: np.random.default_rng(0).normal(size=(9, 3)),
        *(_truth, lambda: {"t/camera.txt": _tum()}),
    ),
    Target("stage", ".cache/tracks-a.npz", "zip", _stage_file, _stage),
    Target(
        "stage_observations", ".cache/cameras-0.npz", "npz", _observed, _observations
    ),
    Target("scene_page", "scene.html", "text", _page, _scene),
    Target("lock", ".lock", "json", lambda: {"host": "node17", "pid": 4}, _lock),
    Target(
        *("batch_summary", "runs/other/summary.json", "json", _summary, _batch),
        _whole_run,
    ),
    Target("batch_failed", "failed.jsonl", "text", _failed, _batch, _whole_run),
    Target(
        *("batch_mark", "batch.json", "json"),
        lambda: {"clips": {"whole": "a.mp4", "b": "b.mp4"}},
        *(_batch, _whole_run),
    ),
    Target(
        *("batch_record", "runs/a/.job.json", "json", _job, _record),
        lambda: {"runs/a/summary.json": b"{}"},
    ),
]
"""All readers of inputs, of run folders and of batches."""
