"""Whether somebody sits of whom no leg is in view, and what is claimed of the legs."""

import dataclasses
import functools

import numpy as np
import pytest
from test_measurability import FEET, FRAMES, LEGS, hidden, judged, scene

from bodyslam_jax import motion
from bodyslam_jax.body import joints as joints_of
from bodyslam_jax.body import load_body_model
from bodyslam_jax.body.skeleton import ANKLES, HIPS, KNEES, WRISTS
from bodyslam_jax.body.skeleton import FEET as FEET_JOINTS
from bodyslam_jax.config import Config
from bodyslam_jax.diagnostics import seated
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.pipeline.run import assemble
from bodyslam_jax.pipeline.seated_legs import with_seated_legs
from bodyslam_jax.simulation.sequences import ASSETS
from bodyslam_jax.types import Bodies

ALL = np.ones(FRAMES, bool)
UNSEEN = LEGS + FEET


@functools.cache
def who_keeps_still():
    """The scene of somebody who walks, stopped at its first frame."""
    sequence, cameras, joint = scene()
    first = lambda x: np.repeat(x[:, :1], FRAMES, axis=1)
    roots, T_WC = joint.roots, joint.cameras
    world = first(T_WC @ roots)
    still = dataclasses.replace(
        joint, roots=np.linalg.inv(T_WC) @ world, poses=first(joint.poses)
    )
    return sequence, cameras, still


def test_who_keeps_still_may_sit_and_a_walker_hardly():
    walker, walking = judged(
        hidden(scene()[0], UNSEEN, np.arange(FRAMES)), *scene()[1:]
    )
    sequence, *rest = who_keeps_still()
    other, still = judged(hidden(sequence, UNSEEN, np.arange(FRAMES)), *rest)
    (of_walker,), (of_other,) = (x["people"][0]["sitting"] for x in (walker, other))
    assert of_walker["frames"] == of_other["frames"] == [0, FRAMES - 1]
    assert of_walker["probability"] < 0.2 and of_other["probability"] > 0.8
    (line,) = [x for x in other["warnings"] if "no knee and no ankle" in x]
    assert f"{100 * of_other['probability']:.0f} %" in line
    # Legs that sit where the person may stand are a thigh away from where they may be.
    for joints in (KNEES, ANKLES):
        assert (still[..., joints] > walking[..., joints]).all()
        assert (0.2 < still[..., joints]).all() and (still[..., joints] < 0.4).all()
    np.testing.assert_allclose(still[..., WRISTS], walking[..., WRISTS], rtol=0.1)


def test_legs_in_view_say_themselves_whether_somebody_sits():
    sequence, *rest = who_keeps_still()
    summary, sigma = judged(sequence, *rest)
    assert summary["people"][0]["sitting"] == []
    assert sigma[..., KNEES].max() < 0.15
    # One leg is enough, and so is a moment.
    for points, frames in (
        ([k for k in UNSEEN if k in (12, 13, 14, 19, 20, 21)], np.arange(FRAMES)),
        (UNSEEN, np.arange(30, 50)),
    ):
        summary, _ = judged(hidden(sequence, points, frames), *rest)
        assert summary["people"][0]["sitting"] == []


def test_a_knee_that_the_detector_makes_up_now_and_then_is_no_leg():
    keypoint = np.zeros((FRAMES, 25), bool)
    keypoint[[7, 40, 41, 42], LEGS[0]] = True
    assert seated.legs_unseen(keypoint, ALL, 30.0).all()
    keypoint[30:60, LEGS[0]] = True
    assert not seated.legs_unseen(keypoint, ALL, 30.0)[40:50].any()


def test_only_frames_without_legs_get_a_probability():
    sequence, *rest = who_keeps_still()
    summary, sigma = judged(hidden(sequence, UNSEEN, np.arange(40, FRAMES)), *rest)
    (one,) = summary["people"][0]["sitting"]
    first, last = one["frames"]
    assert 53 <= first <= 55 and last == FRAMES - 1  # Half a second after the last leg.
    knee = sigma[0, :, KNEES[0]]
    assert knee[39] < 0.1 < knee[50] < 0.2 < 0.35 < knee[70]


def test_a_body_that_sits_is_the_surer_the_more_the_person_keeps_still():
    joints = np.zeros((FRAMES, 24, 3))
    joints[:, KNEES] = joints[:, ANKLES] = [0.0, 0.0, 0.4]
    joints[:, ANKLES, 1] = -0.4
    moves = joints + [0.03, 0.0, 0.0] * np.arange(FRAMES)[:, None, None]
    wrong = lambda x: seated.other_posture_probability(x, ALL, 30.0)
    assert seated.thigh_angle(joints)[0] == pytest.approx(90.0)
    assert wrong(joints).max() < 0.2 and wrong(moves).min() > 0.6
    assert (seated.other_posture_probability(joints, ~ALL, 30.0) == 0).all()


def test_a_frame_rate_does_not_change_who_sits():
    t = np.arange(4 * 60) / 60
    pelvis = np.stack([0.04 * np.sin(2 * t), np.cos(t), 0.1 * np.cos(t)], axis=1)
    fine = seated.sitting_probability(pelvis, np.ones(len(t), bool), 60.0)
    coarse = seated.sitting_probability(pelvis[::2], np.ones(len(t) // 2, bool), 30.0)
    np.testing.assert_allclose(fine[::2], coarse, atol=0.02)
    assert np.ptp(coarse) > 0.05


def test_noise_of_depth_does_not_make_a_person_stand():
    """The pelvis moves by 4 cm along the view or across it, or by 40 cm along."""
    t = np.arange(120) / 30
    eyes = np.tile([0.0, 1.5, -4.0], (120, 1))
    to_and_fro = 0.04 * np.sqrt(2) * np.sin(2 * np.pi * t)
    path = lambda axis, size: np.eye(3)[axis] * (size * to_and_fro)[:, None]
    sits = lambda pelvis: seated.sitting_probability(
        pelvis, np.ones(120, bool), 30.0, eyes
    )[20:-20]
    assert sits(path(2, 1.0)).min() > 0.8
    assert sits(path(0, 1.0)).max() < 0.6
    assert sits(path(2, 10.0)).max() < 0.2


def test_recorded_people_are_told_apart():
    """Subject 14 is among those from whom the constants come, those of `walking.npz`
    count with all other walkers."""
    (sits,) = [c for c in motion.read_motion(ASSETS / "other.npz") if c.name == "14_32"]
    walks = motion.read_motion(ASSETS / "walking.npz")

    def probability(clip):
        return seated.sitting_probability(
            clip.trans, np.ones(len(clip.trans), bool), clip.fps
        )

    hips = np.degrees(np.linalg.norm(sits.poses[:, [1, 2]], axis=-1)).mean(axis=1)
    assert (hips > 70).sum() > 50
    assert probability(sits)[hips > 70].mean() > 0.6
    assert max(probability(clip).mean() for clip in walks) < 0.25


def assembled(sequence, cameras, joint):
    """The result, and the angles of all joints but the root."""
    result = assemble(sequence, Config(), load_body_model(), cameras, joint, {})
    return result, result.poses.reshape(1, FRAMES, 24, 3)[:, :, 1:]


def test_hidden_legs_of_who_keeps_still_sit_and_nothing_else_moves():
    sequence, cameras, joint = who_keeps_still()
    unseen = hidden(sequence, UNSEEN, np.arange(FRAMES))
    whole, _ = assembled(sequence, cameras, joint)
    result, angles = assembled(unseen, cameras, joint)
    assert seated.thigh_angle(whole.joints[0]).max() < 40
    assert seated.thigh_angle(result.joints[0]).min() > 65
    legs = np.subtract([*HIPS, *KNEES, *ANKLES], 1)
    np.testing.assert_array_equal(
        np.delete(angles, legs, axis=2), np.delete(joint.poses, legs, axis=2)
    )
    # A seat is no floor: feet are on it, and the pelvis is lower by the thighs.
    assert abs(result.joints[..., FEET_JOINTS, 1]).max() < 0.2
    lower = whole.joints[0, :, 0, 1] - result.joints[0, :, 0, 1]
    assert (0.2 < lower).all() and (lower < 0.5).all()


@pytest.mark.parametrize("seen", ["walks", "a leg is in view", "a regressor's body"])
def test_legs_of_whoever_else_are_those_of_the_estimate(seen):
    sequence, cameras, joint = scene() if seen == "walks" else who_keeps_still()
    points = [k for k in UNSEEN if seen != "a leg is in view" or k != UNSEEN[0]]
    sequence = hidden(sequence, points, np.arange(FRAMES))
    if seen == "a regressor's body":
        there = np.ones((1, FRAMES), bool)
        zeros = lambda n: np.zeros((1, FRAMES, n))
        bodies = Bodies(there, zeros(72), zeros(10), zeros(3))
        sequence = dataclasses.replace(sequence, bodies=bodies)
        angles = assembled(sequence, cameras, joint)[1]
        np.testing.assert_allclose(angles, joint.poses, atol=1e-6)  # Low-passed.
    else:
        np.testing.assert_array_equal(
            assembled(sequence, cameras, joint)[1], joint.poses
        )


def test_where_feet_were_seen_to_stand_legs_sit_only_as_high_as_a_seat():
    """Legs are in view for 40 frames; then they are hidden, the pelvis as high as
    before, or 0.4 m lower."""
    sequence, cameras, joint = who_keeps_still()
    unseen = hidden(sequence, UNSEEN, np.arange(40, FRAMES))
    stays, angles = assembled(unseen, cameras, joint)
    np.testing.assert_array_equal(angles, joint.poses)
    assert stays.summary["people"][0]["sitting"]
    roots = joint.roots.copy()
    down = -np.einsum("tji,j->ti", joint.cameras[:, :3, :3], [0.0, 0.4, 0.0])
    roots[0, 41:, :3, 3] += down[41:]
    sits, angles = assembled(unseen, cameras, dataclasses.replace(joint, roots=roots))
    thighs = seated.thigh_angle(sits.joints[0])
    np.testing.assert_array_equal(angles[:, :53], joint.poses[:, :53])
    assert thighs[:53].max() < 40 and np.abs(np.diff(thighs)).max() < 5
    assert thighs[86:].min() > 60
    assert abs(sits.joints[0, 86:][:, FEET_JOINTS, 1]).max() < 0.2


def test_legs_are_posed_as_recorded_people_sit():
    (clip,) = [c for c in motion.read_motion(ASSETS / "other.npz") if c.name == "14_32"]
    hips = np.degrees(np.linalg.norm(clip.poses[:, [1, 2]], axis=-1)).mean(axis=1)
    poses = clip.poses[hips > 70].reshape(1, -1, 72).astype(float)
    frames = poses.shape[1]
    legs = poses.reshape(1, frames, 24, 3).copy()
    legs[:, :, [*HIPS, *KNEES, *ANKLES]] = 0.0
    hang = legs.reshape(1, frames, 72)
    body, nobody = load_body_model(), np.zeros((1, 1, 10))
    place = lambda x: np.asarray(joints_of(body, x, nobody, np.zeros((1, frames, 3))))
    shown, present = np.zeros((1, frames, 25), bool), np.ones((1, frames), bool)
    found = with_seated_legs(hang, place(hang), shown, present, clip.fps)
    error = lambda x, joint: np.linalg.norm(
        (place(x) - place(poses))[:, :, joint], axis=-1
    ).mean()
    assert error(found, KNEES) < 0.2 and error(found, ANKLES) < 0.25
    assert error(hang, KNEES) > 0.4 and error(hang, ANKLES) > 0.4


def test_the_pitch_of_a_pelvis_whose_thighs_are_hidden_is_not_up():
    """The pelvis is pitched by 25 degrees under a trunk that stays as it was."""
    sequence, cameras, joint = scene()
    pitch = so3.exp(np.array([np.radians(25.0), 0.0, 0.0]))
    roots, poses = joint.roots.copy(), joint.poses.copy()
    roots[..., :3, :3] = roots[..., :3, :3] @ pitch
    spine = pitch.T @ so3.exp(poses[:, :, 2])
    poses[:, :, 2] = so3.log(spine)
    leant = dataclasses.replace(joint, roots=roots, poses=poses)
    unseen = hidden(sequence, UNSEEN, np.arange(FRAMES))

    def off_vertical(sequence, estimate):
        """Angle between up and the true up in the first camera, degrees."""
        body = load_body_model()
        result = assemble(sequence, Config(), body, cameras, estimate, {})
        up = result.T_WC[0, :3, :3].T @ [0.0, 1.0, 0.0]
        true = joint.cameras[0, :3, :3].T @ [0.0, 1.0, 0.0]
        return np.degrees(np.arccos(up @ true))

    assert off_vertical(unseen, leant) < 8.0 < 15.0 < off_vertical(sequence, leant)
