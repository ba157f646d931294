"""How people step, and whether time runs as it should."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bodyslam_jax import diagnostics, simulation
from bodyslam_jax.config import Simulation
from bodyslam_jax.diagnostics.verdict import cadence_warning

PERIOD, FPS, SPEED, THIGH = 36, 30.0, 1.35, 0.4


@pytest.fixture(scope="module")
def walk():
    made = simulation.simulate(Simulation(sequence="M1", length=120))
    return simulation.as_truth(made)


@pytest.fixture(scope="module")
def stilts(walk):
    """Straight legs that swing as sines: 5/3 steps a second, 0.81 m each."""
    t = np.arange(100)
    joints = np.zeros((1, 100, 24, 3))
    joints[0, :, :, 2] = SPEED * t[:, None] / FPS
    angle = 0.5 * np.sin(2 * np.pi * t / PERIOD)
    for side, leg in ((1, [1, 4, 7]), (-1, [2, 5, 8])):
        bone = np.c_[0 * t, -np.cos(angle), side * np.sin(angle)]
        for k, joint in enumerate(leg):
            joints[0, :, joint] += k * THIGH * bone
    return dataclasses.replace(
        walk,
        timestamps=t / FPS,
        T_WC=np.tile(np.eye(4), (100, 1, 1)),
        joints=joints,
        poses=np.zeros((1, 100, 72)),
        trans=np.zeros((1, 100, 3)),
        present=np.ones((1, 100), bool),
    )


def changed(result, **arrays):
    return dataclasses.replace(result, **arrays)


def test_steps_are_counted_and_measured(stilts):
    found = diagnostics.gait(stilts, 0)
    assert found.frequency == pytest.approx(2 * FPS / PERIOD)
    assert found.leg == pytest.approx(2 * THIGH)
    step = SPEED / found.frequency
    assert found.step == pytest.approx(step / found.leg)
    swing = found.frequency * np.sqrt(found.leg / 9.81)
    assert found.slowness == pytest.approx(step / found.leg / swing / 1.7)
    # Sines swing by 0.5 rad to either side, both legs in turn.
    assert found.reach == pytest.approx(2 * np.sin(0.5), rel=0.03)
    assert found.step_over_reach == pytest.approx(found.step / found.reach)


def test_a_walk_is_too_fast_where_its_frame_rate_is_twice_the_true_one(walk):
    seen = diagnostics.gait(walk, 0)
    assert not seen.is_fast_motion()
    hurried = diagnostics.gait(changed(walk, timestamps=walk.timestamps / 2), 0)
    assert hurried.is_fast_motion() and not hurried.is_slow_motion()
    (line,) = cadence_warning(0, hurried, 0.05, 60.0)
    assert "60 fps is not the video's frame rate" in line


def test_a_walk_is_not_slow_motion_until_it_is_slowed(walk):
    seen = diagnostics.gait(walk, 0)
    assert 0.75 < seen.slowness < 1.3 and not seen.is_slow_motion()
    slowed = diagnostics.gait(changed(walk, timestamps=2.2 * walk.timestamps), 0)
    assert slowed.slowness == pytest.approx(2.2 * seen.slowness)
    assert slowed.step == pytest.approx(seen.step)
    assert slowed.is_slow_motion()
    # Steps that may be shorter by half need not be of slow motion.
    assert not slowed.is_slow_motion(0.5)


def test_slowness_depends_little_on_size_and_not_on_direction(walk):
    seen = diagnostics.gait(walk, 0)
    taller = diagnostics.gait(changed(walk, joints=1.2 * walk.joints), 0)
    assert taller.step == pytest.approx(seen.step)
    assert taller.slowness == pytest.approx(seen.slowness / 1.2**0.5)
    turn = Rotation.from_euler("y", 70, degrees=True)
    poses = walk.poses.copy()
    poses[0, :, :3] = (turn * Rotation.from_rotvec(poses[0, :, :3])).as_rotvec()
    turned = changed(walk, joints=walk.joints @ turn.as_matrix().T, poses=poses)
    assert diagnostics.gait(turned, 0).slowness == pytest.approx(seen.slowness)


def test_gait_uses_frames_with_the_person_only(stilts):
    partly = stilts.present.copy()
    partly[0, :20] = False
    noise = np.random.default_rng(0).standard_normal((20, 24, 3))
    joints = stilts.joints.copy()
    joints[0, :20] = noise
    found = diagnostics.gait(changed(stilts, present=partly, joints=joints), 0)
    assert found.frequency == pytest.approx(2 * FPS / PERIOD)


def test_no_gait_without_regular_steps(stilts):
    nobody = np.zeros_like(stilts.present)
    assert diagnostics.gait(changed(stilts, present=nobody), 0) is None
    briefly = nobody.copy()
    briefly[0, 10:40] = True  # less than one stride and a half
    assert diagnostics.gait(changed(stilts, present=briefly), 0) is None
    briefly[0, 10] = briefly[0, 12:] = False
    assert diagnostics.gait(changed(stilts, present=briefly), 0) is None
    still = np.repeat(stilts.joints[:, :1], 100, axis=1)
    assert diagnostics.gait(changed(stilts, joints=still), 0) is None
    noise = np.random.default_rng(1).standard_normal(stilts.joints.shape)
    assert diagnostics.gait(changed(stilts, joints=noise), 0) is None
    on_the_spot = stilts.joints.copy()
    on_the_spot[..., 2] -= on_the_spot[:, :, :1, 2]
    spot = changed(stilts, joints=on_the_spot, timestamps=9 * stilts.timestamps)
    assert not diagnostics.gait(spot, 0).is_slow_motion()


def test_a_warning_of_slow_motion_respects_the_error_of_lengths(walk):
    steps = diagnostics.gait(changed(walk, timestamps=2.2 * walk.timestamps), 0)
    (line,) = cadence_warning(1, steps, np.nan, 25.0)
    assert "person 1 takes" in line and "25 fps is not its frame rate" in line
    assert f"about {steps.slowness:.1f} times as fast" in line
    assert cadence_warning(1, steps, 0.1, 25.0)
    a_little = changed(walk, timestamps=1.3 * walk.timestamps)
    for unsure in (0.6, np.inf):
        # Step length may be wrong then, but not how often a step is taken.
        (line,) = cadence_warning(1, steps, unsure, 25.0)
        assert f"takes {steps.frequency:.1f} steps a second: of 76" in line
        assert "about" not in line and "25 fps is not" in line
        assert not cadence_warning(1, diagnostics.gait(a_little, 0), unsure, 25.0)
    assert not cadence_warning(0, diagnostics.gait(walk, 0), np.nan, 25.0)
    assert not cadence_warning(0, None, 0.1, 25.0)
