"""Whether somebody sits of whom no leg is in view, and what is claimed of the legs."""

import dataclasses
import functools

import numpy as np
import pytest
from test_measurability import FEET, FRAMES, LEGS, hidden, judged, scene

from bodyslam_jax import motion
from bodyslam_jax.body import load_body_model
from bodyslam_jax.body.skeleton import ANKLES, KNEES, WRISTS
from bodyslam_jax.config import Config
from bodyslam_jax.diagnostics import seated
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.pipeline.run import assemble
from bodyslam_jax.simulation.sequences import ASSETS

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
    # Legs that hang where the person may sit are a thigh away from where they may be.
    for joints in (KNEES, ANKLES):
        assert (still[..., joints] > 1.3 * walking[..., joints]).all()
        assert (0.35 < still[..., joints]).all() and (still[..., joints] < 0.6).all()
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
