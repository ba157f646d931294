"""Everybody's files: what is read, and what is refused in one line naming the file."""

import base64
import io
import json
import os
import pickle
import shutil
import zipfile
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from body_cases import crop_camera
from scipy.spatial.transform import Rotation

from bodyslam_jax.config import Association
from bodyslam_jax.io import read_sequence
from bodyslam_jax.io.bodies.body_format import body_formats
from bodyslam_jax.io.bodies.parts import full_translation
from bodyslam_jax.io.bodies.reader import read_bodies
from bodyslam_jax.io.camera.calibration import (
    as_opencv,
    guess_camera,
    project_points,
    rays,
    read_camera,
)
from bodyslam_jax.io.formats import Source
from bodyslam_jax.io.frame_index import gap_among
from bodyslam_jax.io.keypoints.associate import associate
from bodyslam_jax.io.keypoints.keypoint_format import keypoint_formats
from bodyslam_jax.io.keypoints.layouts import from_layout, usual_layout
from bodyslam_jax.io.keypoints.reader import read_detections
from bodyslam_jax.io.safe_pickle import restricted_load
from bodyslam_jax.types import Intrinsics, Keypoints

NUM, WIDTH, HEIGHT = 8, 64, 48
CAMERA = Intrinsics(np.array([80.0, 82.0, 30.0, 25.0]), WIDTH, HEIGHT)
SHARED = Path(__file__).parents[2] / "shared"


def person(x: float = 30.0, y: float = 20.0, size: float = 25.0) -> np.ndarray:
    """A standing BODY_25 person (25, 3)."""
    rng = np.random.default_rng(0)
    uv = rng.uniform([-0.2, -0.5], [0.2, 0.5], (25, 2)) * size + [x, y]
    return np.concatenate([uv, np.full((25, 1), 0.9)], axis=-1)


def openpose(folder: Path, people: list[list[np.ndarray]], key="pose_keypoints_2d"):
    """One OpenPose file per frame."""
    folder.mkdir(parents=True, exist_ok=True)
    for k, found in enumerate(people):
        entries = [{"person_id": [-1], key: p.ravel().tolist()} for p in found]
        data = {"version": 1.3, "people": entries}
        (folder / f"a_{k:012d}_keypoints.json").write_text(json.dumps(data))
    return folder


def video(path: Path, num: int = NUM) -> Path:
    writer = cv2.VideoWriter(
        str(path), cv2.VideoWriter.fourcc(*"mp4v"), 25, (WIDTH, HEIGHT)
    )
    rng = np.random.default_rng(0)
    for _ in range(num):
        writer.write(rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8))
    writer.release()
    return path


def bodies(num: int = NUM) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    return {
        "frame": np.arange(num),
        "poses": rng.normal(0, 0.3, (num, 72)),
        "betas": rng.normal(size=(num, 10)),
        "trans": rng.uniform([-1, -1, 3], [1, 1, 5], (num, 3)),
    }


def detections(path: Path, **changes) -> list[np.ndarray]:
    size = {"num_frames": NUM, "width": WIDTH, "height": HEIGHT} | changes
    return read_detections(path, **size).points


def read(path: Path):
    return read_bodies(path, num_frames=NUM, intrinsics=CAMERA)


# Keypoints


@pytest.mark.parametrize("key", ["pose_keypoints_2d", "pose_keypoints"])
def test_openpose(tmp_path, key):
    people = [[person(), person(45.0)]] * (NUM - 1) + [[]]
    found = detections(openpose(tmp_path, people, key))
    assert [len(f) for f in found] == [2] * (NUM - 1) + [0]
    np.testing.assert_allclose(found[0][1], person(45.0))


@pytest.mark.parametrize("low", [0.0, -1.0])
def test_openpose_normalised_to_the_image(tmp_path, low):
    scaled = person()
    scaled[:, :2] /= [WIDTH - 1, HEIGHT - 1]
    scaled[:, :2] = scaled[:, :2] * (1 - low) + low
    found = detections(openpose(tmp_path, [[scaled]] * NUM))
    np.testing.assert_allclose(found[3][0], person())


def test_a_point_without_confidence_is_missing_not_at_the_origin(tmp_path):
    holed = person()
    holed[4] = [7.0, 7.0, 0.0]
    found = detections(openpose(tmp_path, [[holed]] * NUM))
    np.testing.assert_array_equal(found[0][0, 4], 0.0)


def in_usual_order(points: np.ndarray) -> np.ndarray:
    """BODY_25 of keypoints in the usual layout of as many."""
    layout = usual_layout(len(points))
    assert layout is not None
    return from_layout(points, layout.parts)


def test_layouts_agree_on_the_body():
    """Each layout's left wrist, neck and middle of the hips, at their BODY_25 index."""
    points = lambda n: np.stack([np.arange(n), 2.0 * np.arange(n), np.ones(n)], axis=-1)
    coco18 = in_usual_order(points(18))
    assert coco18[7, 0] == 7 and coco18[1, 0] == 1
    assert coco18[8, 0] == (8 + 11) / 2 and coco18[19:, 2].max() == 0
    coco17 = in_usual_order(points(17))
    assert coco17[7, 0] == 9 and coco17[1, 0] == (5 + 6) / 2 and coco17[12, 0] == 11
    halpe = in_usual_order(points(26))
    assert halpe[7, 0] == 9 and halpe[1, 0] == 18 and halpe[8, 0] == 19
    assert halpe[19:, 0].tolist() == [20, 22, 24, 21, 23, 25]
    np.testing.assert_array_equal(in_usual_order(points(25)), points(25))
    np.testing.assert_array_equal(in_usual_order(points(136)), halpe)
    whole = in_usual_order(points(133))
    np.testing.assert_array_equal(whole[:19], coco17[:19])
    assert whole[19:, 0].tolist() == [17, 18, 19, 20, 21, 22]


def _flat(points: np.ndarray) -> list[float]:
    return points[:17].ravel().tolist()


JSON_FILES = {
    "alphapose": [
        {"image_id": f"{k}.jpg", "keypoints": _flat(person()), "score": 2.5}
        for k in range(NUM)
    ],
    "coco": {
        "images": [{"id": 90 + k, "file_name": f"f_{k + 1}.png"} for k in range(NUM)],
        "annotations": [
            {"image_id": 90 + k, "keypoints": _flat(person())} for k in range(NUM)
        ],
    },
    "mmpose": {
        "meta_info": {},
        "instance_info": [
            {
                "frame_id": k,
                "instances": [
                    {
                        "keypoints": person()[:17, :2].tolist(),
                        "keypoint_scores": person()[:17, 2].tolist(),
                    }
                ],
            }
            for k in range(NUM)
        ],
    },
}


@pytest.mark.parametrize("kind", list(JSON_FILES))
def test_json_of_other_detectors(tmp_path, kind):
    file = tmp_path / "found.json"
    file.write_text(json.dumps(JSON_FILES[kind]))
    found = detections(file)
    assert [len(f) for f in found] == [1] * NUM
    np.testing.assert_allclose(found[-1][0], in_usual_order(person()[:17]))


def test_generic_archive(tmp_path):
    points = np.stack([np.stack([person(), person(45.0)])] * NUM, axis=1)
    np.savez(tmp_path / "a.npz", keypoints=points)
    np.savez(tmp_path / "b.npz", uv=points[..., :2], confidence=points[..., 2])
    for name in ("a.npz", "b.npz"):
        assert [len(f) for f in detections(tmp_path / name)] == [2] * NUM


def _other(people):
    return lambda folder: openpose(folder / "k", people)


def _text(name, text):
    def make(folder: Path) -> Path:
        (folder / name).write_text(text)
        return folder / name

    return make


def _npz(name="k.npz", **arrays):
    def make(folder: Path) -> Path:
        np.savez(folder / name, **arrays)
        return folder / name

    return make


def _nan():
    bad = person()
    bad[3:, 0] = np.nan
    return bad


BAD_KEYPOINTS = {
    "missing": (lambda folder: folder / "nothing", "no such file"),
    "empty folder": (lambda folder: folder, "no \\*_keypoints.json"),
    "text": (_text("a.json", "hello"), "line 1: not JSON"),
    "unknown json": (
        _text("a.json", '{"a": 1}'),
        "not keypoints of .*AlphaPose, COCO, MMPose or easy_ViTPose, but ..a.",
    ),
    "nobody": (_other([[]] * NUM), "no person"),
    "all missing": (_other([[person() * [1, 1, 0]]] * NUM), "all confidences are zero"),
    "nan": (_other([[_nan()]] * NUM), "NaN or infinity"),
    "longer video": (_other([[person()]] * (NUM + 5)), "frames 0 to 12"),
    "larger video": (_other([[person(900.0, 700.0)]] * NUM), "outside the image"),
    "odd layout": (
        _other([[person()[:21]]] * NUM),
        "21 keypoints a person, not 17, 18, 25, 26, 133 or 136",
    ),
    "no triples": (_other([[person()[:, :2]]] * NUM), "keypoints"),
    "wrong length": (_npz(keypoints=np.ones((3, 25, 3))), "of 3 frames"),
    "wrong array": (_npz(stuff=np.ones(3)), "no array `keypoints`"),
    "not an archive": (_text("a.npz", "hello"), "not a NumPy archive"),
    "objects": (_npz(keypoints=np.array([None])), "`keypoints` is a pickled object"),
}


@pytest.mark.parametrize("kind", list(BAD_KEYPOINTS))
def test_refuses_bad_keypoints(tmp_path, kind):
    make, message = BAD_KEYPOINTS[kind]
    with pytest.raises(ValueError, match=message) as caught:
        detections(make(tmp_path))
    assert "\n" not in str(caught.value)
    assert str(tmp_path) in str(caught.value)


# Association


def test_follows_people_through_crossing_order_and_gaps():
    """Two people cross at constant speed, are listed in random order, one has a gap."""
    rng = np.random.default_rng(0)
    num = 60
    left, right = np.linspace(10, 50, num), np.linspace(50, 10, num)
    frames = []
    for k in range(num):
        found = [person(left[k], 20.0), person(right[k], 24.0)]
        if 10 <= k < 15:
            found = found[:1]
        frames.append(np.stack([found[i] for i in rng.permutation(len(found))]))
    people, warnings = associate(frames, Association(), fps=30.0)
    assert people.uv.shape == (2, num, 25, 2) and warnings == ()
    seen = people.confidence.max(axis=-1) > 0
    assert sorted(seen.sum(axis=1).tolist()) == [num - 5, num]
    for track, there in zip(people.uv.mean(axis=2), seen, strict=True):
        speed = np.diff(track[there, 0])
        assert (speed > 0).all() or (speed < 0).all()  # nobody turns round


def test_drops_who_is_seen_too_briefly_and_who_is_too_many():
    frames = [np.stack([person(10.0), person(30.0), person(50.0)])] * 40
    frames[5] = np.concatenate([frames[5], person(30.0, 42.0, 5.0)[None]])
    people, warnings = associate(frames, Association(max_people=2), fps=30.0)
    assert len(people.uv) == 2 and "1 less visible" in warnings[0]
    assert "1 person detected for less than 0.4 s dropped" in warnings[1]


def test_a_jump_makes_another_person():
    frames = [person(10.0, 20.0, 12.0)[None]] * 20 + [
        person(55.0, 30.0, 12.0)[None]
    ] * 20
    people, warnings = associate(frames, Association(), fps=30.0)
    assert len(people.uv) == 2
    first, second = np.argsort(people.confidence[:, 0].max(axis=-1))[::-1]
    assert len(warnings) == 1
    assert f"person {second} may be person {first}" in warnings[0]
    assert "begins in frame 20, the other ends in frame 19" in warnings[0]


# Cameras


@pytest.mark.parametrize(
    "model, params, expected",
    [
        ("PINHOLE", [80, 82, 30, 25], [80, 82, 30, 25]),
        ("SIMPLE_RADIAL", [80, 30, 25, 0.1], [80, 80, 30, 25, 0.1, 0, 0, 0]),
        ("OPENCV", [80, 82, 30, 25, 1, 2, 3, 4], [80, 82, 30, 25, 1, 2, 3, 4]),
    ],
)
def test_camera_models(tmp_path, model, params, expected):
    data = {"model": model, "width": 64, "height": 48, "params": params, "fps": 30}
    (tmp_path / "camera.json").write_text(json.dumps(data))
    camera, fps = read_camera(tmp_path / "camera.json")
    np.testing.assert_array_equal(camera.params, expected)
    assert fps == 30 and not camera.is_guess


GOOD_CAMERA = {
    "model": "PINHOLE",
    "width": 64,
    "height": 48,
    "params": [80, 80, 30, 25],
}


@pytest.mark.parametrize(
    "change, message",
    [
        ({"model": "FISHEYE"}, "`model` is 'FISHEYE', expected"),
        ({"params": [80, 80, 30]}, "3 params for PINHOLE, not 4"),
        ({"params": [[80, 80, 30, 25]]}, r"`params` of shape \(1, 4\), expected"),
        ({"width": 64.5}, "`width` is 64.5, expected a whole number"),
        ({"height": float("inf")}, "`height` is inf, expected 1 to"),
        ({"height": True}, "`height` is True, expected a number"),
        ({"params": [80, -80, 30, 25]}, "not those of a camera"),
        ({"params": [80, "x", 30, 25]}, "`params` holds 'x', expected numbers"),
        ({"params": [80, float("nan"), 30, 25]}, "`params` not finite"),
        ({"params": [80, 80, 3000, 25]}, "far outside"),
        ({"width": 0}, "`width` is 0, expected 1 to"),
        ({"fps": -1}, "fps"),
    ],
)
def test_refuses_bad_cameras(tmp_path, change, message):
    file = tmp_path / "camera.json"
    file.write_text(json.dumps(GOOD_CAMERA | change))
    with pytest.raises(ValueError, match=message) as caught:
        read_camera(file)
    assert str(file) in str(caught.value) and "\n" not in str(caught.value)


def test_guesses_a_camera_and_reads_exif(tmp_path):
    from PIL import Image

    guess = guess_camera(640, 480)
    assert guess.is_guess and guess.params.tolist() == [768, 768, 319.5, 239.5]
    image = Image.new("RGB", (640, 480))
    exif = image.getexif()
    exif.get_ifd(0x8769)[0xA405] = 36  # mm, on film 36 mm wide
    image.save(tmp_path / "a.jpg", exif=exif)
    assert guess_camera(640, 480, tmp_path / "a.jpg").params[0] == 640


# Bodies


def test_contract_and_people(tmp_path):
    data = bodies()
    np.savez(tmp_path / "b.npz", **data)
    found = read(tmp_path / "b.npz")
    assert found.present.all() and found.present.shape == (1, NUM)
    np.testing.assert_array_equal(found.trans[0], data["trans"])
    twice = {k: np.concatenate([v, v[:3]]) for k, v in data.items()}
    np.savez(tmp_path / "c.npz", **twice, person=np.repeat([4, 2], [NUM, 3]))
    found = read(tmp_path / "c.npz")
    assert found.present.sum(axis=1).tolist() == [3, NUM]


@pytest.mark.parametrize("weak", [False, True])
@pytest.mark.parametrize("said", [None, True, False, 0])
def test_shapes_of_an_unknown_source_are_a_regressors(tmp_path, said, weak):
    data = bodies()
    if weak:
        data["bbox"] = np.tile([30.0, 25.0, 20.0], (NUM, 1))
        data["camera"] = crop_camera(data.pop("trans"), data["bbox"], CAMERA)
    if said is not None:
        data["shapes_regressed"] = np.array(said)
    np.savez(tmp_path / "b.npz", **data)
    assert read(tmp_path / "b.npz").shapes_regressed is (said is None or bool(said))


def test_weak_perspective_there_and_back():
    trans = bodies()["trans"]
    box = np.random.default_rng(0).uniform([10, 10, 15], [50, 40, 30], (NUM, 3))
    camera = crop_camera(trans, box, CAMERA)
    np.testing.assert_allclose(full_translation(camera, box, CAMERA), trans, atol=1e-6)
    # A point at the body's origin is where the crop says, also with fx != fy.
    fx, fy, cx, cy = CAMERA.params
    u = cx + fx * trans[:, 0] / trans[:, 2]
    v = cy + fy * trans[:, 1] / trans[:, 2]
    in_crop = box[:, :2] + box[:, 2:] / 2 * camera[:, :1] * camera[:, 1:]
    np.testing.assert_allclose(in_crop, np.stack([u, v], axis=-1))


def test_spin_turns_bodies_by_the_ray_of_their_crop(tmp_path):
    """A body that faces its crop's camera, off to the right, is turned to the right."""
    data = bodies()
    box = np.tile([30.0 + 80.0, 25.0, 20.0], (NUM, 1))  # 45 degrees to the right
    pose = np.zeros((NUM, 72))
    np.savez(
        tmp_path / "s.npz",
        pose=pose,
        betas=data["betas"],
        camera=crop_camera(data["trans"], box, CAMERA),
        bbox=box,
    )
    found = read(tmp_path / "s.npz")
    np.testing.assert_allclose(found.trans[0], data["trans"], atol=1e-6)
    assert found.shapes_regressed
    expected = np.tile([0, np.pi / 4, 0], (NUM, 1))
    np.testing.assert_allclose(found.poses[0, :, :3], expected, atol=1e-12)


def _refocused(trans: np.ndarray, focal: float) -> np.ndarray:
    """The same pixels through a camera of `focal` with the image's middle as centre."""
    fx, fy, cx, cy = CAMERA.params
    u = cx + fx * trans[:, 0] / trans[:, 2]
    v = cy + fy * trans[:, 1] / trans[:, 2]
    z = trans[:, 2] * focal / fx
    middle = (WIDTH - 1) / 2, (HEIGHT - 1) / 2
    return np.stack([(u - middle[0]) * z / focal, (v - middle[1]) * z / focal, z], -1)


def _tool_files() -> dict[str, tuple[str, dict]]:
    """For each tool a file name and contents that all mean `bodies()`."""
    b = bodies()
    poses, betas, trans, frame = b["poses"], b["betas"], b["trans"], b["frame"]
    box = np.tile([30.0, 25.0, 20.0], (NUM, 1))  # on the axis: the ray turns nothing
    weak = crop_camera(trans, box, CAMERA)
    matrices = Rotation.from_rotvec(poses.reshape(-1, 3)).as_matrix()
    matrices = matrices.reshape(NUM, 24, 3, 3)
    smpl, smplx = (
        np.array([-0.0018, -0.2233, 0.0282]),
        np.array([0.0031, -0.3514, 0.012]),
    )
    K = np.tile([[80.0, 0, 30], [0, 82, 25], [0, 0, 1]], (NUM, 1, 1))
    turn = Rotation.from_rotvec([0.1, 0.5, 0.2])
    world = turn.inv() * Rotation.from_rotvec(poses[:, :3])
    moved = turn.inv().apply(trans + smpl - [1.0, 2.0, 3.0]) - smpl
    focal = 5000 / 256 * 64
    phalp_box = np.array([20.0, 15.0, 20.0, 20.0])
    phalp = {
        f"x/{k + 1:06d}.jpg": {
            "time": k,
            "tid": [3],
            "tracked_time": [0],
            "bbox": [phalp_box],
            "camera": [_refocused(trans, focal)[k]],
            "smpl": [
                {
                    "global_orient": matrices[k, :1],
                    "body_pose": matrices[k, 1:],
                    "betas": betas[k],
                }
            ],
        }
        for k in range(NUM)
    }
    vibe_boxes = np.concatenate([box, box[:, 2:]], axis=-1)
    return {
        "VIBE": (
            "v.pkl",
            {
                1: {
                    "pose": poses,
                    "betas": betas,
                    "pred_cam": weak,
                    "bboxes": vibe_boxes,
                    "frame_ids": frame,
                }
            },
        ),
        "WHAM": (
            "w.pkl",
            {
                0: {
                    "pose": poses,
                    "betas": betas,
                    "trans": _refocused(trans, 80.0),  # the diagonal
                    "pose_world": poses,
                    "frame_ids": frame,
                }
            },
        ),
        "CLIFF": (
            "c.npz",
            {
                "imgname": np.array([f"a/{k:05d}.png" for k in range(NUM)]),
                "pose": matrices,
                "shape": betas,
                "global_t": _refocused(trans, 90.0),
                "focal_l": np.full(NUM, 90.0),
            },
        ),
        "4D-Humans": ("p.pkl", phalp),
        "TRAM": (
            "t.npy",
            {
                "pred_rotmat": matrices,
                "pred_trans": _refocused(trans, 80.0)[:, None],
                "pred_shape": betas,
                "frame": frame,
            },
        ),
        "GVHMR": (
            "g.pkl",
            {
                "smpl_params_incam": {
                    "global_orient": poses[:, :3],
                    "body_pose": poses[:, 3:66],
                    "transl": trans + smpl - smplx,
                    "betas": betas,
                },
                "K_fullimg": K,
            },
        ),
        "PromptHMR": (
            "r.pkl",
            {
                "people": {
                    5: {
                        "frames": frame,
                        "smplx_cam": {
                            "pose": poses[:, :66],
                            "shape": betas,
                            "trans": trans + smpl - smplx,
                        },
                    }
                }
            },
        ),
        "SLAHMR": (
            "s.npz",
            {
                "trans": moved[None],
                "root_orient": world.as_rotvec()[None],
                "pose_body": poses[None, :, 3:66],
                "betas": np.zeros((1, 16)),
                "cam_R": np.tile(turn.as_matrix(), (1, NUM, 1, 1)),
                "cam_t": np.tile([0.5, 1.0, 1.5], (1, NUM, 1)),
                "world_scale": np.array([[2.0]]),
            },
        ),
        "GLAMR": (
            "m.npz",
            {
                "smpl_orient_cam": poses[:, :3],
                "smpl_pose": poses[:, 3:],
                "smpl_beta": betas,
                "root_trans_cam": trans + smpl,
                "frames": frame,
            },
        ),
        "AMASS": (
            "a.npz",
            {
                "poses": poses,
                "trans": trans,
                "betas": np.zeros(16),
                "mocap_framerate": np.array(30.0),
            },
        ),
    }


@pytest.mark.parametrize("tool", list(_tool_files()))
def test_bodies_of_other_tools(tmp_path, tool):
    name, content = _tool_files()[tool]
    file = tmp_path / name
    if file.suffix == ".npz":
        np.savez(file, **content)
    elif file.suffix == ".npy":
        np.save(file, np.array(content, dtype=object), allow_pickle=True)
    else:
        file.write_bytes(pickle.dumps(content, protocol=4))
    found, expected = read(file), bodies()
    assert found.present.all() and len(found.present) == 1
    # The pelvis of an off-axis body moves by less than 2 mm under PHALP's rounding.
    np.testing.assert_allclose(found.trans[0], expected["trans"], atol=1e-6)
    turned = Rotation.from_rotvec(found.poses[0, :, :66].reshape(-1, 3))
    wanted = Rotation.from_rotvec(expected["poses"][:, :66].reshape(-1, 3))
    assert (turned * wanted.inv()).magnitude().max() < 1e-6
    assert found.shapes_regressed == (tool not in ("SLAHMR", "AMASS"))
    if tool not in ("GVHMR", "PromptHMR", "SLAHMR", "AMASS"):
        np.testing.assert_array_equal(found.shapes[0], expected["betas"])


def test_each_file_is_of_one_format_only(tmp_path):
    """So that the order in which formats are asked does not matter."""
    recognised = lambda formats, content: [
        f.name for f in formats if f.recognises(Source(tmp_path / "file", content))
    ]
    contents = {tool: content for tool, (_, content) in _tool_files().items()}
    contents["bodies.npz"] = bodies()
    for tool, content in contents.items():
        assert recognised(body_formats(), content) == [tool]
    names = {"alphapose": "AlphaPose", "coco": "COCO", "mmpose": "MMPose"}
    for kind, content in JSON_FILES.items():
        assert recognised(keypoint_formats(), content) == [names[kind]]


def test_what_is_mostly_not_finite_is_refused_of_any_tool(tmp_path):
    """Lists of bodies in dictionaries are not checked array by array."""
    name, content = _tool_files()["4D-Humans"]
    for k in range(2, NUM):
        content[f"x/{k:06d}.jpg"]["smpl"][0]["betas"] = np.full(10, np.nan)
    (tmp_path / name).write_bytes(pickle.dumps(content))
    with pytest.raises(ValueError, match=f"{name}: `betas` has NaN or infinity"):
        read(tmp_path / name)


def _two_of_cliff(num: int) -> dict[str, np.ndarray]:
    """Two people who stand apart, in changing order; a third is seen in one frame."""
    where = [[s, 0.0, 4.0] for k in range(num) for s in ((-1, 1) if k % 2 else (1, -1))]
    trans = np.array([*where, [0.0, 0.0, 8.0]])
    frame = [*np.repeat(np.arange(num), 2), 5]
    return {
        "imgname": np.array([f"a/{k:05d}.png" for k in frame]),
        "pose": np.zeros((2 * num + 1, 72)),
        "shape": np.zeros((2 * num + 1, 10)),
        "global_t": trans,
    }


def test_people_of_cliff_are_told_apart_by_where_they_are(tmp_path):
    np.savez(tmp_path / "c.npz", **_two_of_cliff(20))
    said: list[str] = []
    found = read_bodies(
        tmp_path / "c.npz", num_frames=20, intrinsics=CAMERA, fps=25.0, warn=said.append
    )
    assert found.present.all() and len(found.present) == 2
    assert (np.ptp(found.trans[..., 0], axis=1) == 0).all()
    assert len(said) == 1 and "2 people tracked by position" in said[0]
    assert "1 bodies left out" in said[0]


def test_cliff_may_name_each_image_once(tmp_path):
    """Detections then begin with the number of their image."""
    data = _two_of_cliff(20)
    image = [*np.repeat(np.arange(20), 2), 5]
    once = data | {"imgname": np.array([f"a/{k:05d}.png" for k in range(1, 21)])}
    boxes = np.zeros((41, 7))
    boxes[:, 0] = image
    read_ = lambda: read_bodies(
        tmp_path / "c.npz", num_frames=20, intrinsics=CAMERA, fps=25.0
    )
    np.savez(tmp_path / "c.npz", **once, detection_all=boxes)
    found = read_()
    assert found.present.all() and len(found.present) == 2
    assert (np.ptp(found.trans[..., 0], axis=1) == 0).all()
    for other in ({}, {"detection_all": boxes + 0.5}, {"detection_all": boxes[1:]}):
        np.savez(tmp_path / "c.npz", **once, **other)
        with pytest.raises(ValueError, match="20 image names for 41 bodies"):
            read_()


@pytest.mark.parametrize("first", [1, 2])
def test_nobody_in_the_first_image_shifts_nobody(tmp_path, first):
    """CLIFF names images only where it found somebody: 0 may be missing."""
    names = [f"{k:06d}.jpg" for k in range(NUM)]
    one = {k: v[: NUM - first] for k, v in _two_of_cliff(NUM).items()}
    np.savez(tmp_path / "c.npz", **(one | {"imgname": np.array(names[first:])}))
    said: list[str] = []
    read_ = lambda **known: read_bodies(
        tmp_path / "c.npz", num_frames=NUM, intrinsics=CAMERA, **known
    )
    found = read_(warn=said.append)
    assert np.flatnonzero(found.present[0]).tolist() == list(range(first, NUM))
    assert "taken as counted from 0" in said[0]
    found = read_(images=tuple(names), warn=pytest.fail)
    assert np.flatnonzero(found.present[0]).tolist() == list(range(first, NUM))


def _walking(num: int, rate: float) -> dict[str, np.ndarray]:
    """At 1 m/s, turning by 0.4 rad/s, in AMASS' style."""
    poses, trans = np.zeros((num, 156)), np.tile([0.0, 0.0, 4.0], (num, 1))
    trans[:, 0] = np.arange(num) / rate
    poses[:, 1] = 0.4 * trans[:, 0]
    return {
        "poses": poses,
        "trans": trans,
        "betas": np.zeros(16),
        "mocap_framerate": np.array(rate),
    }


@pytest.mark.parametrize(
    ("num", "rate", "frames", "fps"),
    [(120, 30.0, 120, 60.0), (720, 120.0, 125, 25.0), (60, 30.0, 120, 60.0)],
)
def test_amass_keeps_its_own_time(tmp_path, num, rate, frames, fps):
    """More frames than the video, as many at another rate, fewer: never stretched."""
    np.savez(tmp_path / "a.npz", **_walking(num, rate))
    said: list[str] = []
    found = read_bodies(
        tmp_path / "a.npz",
        num_frames=frames,
        intrinsics=CAMERA,
        fps=fps,
        times=np.arange(frames) / fps,
        warn=said.append,
    )
    assert found.present.all()
    times = np.minimum(np.arange(frames) / fps, (num - 1) / rate)
    np.testing.assert_allclose(found.trans[0, :, 0], times, atol=1e-9)
    np.testing.assert_allclose(found.poses[0, :, 1], 0.4 * times, atol=1e-9)
    assert any("as in the camera's frame" in text for text in said)
    longer = num / rate > frames / fps + 0.1
    assert any("begin together" in text for text in said) is longer


def test_amass_of_a_video_whose_rate_varies_has_a_pose_a_frame(tmp_path):
    """The rate of the frames that are used is not that of all."""
    steps = np.where(np.arange(149) % 3, 1 / 60, 1 / 20)
    times = np.r_[0.0, np.cumsum(steps)]
    rate = 149 / times[-1]
    np.savez(tmp_path / "a.npz", **_walking(150, rate))
    said: list[str] = []
    known = {"fps": 25.0, "times": times, "warn": said.append}
    found = read_bodies(tmp_path / "a.npz", num_frames=150, intrinsics=CAMERA, **known)
    np.testing.assert_allclose(found.trans[0, :, 0], np.arange(150) / rate, atol=1e-9)
    assert not any("begin together" in text for text in said)


def test_amass_ends_where_it_ends(tmp_path):
    np.savez(tmp_path / "a.npz", **_walking(60, 60.0))
    said: list[str] = []
    known = {"fps": 30.0, "times": np.arange(50) / 30, "warn": said.append}
    found = read_bodies(tmp_path / "a.npz", num_frames=50, intrinsics=CAMERA, **known)
    assert np.flatnonzero(found.present[0]).tolist() == list(range(31))
    assert any("nobody after its end" in text for text in said)
    with pytest.raises(ValueError, match="are 1 s, but the video has 5 s"):
        read_bodies(tmp_path / "a.npz", num_frames=150, intrinsics=CAMERA, fps=30.0)


def test_a_folder_of_tram_uses_its_camera(tmp_path):
    b = bodies()
    matrices = Rotation.from_rotvec(b["poses"].reshape(-1, 3)).as_matrix()
    (tmp_path / "hps").mkdir()
    for number in (0, 1):
        track = {
            "pred_rotmat": matrices.reshape(NUM, 24, 3, 3),
            "pred_trans": _refocused(b["trans"], 160.0)[:, None],
            "pred_shape": b["betas"],
            "frame": b["frame"],
        }
        file = tmp_path / "hps" / f"hps_track_{number}.npy"
        np.save(file, np.array(track, dtype=object), allow_pickle=True)
    camera = {"img_focal": 160.0, "img_center": np.array([31.5, 23.5])}
    np.save(tmp_path / "camera.npy", np.array(camera, dtype=object), allow_pickle=True)
    found = read(tmp_path)
    assert found.present.shape == (2, NUM) and found.shapes_regressed
    np.testing.assert_allclose(found.trans[1], b["trans"], atol=1e-9)


def _contract(**changes):
    return _npz("b.npz", **(bodies() | changes))


BAD_BODIES = {
    "missing": (lambda folder: folder / "b.npz", "no such file"),
    "text": (_text("b.npz", "hello"), "neither a pickle"),
    "unknown": (_npz("b.npz", stuff=np.ones(3)), "not bodies of"),
    "nan": (_contract(trans=np.full((NUM, 3), np.nan)), "`trans` has NaN"),
    "wrong poses": (_contract(poses=np.zeros((NUM, 69))), "`poses` is"),
    "longer video": (_contract(frame=np.arange(NUM) + 5), "frames 5 to 12"),
    "negative frame": (_contract(frame=np.arange(NUM) - 1), "frames -1 to 6"),
    "twice": (_contract(frame=np.zeros(NUM, int)), "same `frame`"),
    "millimetres": (_contract(trans=np.full((NUM, 3), 4000.0)), "m away"),
    "behind": (_contract(trans=np.full((NUM, 3), -3.0)), "behind the camera"),
    "degrees": (_contract(poses=np.full((NUM, 72), 90.0)), "degrees"),
    "no box": (
        _npz(
            "b.npz",
            pose=np.zeros((NUM, 72)),
            betas=np.zeros((NUM, 10)),
            camera=np.ones((NUM, 3)),
        ),
        "needs `bbox`",
    ),
    "nobody": (_contract(**{k: v[:0] for k, v in bodies().items()}), "no body"),
    "no flag": (_contract(shapes_regressed=np.array(1.2)), "not true or false"),
    "flags": (_contract(shapes_regressed=np.ones(NUM, bool)), "not true or false"),
    "no distance": (
        _npz(
            "b.npz",
            imgname=np.array(["0.png"]),
            pose=np.zeros((1, 72)),
            shape=np.zeros((1, 10)),
            global_t=np.zeros((1, 3)),
            focal_l=np.array([400.0]),
        ),
        "a distance of 0",
    ),
    "frames of others": (
        _npz(
            "b.npz",
            pred_rotmat=np.tile(np.eye(3), (NUM, 24, 1, 1)),
            pred_trans=np.ones((NUM, 3)),
            pred_shape=np.zeros((NUM, 10)),
            frame=np.arange(NUM - 1),
        ),
        "`frame` has 7 entries for 8 bodies",
    ),
    "text inside": (_contract(poses=np.full((NUM, 72), "a")), "not numbers"),
}


@pytest.mark.parametrize("kind", list(BAD_BODIES))
def test_refuses_bad_bodies(tmp_path, kind):
    make, message = BAD_BODIES[kind]
    with pytest.raises(ValueError, match=message) as caught:
        read(make(tmp_path))
    assert "\n" not in str(caught.value) and str(tmp_path) in str(caught.value)


# Pickles


class _Evil:
    def __reduce__(self):
        return os.mkdir, (self.target,)

    def __init__(self, target):
        self.target = target


def test_refuses_code_before_it_runs(tmp_path):
    target = str(tmp_path / "owned")
    payload = pickle.dumps({"pose": _Evil(target)})
    (tmp_path / "a.pkl").write_bytes(payload)
    (tmp_path / "b.pkl").write_bytes(zlib.compress(payload))
    with zipfile.ZipFile(tmp_path / "c.pt", "w") as archive:
        archive.writestr("c/data.pkl", payload)
    np.save(
        tmp_path / "d.npy", np.array(_Evil(target), dtype=object), allow_pickle=True
    )
    np.savez(tmp_path / "e.npz", pose=np.array([_Evil(target)], dtype=object))
    for name in ("a.pkl", "b.pkl", "c.pt", "d.npy", "e.npz"):
        with pytest.raises(ValueError, match="refused, it wants to load"):
            restricted_load(tmp_path / name)
        with pytest.raises(ValueError, match="refused"):
            read(tmp_path / name)
    assert not (tmp_path / "owned").exists()


def test_refuses_to_change_its_own_functions(tmp_path):
    """`BUILD` on an allowed function would set its attributes."""
    change = b"\x80\x02c_codecs\nencode\n}X\x01\x00\x00\x00aK\x01sb."
    (tmp_path / "a.pkl").write_bytes(change)
    with pytest.raises(ValueError, match="wants to change"):
        restricted_load(tmp_path / "a.pkl")


def test_plain_pickles_of_every_protocol(tmp_path):
    data = {
        1: np.arange(6.0).reshape(2, 3),
        "f": np.asfortranarray(np.ones((2, 3))),
        "s": np.float32(2.5),
        "names": np.array(["a", "bc"]),
        "many": [np.int64(3), None, True, "text", (1, 2)],
        "objects": np.array([{"a": 1}, None], dtype=object),
    }
    for protocol in (2, 3, 4, 5):
        (tmp_path / "a.pkl").write_bytes(pickle.dumps(data, protocol))
        found = restricted_load(tmp_path / "a.pkl")
        np.testing.assert_array_equal(found[1], data[1])
        assert found["s"] == 2.5 and found["names"].tolist() == ["a", "bc"]
        assert found["many"] == data["many"] and found["objects"][0] == {"a": 1}


# joblib 1.5, `joblib.dump({1: {"pose": ..., "frame_ids": ..., "name": "a", "f": ...}})`
JOBLIB = (
    "eNqNkEtLw0AQgJtHsfVR6wNR/AP10pMHD0IjggcXAnrRW9g0iRvNY8kmSA6FelAr7M3p3b/mP/Af1Ek3"
    "RaUXh52Znd0ZvpkZm9PPhpIREG0EPWnyVPggd+5TNwrdflLEvHR4OHyI8HXLrsKzLKPlTUY59zN4h6Mn"
    "qApbonCHERUCZHNeBXIl8WiVi0myKRjlPhCdGC8YpZmHxVI7x7uXl/jD2osbZuvBMbxNXuEaesSQ2inY"
    "tn05Q5kb0sjBlas0itJHJ44ph4k8VJ3OeQ6Nwrsk9pPcccvcF0C6hWtgoRp1PEBj4UEdo35Y06t6C7Id"
    "ZDT2ndATwJpqMtZia2yd6M/AOmyTddm21MOTn/bY3nJzbH/CDirqxuy3GDXGrP30dsE1E8TiPihqsISu"
    "dsY6UrsAhQ/+i+/8wdfzL6RlKf81UL5bx43a71qF6H8DvPTJDg=="
)


def test_joblib_files(tmp_path):
    plain = zlib.decompress(base64.b64decode(JOBLIB))
    for name, content in (("a.pkl", plain), ("b.pkl", zlib.compress(plain))):
        (tmp_path / name).write_bytes(content)
        found = restricted_load(tmp_path / name)[1]
        np.testing.assert_array_equal(found["pose"], np.arange(6.0).reshape(2, 3))
        np.testing.assert_array_equal(found["f"], np.arange(6.0).reshape(2, 3))
        assert found["frame_ids"].tolist() == [3, 4] and found["name"] == "a"


def _torch_file(numbers: np.ndarray, size: tuple[int, int], stride: tuple[int, int]):
    """A `.pt` of one tensor, as PyTorch writes it: its pickle by hand, protocol 2."""
    whole = lambda n: b"J" + int(n).to_bytes(4, "little", signed=True)
    text = lambda s: b"X" + len(s).to_bytes(4, "little") + s.encode()
    reference = text("storage") + b"ctorch\nFloatStorage\n" + text("0") + text("cpu")
    reference = b"(" + reference + whole(numbers.size) + b"tQ"
    arguments = reference + whole(0) + whole(size[0]) + whole(size[1]) + b"\x86"
    arguments += whole(stride[0]) + whole(stride[1]) + b"\x86\x89"
    arguments += b"ccollections\nOrderedDict\n)R"
    body = b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\n(" + arguments + b"tR."
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("r/data.pkl", body)
        archive.writestr("r/data/0", numbers.astype("<f4").tobytes())
    return stream.getvalue()


def test_torch_files(tmp_path):
    file = tmp_path / "a.pt"
    file.write_bytes(_torch_file(np.arange(6), (3, 2), (1, 3)))  # a transposed view
    np.testing.assert_array_equal(restricted_load(file), np.arange(6).reshape(2, 3).T)
    file.write_bytes(_torch_file(np.arange(6), (30, 2), (1, 3)))
    with pytest.raises(ValueError, match="larger than its storage"):
        restricted_load(file)


def test_truncated_files_are_refused(tmp_path):
    payload = pickle.dumps({"pose": np.ones((10, 3))})
    for end in (0, 1, 5, 40, len(payload) - 1):
        (tmp_path / "a.pkl").write_bytes(payload[:end])
        with pytest.raises(ValueError, match="not a readable result file"):
            restricted_load(tmp_path / "a.pkl")


@pytest.mark.parametrize(
    "gender, expected, told",
    [
        ("female", "female", ""),
        (np.array(b"male"), "male", ""),
        (np.array(["f", "f"]), "female", ""),
        (np.array([b"neutral"]), "neutral", ""),
        (np.array(["female", "male"]), None, "female and male models"),
        ("person", None, "gender 'person'"),
        ("unknown", None, ""),
    ],
)
def test_the_gender_of_bodies_is_read(tmp_path, gender, expected, told):
    np.savez(tmp_path / "bodies.npz", **bodies(), gender=gender)
    lines: list[str] = []
    found = read_bodies(
        tmp_path / "bodies.npz", num_frames=NUM, intrinsics=CAMERA, warn=lines.append
    )
    assert found.gender == expected
    assert told in " ".join(lines) and bool(told) == bool(lines)


# The whole sequence


def folder(path: Path) -> Path:
    """A sequence folder with everything in it."""
    path.mkdir()
    video(path / "video.mp4")
    (path / "camera.json").write_text(json.dumps(GOOD_CAMERA | {"fps": 25}))
    openpose(path / "keypoints", [[person()]] * NUM)
    np.savez(path / "bodies.npz", **bodies())
    rng = np.random.default_rng(0)
    frame, landmark = np.divmod(np.arange(NUM * 20), 20)
    uv = rng.uniform([0, 0], [63, 47], (NUM * 20, 2))
    np.savez(path / "tracks.npz", frame=frame, landmark=landmark * 3, uv=uv)
    (path / "masks").mkdir()
    for k in range(NUM):
        mask = np.zeros((HEIGHT, WIDTH), np.uint8)
        mask[5:40, 20:40] = 255
        cv2.imwrite(str(path / "masks" / f"{k}.png"), mask)
    return path


def test_reads_a_whole_folder(tmp_path):
    found = read_sequence(folder(tmp_path / "walk"))
    assert found.name == "walk" and found.num_frames == NUM
    assert abs(found.fps - 25) < 0.1 and found.warnings == ()
    assert found.keypoints is not None and found.keypoints.uv.shape == (1, NUM, 25, 2)
    assert found.bodies is not None and found.bodies.present.all()
    assert found.tracks is not None and found.tracks.landmark.max() == 19
    assert found.masks == tmp_path / "walk" / "masks"


def test_a_video_alone_is_enough(tmp_path):
    found = read_sequence(video(tmp_path / "clip.mp4"))
    assert found.intrinsics.is_guess and "focal length guessed" in found.warnings[0]
    assert found.keypoints is None and found.num_frames == NUM


def test_images_alone_are_enough_in_the_order_of_their_numbers(tmp_path):
    for k in range(11):
        image = np.full((HEIGHT, WIDTH), 20 * k, dtype=np.uint8)
        cv2.imwrite(str(tmp_path / f"frame{k}.png"), image)
    from bodyslam_jax.io import frames

    found = read_sequence(tmp_path)
    means = [int(image.mean()) for image in frames(found, gray=True)]
    assert means == [20 * k for k in range(11)]
    assert any("30 frames/s assumed" in w for w in found.warnings)
    assert not any("none between" in w for w in found.warnings)

    for k in (4, 5):
        (tmp_path / f"frame{k}.png").unlink()
    found = read_sequence(tmp_path)
    (gap,) = [w for w in found.warnings if "none between" in w]
    assert "none between frame3.png and frame6.png; taken" in gap
    assert found.num_frames == 9


@pytest.mark.parametrize(
    ("names", "where"),
    [
        (["5.png", "10.png", "15.png"], None),  # every fifth
        (["a.png", "b.png"], None),
        (["one.png"], None),
        ([], None),
        (["5.png", "10.png", "15.png", "30.png"], "15.png and 30.png"),
        (["v2_1.png", "v2_2.png", "v2_4.png"], "v2_2.png and v2_4.png"),
        ([f"{k}.png" for k in range(40) if k not in (7, 20, 21)], "8.png, and 1 more"),
        # Of 30 to 25 frames a second; times in ms; in ns, with jitter.
        ([f"{k}.png" for k in range(40) if k % 6], None),
        ([f"{round(k * 1000 / 30)}.png" for k in range(40)], None),
        ([f"{10**18 + 50_000_000 * k + 200 * (k % 3)}.png" for k in range(40)], None),
    ],
)
def test_gaps_among_images(names, where):
    found = gap_among(names)
    assert found is None if where is None else where in found


def test_tracks_need_no_video(tmp_path):
    path = folder(tmp_path / "walk")
    (path / "video.mp4").unlink()
    found = read_sequence(path)
    assert found.frames is None and found.num_frames == NUM
    (path / "camera.json").unlink()
    with pytest.raises(ValueError, match="need a camera.json"):
        read_sequence(path)


def test_without_a_video_the_longest_part_says_how_many_frames(tmp_path):
    """And without a frame rate one is assumed, which is said."""
    path = folder(tmp_path / "walk")
    (path / "video.mp4").unlink()
    shutil.rmtree(path / "masks")
    (path / "camera.json").write_text(json.dumps(GOOD_CAMERA))
    shutil.rmtree(path / "keypoints")
    np.savez(path / "keypoints.npz", keypoints=np.stack([person()] * (NUM + 5)))
    found = read_sequence(path)
    assert found.num_frames == NUM + 5 and found.fps == pytest.approx(30)
    assert found.warnings == ("camera.json has no fps: 30 frames/s assumed.",)
    (path / "keypoints.npz").unlink()
    np.savez(path / "bodies.npz", **bodies(NUM + 2))
    assert read_sequence(path).num_frames == NUM + 2
    openpose(path / "keypoints", [[person()]] * (NUM + 3))
    assert read_sequence(path).num_frames == NUM + 3


@pytest.mark.parametrize(("fps", "few"), [(30, False), (10, False), (2, True)])
def test_few_frames_a_second_are_warned_of(tmp_path, fps, few):
    path = folder(tmp_path / "walk")
    (path / "video.mp4").unlink()
    shutil.rmtree(path / "masks")
    (path / "camera.json").write_text(json.dumps(GOOD_CAMERA | {"fps": fps}))
    warned = [
        w for w in read_sequence(path).warnings if w.startswith(f"{fps} frames/s")
    ]
    assert len(warned) == few


def test_pairs_keypoints_and_bodies_of_the_same_person(tmp_path):
    """Bodies are listed in the other order than the people that fill the image."""
    path = folder(tmp_path / "walk")
    left, right = person(15.0, 24.0, 30.0), person(50.0, 24.0, 20.0)
    for p in (left, right):
        p[8, :2] = p[:, :2].mean(axis=0)
    openpose(path / "keypoints", [[left, right]] * NUM)
    b = bodies()
    two = {k: np.concatenate([v, v]) for k, v in b.items()}
    at = lambda u: np.array([(u - 30) / 80 * 4, 0.2, 4.0])
    two["trans"] = np.concatenate(
        [np.tile(at(50.0), (NUM, 1)), np.tile(at(15.0), (NUM, 1))]
    )
    two |= {"person": np.repeat([0, 1], NUM), "shapes_regressed": np.array(False)}
    np.savez(path / "bodies.npz", **two)
    found = read_sequence(path)
    assert isinstance(found.keypoints, Keypoints) and found.bodies is not None
    assert not found.bodies.shapes_regressed
    for uv, trans in zip(found.keypoints.uv, found.bodies.trans, strict=True):
        u = 30 + 80 * trans[0, 0] / trans[0, 2]
        assert abs(u - uv[0, 8, 0]) < 10


def _broken(action):
    def make(path: Path) -> Path:
        action(folder(path / "walk"))
        return path / "walk"

    return make


BAD_SEQUENCES = {
    "nothing there": (lambda path: path / "walk", "no such file"),
    "empty folder": (lambda path: path, "no video.mp4"),
    "text as video": (_text("a.mp4", "hello"), "not a video"),
    "empty video": (_text("a.mp4", ""), "not a video"),
    "other size": (
        _broken(
            lambda p: (p / "camera.json").write_text(
                json.dumps(GOOD_CAMERA | {"width": 128})
            )
        ),
        "for 128x48 px, but video.mp4 has 64x48",
    ),
    "tracks beyond": (
        _broken(
            lambda p: np.savez(
                p / "tracks.npz", frame=[9], landmark=[0], uv=np.ones((1, 2))
            )
        ),
        "tracks up to frame 9",
    ),
    "tracks twice": (
        _broken(
            lambda p: np.savez(
                p / "tracks.npz", frame=[1, 1], landmark=[0, 0], uv=np.ones((2, 2))
            )
        ),
        "observed twice",
    ),
    "tracks with NaN": (
        _broken(
            lambda p: np.savez(
                p / "tracks.npz", frame=[1], landmark=[0], uv=np.full((1, 2), np.nan)
            )
        ),
        "not finite",
    ),
    "tracks outside": (
        _broken(
            lambda p: np.savez(
                p / "tracks.npz", frame=[1], landmark=[0], uv=np.full((1, 2), 500.0)
            )
        ),
        "outside the image",
    ),
    "tracks of shape": (
        _broken(
            lambda p: np.savez(
                p / "tracks.npz", frame=[1], landmark=[0, 1], uv=np.ones((2, 2))
            )
        ),
        "expected",
    ),
    "few masks": (_broken(lambda p: (p / "masks" / "0.png").unlink()), "7 masks"),
}


@pytest.mark.parametrize("kind", list(BAD_SEQUENCES))
def test_refuses_bad_sequences(tmp_path, kind):
    make, message = BAD_SEQUENCES[kind]
    with pytest.raises(ValueError, match=message) as caught:
        read_sequence(make(tmp_path))
    assert "\n" not in str(caught.value) and str(tmp_path) in str(caught.value)


@pytest.mark.skipif(not SHARED.exists(), reason="needs the shared example data")
def test_real_files():
    """OpenPose 1.3 with up to 12 people a frame; GLAMR's pickle and its plain copy."""
    third = SHARED / "videos" / "third_party"
    found = read_detections(
        third / "badminton_openpose", num_frames=60, width=1920, height=1080
    )
    people, _ = associate(found.points, Association(), fps=30.0)
    assert (people.confidence.max(axis=-1) > 0).mean(axis=1).max() == 1
    camera = Intrinsics(np.array([1000.0, 1000, 1920, 1080]), 3840, 2160)
    one, two = (
        read_bodies(
            third / "aitviewer_glamr_running" / name, num_frames=203, intrinsics=camera
        )
        for name in ("running_seed1.pkl", "glamr_running_plain.npz")
    )
    np.testing.assert_array_equal(one.trans, two.trans)
    walk = read_sequence(SHARED / "sequences" / "walk")
    weak = read_bodies(
        SHARED / "sequences" / "walk" / "bodies_weak_perspective.npz",
        num_frames=300,
        intrinsics=walk.intrinsics,
    )
    assert walk.bodies is not None
    np.testing.assert_allclose(weak.trans, walk.bodies.trans, atol=1e-9)
    np.testing.assert_allclose(weak.poses, walk.bodies.poses, atol=1e-9)


@pytest.mark.parametrize("lens", [[], [-0.28, 0.07, 1e-3, -5e-4], [-0.35, 0.12, 0, 0]])
def test_rays_are_those_of_their_pixels_with_strong_distortion_too(lens):
    params = np.array([400.0, 410.0, 319.5, 239.5, *lens])
    points = np.random.default_rng(0).uniform([-0.75, -0.55], [0.75, 0.55], (500, 2))
    p_C = np.column_stack([points, np.ones(500)])
    uv = project_points(Intrinsics(params, 640, 480), p_C)
    np.testing.assert_allclose(rays(uv, *as_opencv(params)), points, atol=1e-8)
    assert rays(uv[:0], *as_opencv(params)).shape == (0, 2)
