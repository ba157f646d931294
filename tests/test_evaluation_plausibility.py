"""Gravity, feet, knees and acceleration of an estimate beside those of the truth."""

import dataclasses
import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bodyslam_jax import evaluation, simulation
from bodyslam_jax.config import Simulation
from bodyslam_jax.diagnostics import posture

FPS = 30.0


@pytest.fixture(scope="module")
def truth():
    return simulation.as_truth(
        simulation.simulate(
            Simulation(sequence="M1", family="follow", length=60, noise="none", seed=3)
        )
    )


def moved(result, turn, up=0.0):
    """The same result in another world."""
    R = Rotation.from_rotvec(turn).as_matrix()
    T = np.eye(4)
    T[:3, :3], T[1, 3] = R, up
    at = lambda points: points @ R.T + T[:3, 3]
    return dataclasses.replace(
        result, T_WC=T @ result.T_WC, joints=at(result.joints), trans=at(result.trans)
    )


def test_gravity_that_is_off_is_seen_whatever_the_heading(truth):
    tilt = np.radians(3.0)
    tilted = moved(moved(truth, np.array([0, 1.2, 0])), np.array([tilt, 0.0, 0.0]))
    found = evaluation.evaluate(tilted, truth)
    assert float(found["gravity_error"]) == pytest.approx(tilt, rel=1e-4)
    assert float(found["h_ate_se3"]) < 1e-6
    same = evaluation.evaluate(moved(truth, np.array([0, 1.2, 0])), truth)
    assert float(same["gravity_error"]) < 1e-6
    # A truth whose z axis is up is one all the same.
    other = moved(truth, np.array([np.pi / 2, 0.0, 0.0]))
    found = evaluation.evaluate(tilted, other)
    assert float(found["gravity_error"]) == pytest.approx(tilt, rel=1e-4)
    assert float(found["foot_speed_of_truth"]) == pytest.approx(
        float(same["foot_speed_of_truth"]), rel=1e-3
    )
    # Nobody can say which way is up where everybody leans by 45 degrees.
    askew = moved(truth, np.array([np.pi / 4, 0.0, 0.0]))
    assert np.isnan(float(evaluation.evaluate(tilted, askew)["gravity_error"]))


def test_figures_are_those_by_which_results_are_doubted(truth):
    slid = np.arange(60)[:, None, None] / FPS * [0.5, 0.0, 0.0]
    result = dataclasses.replace(truth, joints=truth.joints + slid)
    result = moved(result, np.zeros(3), up=0.2)
    found = evaluation.evaluate(result, truth)
    value = lambda name: float(found[name])
    joints = truth.joints[0]
    speed = np.median(posture.lower_foot_speed(joints, FPS))
    assert value("foot_speed_of_truth") == pytest.approx(speed, rel=1e-4)
    assert value("foot_speed") > speed + 0.2
    low, high = np.percentile(joints[:, [7, 8, 10, 11], 1].min(axis=1), [5, 95])
    assert value("feet_low_of_truth") == pytest.approx(low, abs=1e-6)
    assert value("feet_high") == pytest.approx(high + 0.2, abs=1e-6)
    knee = np.radians(posture.knee_flexion(joints))
    assert value("knee") == pytest.approx(knee.mean(), rel=1e-4)
    assert value("straighter_knee") == pytest.approx(knee.min(axis=1).mean(), rel=1e-4)
    bent = np.median(posture.joint_acceleration(joints, FPS))
    assert value("joint_acceleration_of_truth") == pytest.approx(bent, rel=1e-4)
    table = evaluation.to_table(found)
    for label in ("gravity error", "standing foot's speed", "feet over the ground"):
        assert label in table
    assert "knees' bend, truth" in table
    written = json.loads(evaluation.to_json(found))
    assert (
        written["gravity_error"] < 1e-6 and "foot_speed_of_truth" in written["people"]
    )


def test_frames_that_do_not_count_are_left_out(truth):
    present = truth.present.copy()
    present[0, 20:30] = False
    gap = dataclasses.replace(truth, present=present)
    broken = dataclasses.replace(gap, joints=truth.joints.copy())
    broken.joints[0, 20:30] = 1e3
    both = [evaluation.evaluate(result, truth) for result in (gap, broken)]
    for name in evaluation.FIGURES:
        first, second = (float(found[name]) for found in both)
        assert first == pytest.approx(second) and np.isfinite(first)
    alone = dataclasses.replace(
        truth,
        joints=truth.joints[:0],
        present=truth.present[:0],
        poses=truth.poses[:0],
        trans=truth.trans[:0],
        betas=truth.betas[:0],
    )
    assert np.isnan(float(evaluation.evaluate(truth, alone)["gravity_error"]))
