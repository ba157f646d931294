"""Recordings of other motion are whole, and their people unknown to the priors."""

import numpy as np
import pytest

from bodyslam_jax import pipeline, simulation
from bodyslam_jax.body import load_body_model
from bodyslam_jax.config import Config, Simulation
from bodyslam_jax.experiments.video import filmed
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.motion import read_motion
from bodyslam_jax.people import lift, posture_prior
from bodyslam_jax.pipeline import case, run_folder
from bodyslam_jax.simulation.gait_synthesis import Soles
from bodyslam_jax.simulation.posing import Person
from bodyslam_jax.simulation.sequences import OTHER, RECORDINGS, play


@pytest.fixture(scope="module")
def clips():
    return {c.name: c for c in read_motion(simulation.motion_file(OTHER))}


@pytest.fixture(scope="module")
def person():
    return Person(load_body_model(), np.random.default_rng(3).uniform(-2, 2, 10))


def test_simulated_people_are_unknown_to_prior_and_held_out_lifter(clips):
    trials = [trial for trial, _ in RECORDINGS.values()]
    assert set(RECORDINGS) == set(simulation.LENGTH) and set(trials) == set(clips)
    who = {clip.subject.partition("#")[0] for clip in clips.values()}
    assert who == {trial.partition("_")[0] for trial in trials}
    walkers = read_motion(simulation.motion_file(None))
    who |= {clip.subject.partition("#")[0] for clip in walkers}
    for asset in (lift.HELD_OUT_ASSET, posture_prior.ASSET):
        assert who <= set(np.load(asset)["held_out_subjects"])
    # What is used by default has learnt from all of them.
    assert not len(np.load(lift.ASSET)["held_out_subjects"])


def test_demo_and_cases_use_the_held_out_lifter(tmp_path, monkeypatch):
    class Stopped(Exception):
        pass

    used = []

    def stop(*given):
        used.extend(part for part in given if isinstance(part, Config))
        raise Stopped

    monkeypatch.setattr(run_folder, "with_compatible_body", stop)
    monkeypatch.setattr(case, "before_joint", stop)
    with pytest.raises(Stopped):
        pipeline.demo(tmp_path, Config(overlay=False))
    with pytest.raises(Stopped):
        case.simulate_case("E1", frames=20, config=Config(fps=30.0))
    assert [config.people_fit.lifter for config in used] == ["held-out"] * 2
    assert not used[0].overlay and used[1].fps == 30.0  # all else as given


@pytest.mark.parametrize("trial", ["14_32", "06_12", "02_04", "14_33"])
def test_postures_are_those_recorded_and_feet_stand_on_the_floor(clips, person, trial):
    clip, frames = clips[trial], 2 * len(clips[trial].poses) + 10
    walk = play(person, clip, frames, np.array([3.0, -1.0]), 0.7)
    t = len(clip.poses)
    np.testing.assert_allclose(walk.poses[:t, 1:], clip.poses[:, 1:], atol=1e-6)
    np.testing.assert_allclose(walk.poses[t : 2 * t - 2], walk.poses[t - 2 : 0 : -1])
    np.testing.assert_allclose(
        walk.pelvis[:, [0, 2]].mean(axis=0), [3.0, -1.0], atol=1e-9
    )
    lowest = Soles(person)(walk.poses, walk.pelvis)[..., 1].min(axis=1)
    assert -0.03 < lowest.min() < 0.01
    assert (lowest.max() > 0.3) == (trial in ("02_04", "14_33"))  # jump, ladder
    # Turned about the vertical as a whole: the same tilt as recorded.
    up = so3.exp(walk.poses[:t, 0])[:, 1]
    np.testing.assert_allclose(up, so3.exp(clip.poses[:, 0])[:, 1], atol=1e-5)


def test_who_travels_does_so_along_the_given_direction(clips, person):
    walk = play(person, clips["06_12"], 300, np.zeros(2), 0.4)
    along = np.array([np.sin(0.4), np.cos(0.4)])
    path = walk.pelvis[:, [0, 2]]
    assert np.ptp(path @ along) > 3.0
    assert np.std(path @ along) > 5 * np.std(path @ (along[::-1] * [1, -1]))


@pytest.mark.parametrize("family", ["room", "follow"])
@pytest.mark.parametrize("sequence", ["E1", "D1"])
def test_the_camera_sees_who_does_something_else(sequence, family):
    plain = Simulation(sequence=sequence, family=family, length=60, motion=OTHER)
    found = simulation.simulate(filmed(plain))
    trial, _ = RECORDINGS[sequence]
    walked = simulation.simulate(filmed(Simulation(sequence, family, 60)))
    assert not np.allclose(found.poses[:, 3:], walked.poses[:, 3:], atol=0.1)
    assert len(found.others) == len(walked.others)
    p_C = np.einsum(
        "tba,tjb->tja", found.T_WC[:, :3, :3], found.joints - found.T_WC[:, None, :3, 3]
    )
    uv = p_C[..., :2] / p_C[..., 2:] * found.intrinsics[:2] + found.intrinsics[2:]
    assert (p_C[..., 2] > 1.0).all()
    assert np.mean((uv > 0) & (uv < np.array(found.size))) > 0.95
    if family == "follow":  # it goes around somebody who stays
        step = np.linalg.norm(np.diff(found.T_WC[:, :3, 3], axis=0), axis=1)
        assert 0.3 < step.mean() * 30 < 3.0
