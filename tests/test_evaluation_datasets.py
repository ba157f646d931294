"""Public data sets, in the layouts that their authors document, on files made here."""

import json
import pickle

import cv2
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

import bodyslam_jax as bs
from bodyslam_jax import evaluation
from bodyslam_jax.body import joints, load_body_model

NUM = 6


@pytest.fixture(scope="module")
def body():
    return load_body_model(dtype=jnp.float64)


@pytest.fixture
def world():
    """World-to-camera poses, and a person's poses and places."""
    rng = np.random.default_rng(0)
    T_CW = np.tile(np.eye(4), (NUM, 1, 1))
    turns = jaxlie.SO3.exp(jnp.asarray(rng.normal(0, 0.5, (NUM, 3))))
    T_CW[:, :3, :3] = turns.as_matrix()
    T_CW[:, :3, 3] = rng.normal(0, 1, (NUM, 3))
    poses, trans = rng.normal(0, 0.3, (NUM, 72)), rng.normal(0, 1, (NUM, 3))
    return T_CW, poses, trans, rng.normal(0, 1, 10)


def _images(folder, names, size=(64, 48)):
    folder.mkdir(parents=True)
    for k, name in enumerate(names):
        cv2.imwrite(
            str(folder / name), np.full((size[1], size[0], 3), 20 * k, np.uint8)
        )


def _dump(path, data):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(pickle.dumps(data, protocol=2))


K = np.array([[50.0, 0, 31.5], [0, 52.0, 23.5], [0, 0, 1]])


def _check(out, body, world, person=0):
    """The truth that comes out is the world that went in."""
    T_CW, poses, trans, betas = world
    truth = evaluation.read_groundtruth(out, body)
    np.testing.assert_allclose(truth.T_WC, np.linalg.inv(T_CW), atol=1e-7)
    np.testing.assert_allclose(truth.poses[person], poses, atol=1e-12)
    np.testing.assert_allclose(truth.trans[person], trans, atol=1e-12)
    np.testing.assert_allclose(truth.betas[person], betas, atol=1e-12)
    camera = json.loads((out / "camera.json").read_text())
    np.testing.assert_allclose(camera["params"][:4], [50, 52, 31.5, 23.5])
    assert (camera["width"], camera["height"], camera["fps"]) == (64, 48, 30.0)
    return truth


def test_emdb(tmp_path, body, world):
    T_CW, poses, trans, betas = world
    good = np.array([True, True, False, True, True, True])
    _images(tmp_path / "P0" / "images", [f"{k:05d}.jpg" for k in range(NUM)])
    _dump(
        tmp_path / "P0" / "P0_09_walk_data.pkl",
        {
            "gender": "female",
            "n_frames": NUM,
            "good_frames_mask": good,
            "camera": {"intrinsics": K, "extrinsics": T_CW, "width": 64, "height": 48},
            "smpl": {
                "poses_root": poses[:, :3],
                "poses_body": poses[:, 3:],
                "trans": trans,
                "betas": betas,
            },
        },
    )
    out = evaluation.convert_emdb(tmp_path / "P0", tmp_path / "out", body)
    truth = _check(out, body, world)
    np.testing.assert_array_equal(truth.present[0], good)
    expected = joints(body, *map(jnp.asarray, (poses, betas, trans)))
    np.testing.assert_allclose(truth.joints[0], expected, atol=1e-9)
    sequence = bs.read_sequence(out)
    assert sequence.num_frames == NUM and not sequence.intrinsics.is_guess


def test_3dpw(tmp_path, body, world):
    T_CW, poses, trans, betas = world
    rng = np.random.default_rng(1)
    other = rng.normal(0, 0.3, (NUM, 72))
    points = rng.uniform(5, 40, (NUM, 3, 18))
    points[2] = 0.0
    own = rng.normal(0, 1, (NUM, 72))
    valid = np.array([1, 1, 1, 0, 1, 1])
    _images(
        tmp_path / "imageFiles" / "walk_00", [f"image_{k:05d}.jpg" for k in range(NUM)]
    )
    file = tmp_path / "sequenceFiles" / "test" / "walk_00.pkl"
    _dump(
        file,
        {
            "sequence": "walk_00",
            "poses": [other, poses],
            "trans": [trans, trans],
            "betas": [np.zeros(10), np.r_[betas, np.zeros(290)]],
            "genders": ["m", "f"],
            "cam_poses": T_CW,
            "cam_intrinsics": K,
            "campose_valid": [np.ones(NUM), valid],
            "jointPositions": [own, own + 1],
            "poses2d": [points, points],
        },
    )
    out = evaluation.convert_3dpw(file, tmp_path / "out")
    truth = _check(out, body, world, person=1)
    np.testing.assert_array_equal(truth.present[1], valid == 1)
    np.testing.assert_allclose(truth.joints[1], own.reshape(NUM, 24, 3) + 1)
    sequence = bs.read_sequence(out)
    assert sequence.keypoints is not None
    assert sequence.keypoints.confidence[:, 0].any()
    assert not sequence.keypoints.confidence[:, 2].any()


def _rich(root, world):
    T_CW, poses, trans, betas = world
    names = [f"{k:05d}_03.jpeg" for k in range(3, 3 + NUM)]
    _images(root / "images" / "val" / "Hall_003_wipe" / "cam_03", names)
    for k in range(NUM - 1):  # The last image has no body.
        frame = root / "bodies" / "val" / "Hall_003_wipe" / f"{k + 3:05d}"
        _dump(
            frame / "003.pkl",
            {
                "global_orient": poses[k : k + 1, :3],
                "body_pose": poses[k : k + 1, 3:66],
                "betas": betas[None],
                "transl": trans[k : k + 1],
            },
        )
    calibration = root / "scan_calibration" / "Hall" / "calibration"
    calibration.mkdir(parents=True)
    matrix = lambda name, x: (
        f"<{name} type_id='opencv-matrix'><data>"
        f"{' '.join(map(str, np.ravel(x)))}</data></{name}>"
    )
    (calibration / "003.xml").write_text(
        "<?xml version='1.0'?><opencv_storage>"
        + matrix("CameraMatrix", T_CW[0, :3])
        + matrix("Intrinsics", K)
        + matrix("Distortion", [0.01, -0.002, 0, 0, 0])
        + "</opencv_storage>"
    )


def test_rich(tmp_path, body, world):
    T_CW, poses, trans, betas = world
    _rich(tmp_path, world)
    out = evaluation.convert_rich(
        tmp_path, "val", "Hall_003_wipe", 3, tmp_path / "out", body
    )
    poses[:, 66:] = 0
    poses[-1], trans[-1] = 0, 0
    truth = _check(out, body, (np.tile(T_CW[0], (NUM, 1, 1)), poses, trans, betas))
    np.testing.assert_array_equal(truth.present[0], np.arange(NUM) < NUM - 1)
    camera = json.loads((out / "camera.json").read_text())
    assert camera["model"] == "OPENCV"
    np.testing.assert_allclose(camera["params"][4:], [0.01, -0.002, 0, 0])


def test_tum_with_amass(tmp_path, body, world):
    _, poses, trans, betas = world
    lines = [f"{k / 30} {k} 0 0 0 0 0 1" for k in range(NUM)]
    (tmp_path / "camera.tum").write_text("\n".join(lines))
    np.savez(
        tmp_path / "walk_poses.npz",
        poses=poses,
        trans=trans,
        betas=betas,
        mocap_framerate=30.0,
    )
    out = evaluation.convert_tum_amass(
        tmp_path / "camera.tum", tmp_path / "walk_poses.npz", tmp_path / "out"
    )
    truth = evaluation.read_groundtruth(out, body)
    np.testing.assert_allclose(truth.T_WC[:, 0, 3], np.arange(NUM))
    np.testing.assert_allclose(truth.poses[0], poses)


def test_where_to_register_is_said(tmp_path, body):
    convert = {
        "emdb.ait.ethz.ch": lambda: evaluation.convert_emdb(
            tmp_path / "P0", tmp_path / "out", body
        ),
        "virtualhumans.mpi-inf.mpg.de": lambda: evaluation.convert_3dpw(
            tmp_path / "a" / "b" / "c.pkl", tmp_path / "out"
        ),
        "rich.is.tue.mpg.de": lambda: evaluation.convert_rich(
            tmp_path, "val", "Hall_003_wipe", 3, tmp_path / "out", body
        ),
    }
    for home, attempt in convert.items():
        with pytest.raises(FileNotFoundError, match=home):
            attempt()
    assert not (tmp_path / "out").exists()


class _Evil:
    def __reduce__(self):
        return print, ("gotcha",)


@pytest.mark.parametrize(
    "data, message",
    [
        (_Evil(), "refused"),
        ([1, 2], "a list, not a dictionary"),
        ({"n_frames": 3}, "no good_frames_mask"),
        (
            {
                "n_frames": 3,
                "good_frames_mask": np.ones(3),
                "camera": {},
                "smpl": {
                    "poses_root": np.ones((2, 3)),
                    "poses_body": np.ones((3, 69)),
                },
            },
            r"\(2, 3\) values, not \(3, 3\)",
        ),
    ],
    ids=["malicious", "list", "incomplete", "shapes"],
)
def test_bad_files_are_refused(tmp_path, body, capsys, data, message):
    _dump(tmp_path / "P0_data.pkl", data)
    with pytest.raises(ValueError, match=f"P0_data.pkl.*{message}"):
        evaluation.convert_emdb(tmp_path, tmp_path / "out", body)
    assert "gotcha" not in capsys.readouterr().out


def test_bad_calibration_is_refused(tmp_path, body, world):
    _rich(tmp_path, world)
    (tmp_path / "scan_calibration/Hall/calibration/003.xml").write_text("<a></a>")
    with pytest.raises(ValueError, match="003.xml: not a calibration"):
        evaluation.convert_rich(
            tmp_path, "val", "Hall_003_wipe", 3, tmp_path / "out", body
        )
