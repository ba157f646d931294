"""Bodies and tracks with broken values; files of tools as their programs write them."""

import json
import pickle
from pathlib import Path

import numpy as np
import pytest
from body_cases import crop_camera
from scipy.spatial.transform import Rotation

from bodyslam_jax.io.bodies.reader import read_bodies
from bodyslam_jax.io.tracks import read_tracks
from bodyslam_jax.types import Bodies, Intrinsics

NUM = 20
CAMERA = Intrinsics(np.array([525.0, 525.0, 319.5, 239.5]), 640, 480)
PELVIS_SMPL = np.array([-0.0018, -0.2233, 0.0282])
PELVIS_SMPLX = np.array([0.0031, -0.3514, 0.0120])


def body(num: int = NUM) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {
        "poses": rng.normal(0, 0.3, (num, 72)),
        "betas": np.tile(rng.normal(size=10), (num, 1)),
        "trans": rng.uniform([-1, -1, 3], [1, 1, 5], (num, 3)),
    }


def read(path: Path, num_frames: int = NUM, **more) -> tuple[Bodies, list[str]]:
    said: list[str] = []
    known = {"intrinsics": CAMERA, "fps": 30.0, "warn": said.append}
    return read_bodies(path, num_frames=num_frames, **known, **more), said


def contract(path: Path, data: dict) -> Path:
    np.savez(path, frame=np.arange(NUM), **data)
    return path


def pickled(path: Path, data: dict) -> Path:
    path.write_bytes(pickle.dumps(data, protocol=4))
    return path


def matrices(poses: np.ndarray) -> np.ndarray:
    found = Rotation.from_rotvec(poses.reshape(-1, 3)).as_matrix()
    return found.reshape(len(poses), -1, 3, 3)


def _spoiled(kind: str, path: Path) -> Path:
    """A file of a tool in which frames 3 and 7 are not finite."""
    b = body()
    bad = [3, 7]
    if kind == "bodies.npz":
        b["poses"][bad, 5] = np.nan
        return contract(path / "b.npz", b)
    if kind == "WHAM":
        b["trans"][bad] = np.inf
        one = {"pose": b["poses"], "betas": b["betas"], "trans": b["trans"]}
        one |= {"pose_world": b["poses"], "frame_ids": np.arange(NUM)}
        return pickled(path / "w.pkl", {0: one})
    if kind == "TRAM":
        rotations = matrices(b["poses"])
        rotations[bad] = np.nan
        data = {"pred_rotmat": rotations, "pred_trans": b["trans"]}
        data |= {"pred_shape": b["betas"], "frame": np.arange(NUM)}
        np.save(path / "t.npy", np.array(data, dtype=object), allow_pickle=True)
        return path / "t.npy"
    if kind == "VIBE":
        boxes = np.tile([300.0, 200.0, 200.0, 200.0], (NUM, 1))
        weak = crop_camera(b["trans"], boxes[:, :3], CAMERA)
        b["poses"][bad, 0] = np.nan
        one = {"pose": b["poses"], "betas": b["betas"], "pred_cam": weak}
        return pickled(path / "v.pkl", {1: one | {"bboxes": boxes}})
    if kind == "CLIFF":
        b["trans"][bad, 2] = np.nan
        names = np.array([f"{k:04d}.png" for k in range(NUM)])
        data = {"imgname": names, "pose": b["poses"], "shape": b["betas"]}
        np.savez(path / "c.npz", **data, global_t=b["trans"], focal_l=np.full(NUM, 500))
        return path / "c.npz"
    b["poses"][bad, 10] = np.nan
    data = {"poses": b["poses"], "trans": b["trans"], "betas": b["betas"][0]}
    np.savez(path / "a.npz", **data, mocap_framerate=np.array(30.0))
    return path / "a.npz"


TOOLS = ["bodies.npz", "WHAM", "TRAM", "VIBE", "CLIFF", "AMASS"]


@pytest.mark.parametrize("kind", TOOLS)
def test_a_broken_body_is_absent_in_its_frame(tmp_path, kind):
    found, said = read(_spoiled(kind, tmp_path))
    assert np.flatnonzero(~found.present[0]).tolist() == [3, 7]
    (line,) = [text for text in said if "NaN" in text]
    assert "in 2 of 20 bodies: taken as absent in those frames" in line
    for array in (found.poses, found.shapes, found.trans):
        assert np.isfinite(array).all()


def test_a_file_of_broken_bodies_is_refused(tmp_path):
    data = body()
    data["trans"][5:] = np.nan
    with pytest.raises(ValueError, match="`trans` has NaN or infinity in 15 of 20"):
        read(contract(tmp_path / "b.npz", data))


def test_broken_observations_of_tracks_are_left_out(tmp_path):
    frame, landmark = (a.ravel() for a in np.mgrid[:NUM, :10])
    uv = np.random.default_rng(0).uniform(5, 400, (len(frame), 2))
    uv[[4, 9], 1] = np.nan
    np.savez(tmp_path / "t.npz", frame=frame, landmark=landmark, uv=uv)
    said: list[str] = []
    size = {"num_frames": NUM, "size": (640, 480)}
    found = read_tracks(tmp_path / "t.npz", warn=said.append, **size)
    assert len(found.uv) == len(uv) - 2 and np.isfinite(found.uv).all()
    assert said == ["tracks: 2 of 200 observations not finite: left out."]


@pytest.mark.parametrize("rate", ["mocap_framerate", "mocap_frame_rate"])
@pytest.mark.parametrize("width", [72, 156, 165])
@pytest.mark.parametrize("betas", [(16,), (NUM, 16), (10,)])
def test_amass_of_any_release(tmp_path, rate, width, betas):
    b = body()
    poses = np.pad(b["poses"][:, :66], [(0, 0), (0, width - 66)])
    shape = np.broadcast_to(np.pad(b["betas"][0], (0, betas[-1] - 10)), betas)
    data = {"poses": poses, "trans": b["trans"], "betas": shape}
    np.savez(tmp_path / "a.npz", **data, **{rate: np.array(30.0)})
    found, said = read(tmp_path / "a.npz")
    assert found.present.all() and "AMASS" in said[0]
    np.testing.assert_allclose(found.poses[0, :, :66], b["poses"][:, :66])
    # SMPL-X's pelvis is elsewhere on its template, and its shapes are others.
    moved = PELVIS_SMPLX - PELVIS_SMPL if width == 165 else 0.0
    np.testing.assert_allclose(found.trans[0], b["trans"] + moved)
    expected = 0 * b["betas"] if width == 165 else b["betas"]
    np.testing.assert_allclose(found.shapes[0], expected)
    assert found.shapes_regressed == (width == 165)


@pytest.mark.parametrize("width", [66, 156, 165])
def test_poses_with_hands_in_bodies_npz(tmp_path, width):
    b = body()
    poses = np.pad(b["poses"][:, :66], [(0, 0), (0, width - 66)])
    shapes = np.pad(b["betas"], [(0, 0), (0, 6)])
    found, _ = read(contract(tmp_path / "b.npz", b | {"poses": poses, "betas": shapes}))
    np.testing.assert_allclose(found.poses[0, :, :66], b["poses"][:, :66])


def _slahmr(path: Path, num: int, **more) -> Path:
    """Two people in the frame of the first camera, for `num` frames."""
    b = body(num)
    twice = lambda a: np.stack([a, a + 0.01])
    path.parent.mkdir(parents=True, exist_ok=True)
    data = {
        "trans": twice(b["trans"]),
        "root_orient": twice(b["poses"][:, :3]),
        "pose_body": twice(b["poses"][:, 3:66]),
        "betas": np.zeros((2, 16)),
        "cam_R": np.tile(np.eye(3), (2, num, 1, 1)),
        "cam_t": np.zeros((2, num, 3)),
        "intrins": np.array([525.0, 525.0, 319.5, 239.5]),
    }
    np.savez(path, **(data | more))
    return path


@pytest.mark.parametrize("folder", ["motion_chunks", "."])
def test_slahmr_says_in_another_file_which_frames_its_results_are_of(tmp_path, folder):
    path = _slahmr(tmp_path / folder / "walk_000060_world_results.npz", 12)
    with pytest.raises(
        ValueError, match="12 frames, but the video has 20; SLAHMR's tr"
    ):
        read(path)
    masks = np.zeros((2, 18), int)
    masks[0, 1:13] = 1
    masks[1, [2, 3, 7]] = 1
    tracks = {
        str(7 - k): {"index": k, "vis_mask": m.tolist()} for k, m in enumerate(masks)
    }
    meta = {"seq_interval": [1, 13], "data_interval": [2, 20]}
    info = {"tracks": tracks, "meta": meta}
    (tmp_path / "track_info.json").write_text(json.dumps(info))
    found, _ = read(path)
    assert np.flatnonzero(found.present[0]).tolist() == list(range(3, 15))
    assert np.flatnonzero(found.present[1]).tolist() == [4, 5, 9]
    np.testing.assert_allclose(found.trans[0, 3:15], body(12)["trans"], atol=1e-9)
    (tmp_path / "track_info.json").write_text("{")
    with pytest.raises(ValueError, match="track_info.json.*: not JSON"):
        read(path)


def test_slahmrs_input_is_told_from_its_results(tmp_path):
    path = _slahmr(tmp_path / "walk_000000_phalp_world_results.npz", NUM)
    with np.load(path) as archive:
        kept = {k: archive[k] for k in ("trans", "root_orient", "pose_body")}
    np.savez(path, **kept)
    with pytest.raises(ValueError, match=r"without cameras; give \*_world_results.npz"):
        read(path)


def test_cameras_for_images_of_another_size(tmp_path):
    small = np.array([262.5, 262.5, 159.75, 119.75])
    path = _slahmr(tmp_path / "a.npz", NUM, intrins=small)
    found, said = read(path)
    np.testing.assert_allclose(found.trans[0], body()["trans"], atol=0.02)
    assert "for images of 320x240 px, but the video has 640x480 px" in said[0]


def _phalp(size: list[int], keys=lambda k: f"out/_DEMO/walk/img/{k + 1:06d}.jpg"):
    b = body()
    rotations = matrices(b["poses"])
    return {
        keys(k): {
            "time": k,
            "shot": 0,
            "frame_path": keys(k),
            "tid": [2],
            "tracked_time": [0],
            "bbox": [np.array([200.0, 100.0, 60.0, 180.0]) * size[1] / 640],
            "size": [size],
            "camera": [np.array([0.1, 0.2, 90.0])],
            "conf": [np.float32(0.9)],
            "mask": [{"size": size, "counts": b"abc"}],
            "smpl": [
                {
                    "global_orient": rotations[k, :1],
                    "body_pose": rotations[k, 1:],
                    "betas": b["betas"][k],
                }
            ],
        }
        for k in range(NUM)
    }


def test_phalp_of_a_resized_video(tmp_path):
    whole, said = read(pickled(tmp_path / "a.pkl", _phalp([480, 640])))
    assert not [text for text in said if "images of" in text]
    half, said = read(pickled(tmp_path / "b.pkl", _phalp([240, 320])))
    assert [text for text in said if "bodies of images of 320x240 px" in text]
    np.testing.assert_allclose(half.poses, whole.poses, atol=1e-9)
    np.testing.assert_allclose(half.trans, whole.trans)
    with pytest.raises(ValueError, match="480x640 px.*before it was turned upright"):
        read(pickled(tmp_path / "c.pkl", _phalp([640, 480])))


def test_phalp_that_read_the_video_itself(tmp_path):
    """Its frames are then called by the video and a time in its own units."""
    named, _ = read(pickled(tmp_path / "a.pkl", _phalp([480, 640])))
    data = _phalp([480, 640], keys=lambda k: ("walk.mp4", 512 * k))
    timed, _ = read(pickled(tmp_path / "b.pkl", data))
    np.testing.assert_allclose(timed.poses, named.poses)
