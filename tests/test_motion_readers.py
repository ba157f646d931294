"""What readers of motion make of odd files: leg lengths, spellings, refusals."""

import jax.numpy as jnp
import numpy as np
import pytest
from test_motion_data import make_clip, write_amass, write_bvh, write_cmu

from bodyslam_jax.body import joints, load_body_model, rest_joints
from bodyslam_jax.motion import read_motion
from bodyslam_jax.motion.capture.clips import leg_length


@pytest.fixture(scope="module")
def tall():
    """A tall person who walks in a world with y up: arrays of a file, leg length."""
    body, clip = load_body_model(), make_clip()
    dtype = body.template.dtype
    shape = jnp.zeros(10, dtype).at[0].set(2.0)
    poses = clip.poses.reshape(-1, 72)
    as_body = [jnp.asarray(x, dtype) for x in (poses, shape, clip.trans)]
    arrays = {
        "poses": poses,
        "trans": clip.trans,
        "joints": np.asarray(joints(body, *as_body)),
    }
    return arrays, float(leg_length(np.asarray(rest_joints(body, shape))))


def upright(t=50):
    """Poses of somebody who stands in a world with y up."""
    return np.zeros((t, 156))


def at(height, t=50):
    """Positions at a height (m) in a world with y up."""
    return np.tile([3.0, height, 2.0], (t, 1))


def test_legs_are_measured_by_the_joints_of_a_file(tmp_path, tall):
    arrays, leg = tall
    write_amass(tmp_path / "groundtruth" / "body.npz", **arrays)
    (clip,) = read_motion(tmp_path)
    assert clip.leg_length == pytest.approx(leg, abs=1e-4)  # joints are float32


def test_height_is_measured_along_the_axis_that_is_up(tmp_path):
    """With y up the pelvis is 0.22 m below the origin: rotations pivot about it."""
    write_amass(tmp_path / "s" / "a.npz", poses=upright(), trans=at(1.15))
    write_amass(tmp_path / "s" / "b.npz", trans=at(0.0) + [0, 0, 0.9 - 2.0])
    for clip in read_motion(tmp_path):
        assert clip.leg_length == pytest.approx(0.8, abs=1e-3)


LYING = np.zeros((50, 156))
LYING[:, 2] = np.pi / 2  # the root's y axis points along the world's -x


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"trans": np.zeros((50, 3))}, "pelvis is 0.03 m up in z; expected 0.7 to 1.3"),
        ({"poses": upright()}, "pelvis is -0.22 m up in y"),
        ({"poses": LYING}, r"mean up is \[-1.0, 0.0, 0.0\]; expected a person who"),
    ],
)
def test_a_sequence_without_leg_length_is_skipped(tmp_path, caplog, changes, message):
    file = tmp_path / "s" / "a.npz"
    write_amass(file, **changes)
    for path in (file, tmp_path):
        with pytest.raises(ValueError, match=message) as error:
            read_motion(path)
        assert str(file) in str(error.value)
    assert not caplog.records  # the error says it
    write_amass(tmp_path / "s" / "b.npz")
    assert [clip.name for clip in read_motion(tmp_path)] == ["b"]
    (record,) = caplog.records
    assert f"passed over 1 of 2 files; the first: {file}" in record.getMessage()


@pytest.mark.parametrize(
    ("factor", "frames", "message"),
    [
        (1e3, 50, r"legs of \d+ by its joints; expected 0.6 to 1.1 m"),
        (np.nan, 50, "legs of nan"),
        (1.0, 49, r"joints \(49, 24, 3\); expected \(50, 24, 3\)"),
    ],
)
def test_implausible_joints_are_one_line(tmp_path, tall, factor, frames, message):
    arrays = tall[0] | {"joints": factor * tall[0]["joints"][:frames]}
    write_amass(tmp_path / "s" / "a.npz", **arrays)
    with pytest.raises(ValueError, match=f"a.npz: {message}"):
        read_motion(tmp_path)


def test_joints_of_another_skeleton_are_ignored(tmp_path):
    write_amass(tmp_path / "s" / "a.npz", joints=np.zeros((50, 22, 3)))
    assert read_motion(tmp_path)[0].leg_length == pytest.approx(0.8, abs=0.03)


def test_only_frames_with_a_person_are_motion(tmp_path, tall):
    arrays = {name: np.array(value) for name, value in tall[0].items()}
    there = np.ones(50, bool)
    there[[3, 40, 41]] = False
    for name in ("poses", "trans", "joints"):
        arrays[name][~there] = 0.0
    path = tmp_path / "s" / "a.npz"
    write_amass(path, **arrays, present=there)
    (clip,) = read_motion(path)
    np.testing.assert_allclose(clip.trans, tall[0]["trans"][4:40], atol=1e-6)
    assert clip.leg_length == pytest.approx(tall[1], abs=1e-4)
    write_amass(path, **arrays, present=there.astype(np.int8))
    np.testing.assert_array_equal(read_motion(path)[0].trans, clip.trans)
    for wrong in (np.zeros(50, bool), np.ones(49, bool), np.full(50, 2), np.ones(50)):
        write_amass(path, **arrays, present=wrong)
        with pytest.raises(ValueError, match="a.npz: present is .*; expected bool"):
            read_motion(path)


def test_a_rate_may_be_an_array_of_one(tmp_path):
    write_amass(tmp_path / "s" / "a.npz", mocap_framerate=np.array([30.0]))
    write_cmu(tmp_path / "cmu.npz", [make_clip(40)], fps=np.array([30]))
    assert [clip.fps for clip in read_motion(tmp_path)] == [30.0, 30.0]


def split_poses(path, root=lambda x: x, body=lambda x: x):
    write_amass(path)
    with np.load(path) as archive:
        whole = dict(archive)
    poses = whole.pop("poses")
    parts = {"root_orient": root(poses[:, :3]), "pose_body": body(poses[:, 3:66])}
    np.savez(path, **parts, **whole)


def test_angles_may_be_stored_joint_by_joint(tmp_path):
    split_poses(tmp_path / "s" / "a.npz")
    split_poses(tmp_path / "s" / "b.npz", body=lambda x: x.reshape(-1, 21, 3))
    flat, by_joint = read_motion(tmp_path)
    np.testing.assert_array_equal(by_joint.poses, flat.poses)


def test_root_and_body_of_other_lengths_are_one_line(tmp_path):
    split_poses(tmp_path / "s" / "a.npz", body=lambda x: x[:40])
    message = r"a.npz: root_orient \(50, 3\), pose_body \(40, 63\); expected"
    with pytest.raises(ValueError, match=message):
        read_motion(tmp_path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"poses": np.full((50, 156), "a")}, "array `poses` holds <U1, not numbers"),
        ({"poses": np.ones((50, 156), complex)}, "array `poses` holds complex128"),
        ({"trans": np.full((50, 3), "a")}, "array `trans` holds <U1"),
        ({"mocap_framerate": np.array("fast")}, "array `mocap_framerate` holds <U4"),
        (
            {"mocap_framerate": np.array(np.inf)},
            "1 of 1 numbers of `mocap_framerate` not",
        ),
        ({"mocap_framerate": np.array([30, 60])}, r"frame rate \[30.0, 60.0\]"),
        ({"poses": np.array(1.0)}, r"poses \(\); expected \(t, 66 or more\)"),
        ({"poses": np.zeros(50)}, r"poses \(50,\); expected \(t, 66 or more\)"),
    ],
)
def test_arrays_that_are_no_motion_are_one_line(tmp_path, changes, message):
    write_amass(tmp_path / "s" / "a.npz", **changes)
    with pytest.raises(ValueError, match=f"a.npz: {message}"):
        read_motion(tmp_path)


def test_names_of_files_may_be_in_capitals(tmp_path):
    write_amass(tmp_path / "s" / "a.NPZ.npz")
    (tmp_path / "s" / "a.NPZ.npz").rename(tmp_path / "s" / "a.NPZ")
    write_bvh(tmp_path / "b.BVH", np.zeros((5, 30)))
    assert {clip.name for clip in read_motion(tmp_path)} == {"a", "b"}


def respelt(path, old, new):
    path.write_text(path.read_text().replace(old, new))


@pytest.mark.parametrize("spelling", ["Rotation", "ROTATION"])
def test_channels_may_be_in_capitals(tmp_path, spelling):
    rows = np.random.default_rng(0).uniform(-20, 20, (5, 30))
    for name in ("a.bvh", "b.bvh"):
        write_bvh(tmp_path / name, rows)
    respelt(tmp_path / "b.bvh", "rotation", spelling)
    respelt(tmp_path / "b.bvh", "position", "Position")
    first, second = read_motion(tmp_path)
    np.testing.assert_array_equal(second.poses, first.poses)
    np.testing.assert_array_equal(second.trans, first.trans)


def test_position_channels_are_recognised_by_name(tmp_path):
    rows = np.random.default_rng(0).uniform(-20, 20, (5, 30))
    write_bvh(tmp_path / "a.bvh", rows)
    rows[:, :3] = rows[:, [2, 0, 1]]
    write_bvh(tmp_path / "b.bvh", rows)
    order = "Xposition Yposition Zposition"
    respelt(tmp_path / "b.bvh", order, "Zposition Xposition Yposition")
    first, second = read_motion(tmp_path)
    np.testing.assert_array_equal(second.trans, first.trans)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("Zrotation", "Wrotation", "channel 'wrotation' of Hips; expected Xposition"),
        ("OFFSET 10 -8 0", "OFFSET 10 nan 0", r"OFFSET .*nan.* of LeftUpLeg; expected"),
        ("Time: 0.0083333", "Time: 0", "Frame Time 0; expected 0.001 to 1 s"),
        ("Time: 0.0083333", "Time: nan", "Frame Time nan; expected 0.001 to 1 s"),
        ("Frames: 5", "Frames: 0", "0 frames; expected one or more"),
    ],
)
def test_an_invalid_bvh_is_one_line(tmp_path, old, new, message):
    write_bvh(tmp_path / "a.bvh", np.zeros((5, 30)))
    respelt(tmp_path / "a.bvh", old, new)
    with pytest.raises(ValueError, match=f"a.bvh: {message}"):
        read_motion(tmp_path)
