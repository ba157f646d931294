"""Readers, resampling, placing on the body, and the noise of estimates."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bodyslam_jax.body import PARENTS, load_body_model, rest_joints
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.geometry import so3
from bodyslam_jax.motion import disturb, drift, fit_shape, place, read_motion, resample
from bodyslam_jax.motion.capture.clips import (
    Clip,
    interleave,
    leg_length,
    mirror,
    rest_from_offsets,
    root_matrices,
    split,
)
from bodyslam_jax.motion.capture.readers import gender
from bodyslam_jax.motion.training.sampling import CORRELATION


def make_clip(t=50, fps=30.0, seed=0, **changes):
    """A smooth synthetic motion along z."""
    rng = np.random.default_rng(seed)
    time = np.arange(t) / fps
    size, shift = rng.normal(0, 0.3, (24, 3)), rng.uniform(0, 6, (24, 3))
    poses = size * np.sin(6 * time[:, None, None] + shift)
    trans = np.stack([0.05 * np.sin(6 * time), 0.9 + 0 * time, 1.2 * time], -1)
    offsets = np.zeros((24, 3), np.float32)
    offsets[[1, 2], 1] = -0.09
    offsets[[4, 5, 7, 8], 1] = -0.4
    clip = Clip(
        name="a_01",
        subject="a",
        motion="walk",
        split="train",
        fps=fps,
        poses=poses.astype(np.float32),
        trans=trans.astype(np.float32),
        offsets=offsets,
        leg_length=0.8,
    )
    return dataclasses.replace(clip, **changes)


def write_cmu(path, clips, **changes):
    """The archive's layout, with clips of one phase."""
    lengths = [len(clip.poses) for clip in clips]
    arrays = dict(
        poses=np.concatenate([clip.poses for clip in clips]),
        trans=np.concatenate([clip.trans for clip in clips]),
        fps=np.int32(30),
        parents=np.array(PARENTS),
        seq_start=np.cumsum([0, *lengths[:-1]]),
        seq_length=np.array(lengths),
        seq_name=np.array([clip.name for clip in clips]),
        seq_motion=np.array([clip.motion for clip in clips]),
        seq_subject=np.array([clip.subject for clip in clips]),
        seq_split=np.array([clip.split for clip in clips]),
        seq_phase=np.array([clip.phase for clip in clips]),
        subjects=np.array(sorted({clip.subject for clip in clips})),
        subject_offsets=np.stack(
            [
                next(c.offsets for c in clips if c.subject == subject)
                for subject in sorted({clip.subject for clip in clips})
            ]
        ),
    )
    np.savez(path, **(arrays | changes))


def write_amass(path, t=50, rate=120.0, key="mocap_framerate", **changes):
    """A file like AMASS's: z is up, also in root orientations."""
    rng = np.random.default_rng(0)
    poses = rng.normal(0, 0.1, (t, 156))
    poses[:, 0] += np.pi / 2
    arrays = {
        "poses": poses,
        "trans": np.stack(
            [np.arange(t) / rate, 0 * np.arange(t), 0.93 + 0 * np.arange(t)], -1
        ),
        "betas": np.zeros(16),
        "gender": np.array(b"female"),
        key: np.array(rate),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, **(arrays | changes))


@pytest.mark.parametrize("key", ["mocap_framerate", "mocap_frame_rate"])
def test_amass_both_spellings_of_the_rate(tmp_path, key):
    write_amass(tmp_path / "subject1" / "walk_01_poses.npz", key=key)
    (clip,) = read_motion(tmp_path)
    assert (clip.fps, clip.subject, clip.motion) == (120.0, "subject1", "walk")
    assert clip.poses.shape == (50, 24, 3)
    assert (clip.poses[:, 22:] == 0).all()  # SMPL's hands are not SMPL-H's fingers
    assert clip.leg_length == pytest.approx(0.8, abs=0.03)


def test_amass_with_z_up_holds_the_same_steps(tmp_path):
    """A world turned so that z is up: from the body, nothing has changed."""
    clip = make_clip(40)
    turn = so3.exp(jnp.array([np.pi / 2, 0.0, 0.0]))
    root = so3.log(turn @ so3.exp(jnp.asarray(clip.poses[:, 0], jnp.float64)))
    poses = np.zeros((40, 156))
    poses[:, :66] = clip.poses[:, :22].reshape(40, 66)
    poses[:, :3] = root
    trans = clip.trans @ np.asarray(turn).T
    np.testing.assert_allclose(trans[:, 2], clip.trans[:, 1], atol=1e-6)
    write_amass(tmp_path / "s" / "walk.npz", 40, 30.0, poses=poses, trans=trans)
    (found,) = read_motion(tmp_path)
    steps = lambda c: np.einsum(
        "tba,tb->ta", root_matrices(c)[:-1], np.diff(c.trans, axis=0)
    )
    np.testing.assert_allclose(steps(found), steps(clip), atol=1e-5)
    # the pelvis is 3 cm above the origin whose height AMASS tells
    assert found.leg_length == pytest.approx(0.86 * 0.93, abs=0.01)


@pytest.mark.parametrize("value", [np.array(b"female"), np.array("female")])
def test_gender_as_text_or_bytes(tmp_path, value):
    write_amass(tmp_path / "s" / "a.npz", gender=value)
    assert gender(tmp_path / "s" / "a.npz") == "female"


def test_amass_split_into_root_and_body(tmp_path):
    write_amass(tmp_path / "s" / "a.npz")
    with np.load(tmp_path / "s" / "a.npz") as archive:
        whole = dict(archive)
    poses = whole.pop("poses")
    np.savez(
        tmp_path / "s" / "b.npz",
        root_orient=poses[:, :3],
        pose_body=poses[:, 3:66],
        **whole,
    )
    first, second = read_motion(tmp_path)
    np.testing.assert_array_equal(first.poses, second.poses)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"trans": np.full((50, 3), np.nan)}, "NaN or infinite position in frame 0"),
        ({"poses": np.zeros((50, 60))}, r"poses \(50, 60\).*expected"),
        ({"poses": np.zeros((49, 156))}, "49 poses but 50 positions"),
        ({"mocap_framerate": np.array(0.0)}, "frame rate 0"),
        ({"poses": np.array([{}], dtype=object)}, "pickled object"),
    ],
)
def test_a_damaged_amass_file_is_one_line(tmp_path, changes, message):
    file = tmp_path / "s" / "a.npz"
    write_amass(file, **changes)
    with pytest.raises(ValueError, match=message) as error:
        read_motion(tmp_path)
    assert str(file) in str(error.value)
    assert "\n" not in str(error.value)


def test_a_folder_without_motion(tmp_path):
    np.savez(tmp_path / "something.npz", a=np.zeros(3))
    with pytest.raises(ValueError, match="no usable motion among 1"):
        read_motion(tmp_path)
    with pytest.raises(ValueError, match="something.npz: no motion, but a; expected"):
        read_motion(tmp_path / "something.npz")
    write_amass(tmp_path / "s" / "walk.npz")
    assert len(read_motion(tmp_path)) == 1  # beside something else
    (tmp_path / "s" / "walk.npz").unlink()
    with pytest.raises(InputError):
        read_motion(tmp_path / "nowhere")
    write_amass(tmp_path / "broken.npz")
    whole = (tmp_path / "broken.npz").read_bytes()
    for torn in (b"PK not really", b"", whole[: len(whole) // 2]):
        (tmp_path / "broken.npz").write_bytes(torn)
        with pytest.raises(ValueError, match="broken.npz: not motion"):
            read_motion(tmp_path)
    flipped = bytearray(whole)
    flipped[1000] ^= 255  # within `poses`: the archive's checksum notices
    (tmp_path / "broken.npz").write_bytes(flipped)
    with pytest.raises(ValueError, match="broken.npz: .*a whole poses.npy, or damaged"):
        read_motion(tmp_path)


def test_cmu_archive(tmp_path):
    clips = [make_clip(40), make_clip(30, seed=1, subject="b", name="b_01")]
    write_cmu(tmp_path / "cmu.npz", clips)
    found = read_motion(tmp_path / "cmu.npz")
    assert [c.name for c in found] == ["a_01", "b_01"]
    np.testing.assert_array_equal(found[1].poses, clips[1].poses)
    assert found[0].leg_length == pytest.approx(0.8)
    bad = np.concatenate([clip.poses for clip in clips])
    bad[45] = np.nan
    write_cmu(tmp_path / "bad.npz", clips, poses=bad)
    with pytest.raises(ValueError, match="b_01 has a NaN or infinite pose in frame 5"):
        read_motion(tmp_path / "bad.npz")


BVH = """HIERARCHY
ROOT Hips
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Yrotation Xrotation
%s}
MOTION
Frames: %d
Frame Time: 0.0083333
%s
"""


def write_bvh(path, rows, legs=40.0):
    def joint(name, offset, inside):
        return (
            f"JOINT {name}\n{{\nOFFSET {offset}\n"
            f"CHANNELS 3 Zrotation Yrotation Xrotation\n{inside}}}\n"
        )

    end = "End Site\n{\nOFFSET 0 0 10\n}\n"
    body = ""
    for side, x in (("Left", 10), ("Right", -10)):
        toe = joint(f"{side}ToeBase", "0 -5 12", end)
        foot = joint(f"{side}Foot", f"0 {-legs} 0", toe)
        body += joint(
            f"{side}UpLeg", f"{x} -8 0", joint(f"{side}Leg", f"0 {-legs} 0", foot)
        )
    path.write_text(
        BVH % (body, len(rows), "\n".join(" ".join(map(str, row)) for row in rows))
    )


def test_bvh_knee_and_unit(tmp_path):
    rows = np.zeros((5, 30))
    rows[:, 2] = np.arange(5) * 1.0  # 1 cm a frame forward
    rows[:, 11] = [0, 30, 60, 90, 110]  # left knee about x, degrees
    write_bvh(tmp_path / "07_01.bvh", rows)
    (clip,) = read_motion(tmp_path)
    assert clip.fps == pytest.approx(120, rel=1e-3)
    assert clip.leg_length == pytest.approx(0.8)
    np.testing.assert_allclose(clip.trans[:, 2], np.arange(5) * 0.01, atol=1e-6)
    # forward kinematics gives the capture's own shin, whatever SMPL's rest pose is
    turns = so3.exp(jnp.asarray(clip.poses))
    thigh = turns[:, 0] @ turns[:, 1]
    shin = thigh @ turns[:, 4]
    direction = np.asarray(shin @ jnp.asarray(clip.offsets[7] / 0.4))
    angle = np.rad2deg(np.arctan2(-direction[:, 2], -direction[:, 1]))
    np.testing.assert_allclose(angle, [0, 30, 60, 90, 110], atol=1e-3)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("nothing", "not a BVH file"),
        (BVH % ("", 2, "0 0 0 0 0 0"), "6 numbers; expected 2 frames of 6"),
        (BVH % ("", 1, "0 0 0 0 0 0"), "no joint LeftUpLeg or LHip"),
        (BVH % ("", 1, "0 0 nan 0 0 0"), "NaN"),
    ],
)
def test_a_damaged_bvh_is_one_line(tmp_path, text, message):
    (tmp_path / "a.bvh").write_text(text)
    with pytest.raises(ValueError, match=message):
        read_motion(tmp_path)


def test_resampling_keeps_exact_frames_and_interpolates_turns():
    clip = make_clip(121, fps=120.000045776367)
    (exact,) = resample([clip])
    np.testing.assert_array_equal(exact.poses, clip.poses[::4])
    np.testing.assert_array_equal(exact.trans, clip.trans[::4])
    # a joint turning at constant speed about one axis, 100 -> 30 frames per second
    t = np.arange(101) / 100.0
    poses = np.zeros((101, 24, 3), np.float32)
    poses[:, 4, 0] = 2.5 * t
    (at30,) = resample([dataclasses.replace(make_clip(101), fps=100.0, poses=poses)])
    assert len(at30.poses) == 31
    np.testing.assert_allclose(at30.poses[:, 4, 0], 2.5 * np.arange(31) / 30, atol=1e-5)


def test_phases_are_merged():
    dense = make_clip(83, fps=120.0)
    parts = [
        dataclasses.replace(
            dense,
            fps=30.0,
            poses=dense.poses[i::4],
            trans=dense.trans[i::4],
            phase=i,
            phases=4,
        )
        for i in (2, 0, 3, 1)
    ]
    (whole,) = interleave(parts)
    assert whole.fps == 120
    np.testing.assert_array_equal(whole.poses, dense.poses[:80])
    assert interleave(parts[:2]) == tuple(sorted(parts[:2], key=lambda c: c.phase))


def test_mirroring_twice_changes_nothing():
    clip = make_clip()
    twice = mirror(mirror(clip))
    np.testing.assert_array_equal(twice.poses, clip.poses)
    np.testing.assert_array_equal(twice.offsets, clip.offsets)
    assert not np.array_equal(mirror(clip).poses, clip.poses)


def test_fitted_shape_has_the_legs_of_the_subject():
    body = load_body_model()
    shape = jnp.asarray([1.0, -0.5, 0.3, 0, 0, 0, 0, 0, 0, 0], body.template.dtype)
    rest = np.asarray(rest_joints(body, shape), float)
    offsets = np.zeros((24, 3))
    for k in range(1, 24):
        offsets[k] = rest[k] - rest[PARENTS[k]]
    found = fit_shape(body, offsets)
    fitted = np.asarray(rest_joints(body, jnp.asarray(found, shape.dtype)))
    assert leg_length(fitted) == pytest.approx(leg_length(rest), abs=2e-3)
    np.testing.assert_allclose(
        rest_from_offsets(offsets, PARENTS), rest - rest[0], atol=1e-12
    )


def test_placing_moves_the_hips_in_proportion_to_the_legs():
    body = load_body_model()
    poses = np.zeros((50, 24, 3), np.float32)  # upright: pelvis moves as hips do
    (trial,) = place(body, [make_clip(poses=poses)])
    rest = np.asarray(rest_joints(body, jnp.asarray(trial.shape, body.template.dtype)))
    ratio = leg_length(rest) / 0.8
    walked = trial.trans[-1] - trial.trans[0]
    np.testing.assert_allclose(
        walked, ratio * (make_clip().trans[-1] - make_clip().trans[0]), atol=1e-5
    )


def test_drift_has_the_stated_size_and_memory(key):
    noise = jax.vmap(lambda k: drift(k, 40, jnp.float64(2.0), jnp.float64(0.0)))(
        jax.random.split(key, 300)
    )
    assert float(noise[:, :, 1].std()) == pytest.approx(2.0, rel=0.03)
    assert float(noise[:, :, 7].std()) == pytest.approx(3.0, rel=0.03)
    both = (noise[:, 1:, 1] * noise[:, :-1, 1]).mean() / (noise[:, :, 1] ** 2).mean()
    assert float(both) == pytest.approx(CORRELATION, abs=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("angle", [0.0, 1e-9, 1.0, jnp.pi])
def test_disturb_has_finite_derivatives(angle):
    poses = jnp.zeros((1, 24, 3)).at[0, :, 0].set(angle)
    slope = jax.grad(lambda p: disturb(p, 0.1 * jnp.ones_like(p)).sum())(poses)
    assert jnp.isfinite(slope).all()


def test_no_subject_is_on_both_sides():
    clips = [
        make_clip(20, subject=s, split=p)
        for s, p in zip("aabc", ["train", "other", "val", "train"])
    ]
    clips.append(make_clip(20, subject="b", split="other"))
    training, validation = split(clips)
    assert {c.subject for c in training} == {"a", "c"}
    assert [c.split for c in validation] == ["val"]
    unnamed = [make_clip(20, subject=s, split="") for s in "abcdefghij"]
    training, validation = split(unnamed)
    assert len(training) == 8
    assert not {c.subject for c in training} & {c.subject for c in validation}
    assert split(unnamed[:1]) == ((unnamed[0],), ())
