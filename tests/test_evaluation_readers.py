"""Ground truths from files: what is read, and what is said where it cannot be."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from bodyslam_jax import evaluation, export
from bodyslam_jax.body import joints, load_body_model
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.evaluation import read_groundtruth, read_result, read_tum

WALK = Path(__file__).parents[2] / "shared" / "sequences" / "walk"


@pytest.fixture(scope="module")
def body():
    return load_body_model(dtype=jnp.float64)


def _camera(path, times):
    T_WC = np.tile(np.eye(4), (len(times), 1, 1))
    T_WC[:, 0, 3] = times
    export.write_tum(path, times, T_WC)


def _person(num, width=72):
    """Walks along x at 1 m/s, in a file of 120 Hz."""
    poses = np.zeros((num, width))
    poses[:, 66:] = 0.1
    trans = np.stack([np.arange(num) / 120, np.zeros(num), np.zeros(num)], -1)
    return {"poses": poses, "trans": trans, "betas": np.ones(10 if width == 72 else 16)}


@pytest.mark.parametrize(
    "width, rate", [(72, "mocap_framerate"), (156, "mocap_frame_rate")]
)
def test_bodies_and_camera_of_different_rates(tmp_path, body, width, rate):
    """The denser sets the moments; both move at 1 m/s, so they stay together."""
    _camera(tmp_path / "camera.txt", 5.0 + np.arange(30) / 30)
    np.savez(tmp_path / "body.npz", **_person(117, width), **{rate: 120.0})
    found = read_groundtruth(tmp_path, body)
    assert found.timestamps.shape == (117,) and found.summary["has_camera"]
    np.testing.assert_allclose(found.T_WC[:, 0, 3], found.timestamps, atol=1e-9)
    np.testing.assert_allclose(found.trans[0, :, 0], found.timestamps - 5, atol=1e-9)
    assert found.present.all()
    expected = joints(
        body,
        jnp.asarray(found.poses[0, 3]),
        jnp.asarray(found.betas[0]),
        jnp.asarray(found.trans[0, 3]),
    )
    np.testing.assert_allclose(found.joints[0, 3], expected, atol=1e-9)
    if width == 156:  # fingers of SMPL-H are not hands of SMPL
        assert not found.poses.any()


def test_people_who_come_later_are_absent_first(tmp_path, body):
    """A body file shorter than the camera's: present as long as it lasts."""
    _camera(tmp_path / "camera.txt", np.arange(30) / 30)
    np.savez(tmp_path / "body.npz", **_person(40), mocap_framerate=120.0)
    found = read_groundtruth(tmp_path, body)
    longer = np.arange(40) / 120
    np.testing.assert_allclose(found.timestamps, longer, atol=1e-9)
    np.savez(tmp_path / "body.npz", **_person(20), mocap_framerate=30.0)
    found = read_groundtruth(tmp_path, body)
    np.testing.assert_array_equal(found.present[0], np.arange(30) < 20)


def test_bodies_after_the_last_camera_are_told(tmp_path, body, caplog):
    _camera(tmp_path / "camera.txt", np.arange(20) / 30)
    np.savez(tmp_path / "body.npz", **_person(40), mocap_framerate=30.0)
    assert len(read_groundtruth(tmp_path, body).timestamps) == 20
    (line,) = (record.getMessage() for record in caplog.records)
    assert line.startswith(f"{tmp_path / 'body.npz'}: 40 frames, of which the last 20 ")
    caplog.clear()
    np.savez(tmp_path / "body.npz", **_person(77), mocap_framerate=120.0)
    read_groundtruth(tmp_path, body)
    assert not caplog.records


def test_joints_of_the_file_win(tmp_path, body):
    other = np.random.default_rng(0).normal(0, 1, (9, 24, 3))
    np.savez(tmp_path / "b.npz", **_person(9), mocap_framerate=30.0, joints=other)
    found = read_groundtruth(tmp_path / "b.npz", body)
    np.testing.assert_array_equal(found.joints[0], other)
    assert not found.summary["has_camera"]


def test_camera_alone(tmp_path, body):
    _camera(tmp_path / "poses.tum", np.arange(4.0))
    found = read_groundtruth(tmp_path / "poses.tum", body)
    assert found.poses.shape == (0, 4, 72) and found.summary["has_camera"]


BAD = {
    "words": ("0 1 2 three 0 0 0 1\n", "line 1: '0 1 2 three"),
    "seven": ("# head\n0 1 2 3 0 0 1\n", "line 2:.*eight numbers"),
    "nan": ("0 nan 2 3 0 0 0 1\n", "line 1:"),
    "empty": ("# nothing\n", "no pose"),
    "zero quaternion": ("0 1 2 3 0 0 0 0\n", "length 0"),
    "twice": ("0 1 2 3 0 0 0 1\n0 1 2 3 0 0 0 1\n", "same timestamp"),
}


@pytest.mark.parametrize("text, message", BAD.values(), ids=BAD.keys())
def test_bad_trajectories_are_refused(tmp_path, text, message):
    (tmp_path / "camera.txt").write_text(text)
    with pytest.raises(ValueError, match=f"camera.txt.*{message}"):
        read_tum(tmp_path / "camera.txt")


def _without(name):
    return {k: v for k, v in _person(5).items() if k != name} | {
        "mocap_framerate": 30.0
    }


_good = _person(5) | {"mocap_framerate": 30.0}
BAD_BODIES = {
    "no poses": (_without("poses"), "no array poses"),
    "no rate": (_person(5), "no array mocap_framerate"),
    "zero rate": (_good | {"mocap_framerate": 0.0}, "is 0.0, expected 1 to 1000"),
    "lengths": (
        _good | {"trans": np.zeros((4, 3))},
        r"`trans` of shape \(4, 3\), expected \(5, 3\)",
    ),
    "nan": (
        _good | {"trans": np.full((5, 3), np.nan)},
        "15 of 15 numbers of `trans` not finite",
    ),
    "joints": (
        _good | {"joints": np.zeros((5, 22, 3))},
        r"`joints` of shape \(5, 22, 3\)",
    ),
    "two rates": (_good | {"mocap_framerate": [30.0, 60.0]}, "expected a number"),
    "text": (_good | {"trans": np.full((5, 3), "a")}, "`trans` holds <U1, not numbers"),
    "objects": (_good | {"poses": np.array([{}] * 5)}, "`poses` is a pickled object"),
}


@pytest.mark.parametrize("arrays, message", BAD_BODIES.values(), ids=BAD_BODIES.keys())
def test_bad_bodies_are_refused(tmp_path, body, arrays, message):
    np.savez(tmp_path / "body.npz", **arrays)
    with pytest.raises(ValueError, match=f"body.npz.*{message}"):
        read_groundtruth(tmp_path, body)


def test_what_is_not_there_is_said(tmp_path, body):
    with pytest.raises(InputError, match="no such ground truth"):
        read_groundtruth(tmp_path / "nowhere", body)
    with pytest.raises(ValueError, match="neither camera.txt nor body.npz"):
        read_groundtruth(tmp_path, body)
    with pytest.raises(InputError, match="result.npz"):
        read_result(tmp_path)
    (tmp_path / "result.npz").write_text("text")
    with pytest.raises(ValueError, match="not a run's result.npz, or damaged"):
        read_result(tmp_path)
    np.savez(tmp_path / "result.npz", T_WC=np.eye(4))
    with pytest.raises(ValueError, match="no array timestamps"):
        read_result(tmp_path)


def test_damaged_files_are_named(tmp_path, body):
    np.savez_compressed(tmp_path / "body.npz", **_good)
    bytes_ = bytearray((tmp_path / "body.npz").read_bytes())
    bytes_[80:140] = b"\x55" * 60
    (tmp_path / "body.npz").write_bytes(bytes_)
    with pytest.raises(ValueError, match="body.npz: not a true body .* or damaged"):
        read_groundtruth(tmp_path, body)
    np.savez(tmp_path / "body.npz", **_good)
    for array in (np.zeros(7), np.array([{}])):
        np.save(tmp_path / "landmarks.npy", array)
        with pytest.raises(ValueError, match="landmarks.npy"):
            read_groundtruth(tmp_path, body)
    (tmp_path / "landmarks.npy").unlink()
    export.write_run(tmp_path / "run", read_groundtruth(tmp_path, body))
    for text in ("[]", "{"):
        (tmp_path / "run" / "summary.json").write_text(text)
        with pytest.raises(ValueError, match="summary.json"):
            read_result(tmp_path / "run")


def test_a_place_between_two_frames_needs_both(tmp_path, body):
    _camera(tmp_path / "camera.txt", np.arange(30) / 30)
    present = np.arange(20) < 10
    person = _person(20) | {"present": present}
    person["trans"][~present] = 1e3
    np.savez(tmp_path / "body.npz", **person, mocap_framerate=20.0)
    found = read_groundtruth(tmp_path, body)
    assert found.present.any()
    assert np.all(abs(found.trans[found.present]) < 1)


@pytest.mark.slow
@pytest.mark.skipif(not WALK.exists(), reason="the shared example is not here")
def test_the_rendered_example_is_its_own_truth(body):
    truth = read_groundtruth(WALK, body)
    assert truth.joints.shape == (1, 300, 24, 3)
    found = evaluation.evaluate(truth, read_groundtruth(WALK / "groundtruth", body))
    assert float(found["j_ate_a4"]) < 1e-9 and float(found["jitter_of_truth"]) > 0
