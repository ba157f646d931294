"""The low pass: what it leaves alone, what it takes away, and where it stops."""

import dataclasses

import numpy as np
import pytest
from estimates import standing_people, still_camera
from scenes import body_model
from scipy.spatial.transform import Rotation

from bodyslam_jax.config import Config
from bodyslam_jax.geometry.whittaker import low_pass, low_pass_rotations
from bodyslam_jax.pipeline.to_metric import to_metric
from bodyslam_jax.types import Bodies, Intrinsics, Sequence

FPS = 30.0
ALL = np.ones(200, bool)
TIME = np.arange(200) / FPS


def test_constant_speed_is_left_alone():
    line = np.stack([3.0 + 2.0 * TIME, -TIME], axis=-1)
    np.testing.assert_allclose(low_pass(line, ALL, FPS, 4.0), line, atol=1e-9)


@pytest.mark.parametrize("frequency", [0.5, 2.0, 6.0, 12.0])
def test_gain_is_the_one_that_is_stated(frequency):
    wave = np.sin(2 * np.pi * frequency * TIME)
    fast = lambda f: (2 - 2 * np.cos(2 * np.pi * f / FPS)) ** 2
    expected = 1 / (1 + fast(frequency) / fast(6.0))
    found = low_pass(wave, ALL, FPS, 6.0)
    inner = slice(50, 150)
    np.testing.assert_allclose(found[inner], expected * wave[inner], atol=2e-3)


@pytest.mark.parametrize("n", [3, 4, 5, 6, 30])
def test_equals_the_dense_least_squares(n):
    y = np.random.default_rng(n).normal(size=(n, 2))
    second = np.diff(np.eye(n), 2, axis=0)
    weight = (2 - 2 * np.cos(2 * np.pi * 5.0 / FPS)) ** -2
    dense = np.linalg.solve(np.eye(n) + weight * second.T @ second, y)
    np.testing.assert_allclose(low_pass(y, np.ones(n, bool), FPS, 5.0), dense)


def test_runs_do_not_touch_each_other():
    present = ALL.copy()
    present[80:90] = False
    y = np.random.default_rng(0).normal(size=200)
    found = low_pass(y, present, FPS, 5.0)
    np.testing.assert_array_equal(found[80:90], y[80:90])
    alone = low_pass(y[:80], np.ones(80, bool), FPS, 5.0)
    np.testing.assert_allclose(found[:80], alone, atol=1e-12)


def test_slow_video_is_left_alone():
    y = np.random.default_rng(0).normal(size=200)
    np.testing.assert_array_equal(low_pass(y, ALL, 10.0, 5.0), y)


def test_a_steady_turn_through_pi_stays_one_and_noise_shrinks():
    axis = np.array([0.0, 0.6, 0.8])
    turn = Rotation.from_rotvec(np.linspace(2.5, 3.8, 200)[:, None] * axis)
    rng = np.random.default_rng(0)
    noisy = turn * Rotation.from_rotvec(0.05 * rng.normal(size=(200, 3)))
    angle = lambda r: (turn.inv() * Rotation.from_rotvec(r)).magnitude()
    clean = low_pass_rotations(turn.as_rotvec(), ALL, FPS, 5.0)
    assert angle(clean).max() < 1e-3
    found = low_pass_rotations(noisy.as_rotvec()[:, None], ALL, FPS, 5.0)[:, 0]
    assert angle(found).mean() < 0.6 * angle(noisy.as_rotvec()).mean()


def test_only_regressed_bodies_are_low_passed():
    h, t = 2, 30
    present = np.zeros((h, t), bool)
    present[0] = True  # the second person is fitted to keypoints
    nothing = np.zeros((h, t, 72)), np.zeros((h, t, 10)), np.zeros((h, t, 3))
    camera = Intrinsics(np.array([500.0, 500.0, 320.0, 240.0]), 640, 480)
    bodies = Bodies(present, *nothing)
    sequence = Sequence("two", None, np.arange(t) / FPS, camera, bodies=bodies)
    joint = standing_people(sequence)
    shaking = 0.01 * (-1.0) ** np.arange(t)
    joint.roots[:, :, 0, 3] = shaking
    joint.poses[:, :, 15, 2] = shaking
    found, _ = to_metric(
        sequence, Config(), body_model(), still_camera(sequence), joint
    )
    width = np.ptp(found.joints[:, 5:-5, 0, 0], axis=1)
    turn = np.ptp(found.poses[:, 5:-5, 3 * 16 + 2], axis=1)
    assert width[0] < 0.004 and turn[0] < 0.004
    np.testing.assert_allclose([width[1], turn[1]], 0.02, rtol=1e-3)
    same = dataclasses.replace(Config(), smoothing_hz=None)
    plain, _ = to_metric(sequence, same, body_model(), still_camera(sequence), joint)
    np.testing.assert_allclose(
        np.ptp(plain.joints[:, :, 0, 0], axis=1), 0.02, rtol=1e-3
    )
