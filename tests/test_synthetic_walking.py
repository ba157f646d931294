"""Long walks are as good as the recordings they are made of."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bodyslam_jax.body import load_body_model
from bodyslam_jax.motion import read_motion
from bodyslam_jax.simulation import camera_paths, gait_synthesis, sequences
from bodyslam_jax.simulation.posing import Person


@pytest.fixture(scope="module")
def person():
    return Person(load_body_model(), np.random.default_rng(3).uniform(-2, 2, 10))


@pytest.fixture(scope="module")
def clips():
    source = str(sequences.ASSETS / "walking.npz")
    return gait_synthesis.walking_clips(read_motion(source), source)


@pytest.fixture(scope="module")
def path():
    return camera_paths.floor_path("room", False, np.random.default_rng(0))[0]


@pytest.fixture(scope="module")
def walk(person, clips, path):
    return gait_synthesis.walk_along(person, clips, path, 300, np.random.default_rng(1))


def test_feet_stand_still_also_at_seams_and_in_turns(person, walk):
    sole = gait_synthesis.Soles(person)(walk.poses, walk.pelvis)
    step = np.linalg.norm(np.diff(sole, axis=0)[:, :, [0, 2]], axis=2).min(axis=1)
    # m/s; a rolling foot, in the recordings 0.09, 0.19 and 0.38
    slide = np.percentile(step * 30, [50, 90, 100])
    assert (slide < [0.12, 0.22, 0.5]).all()
    assert abs(sole[:, :, 1].min(axis=1)).max() < 0.03  # m above or below the floor


def test_walk_is_as_smooth_as_the_recordings(walk, clips):
    sudden = lambda x: np.percentile(np.abs(np.diff(x, n=2, axis=0)), 99)
    assert sudden(walk.pelvis) < 1.5 * max(sudden(c.trans) for c in clips)
    for joint in (0, 1, 4, 16):
        R = Rotation.from_rotvec(walk.poses[:, joint])
        turn = (R[:-1].inv() * R[1:]).magnitude().max()
        captured = max(
            (a[:-1].inv() * a[1:]).magnitude().max()
            for a in (Rotation.from_rotvec(c.poses[:, joint]) for c in clips)
        )
        assert turn < 1.3 * captured + np.radians(2.0)  # bends: 60 degrees a second


def test_walk_follows_its_path_and_looks_ahead(walk, path):
    away = np.linalg.norm(walk.pelvis[:, None, [0, 2]] - path, axis=2).min(axis=1)
    assert away.max() < 0.8  # m; corners are cut
    velocity = np.diff(walk.pelvis, axis=0)
    forward = Rotation.from_rotvec(walk.poses[1:, 0]).apply([0.0, 0.0, 1.0])
    cosine = (velocity * forward).sum(axis=1) / np.linalg.norm(velocity, axis=1)
    assert np.percentile(cosine, 5) > 0.85


def test_length_of_steps_is_in_proportion_to_the_legs(clips, path):
    model = load_body_model()
    size = np.zeros(10)
    speed = []
    for beta in (-2.0, 2.0):
        size[0] = beta
        person = Person(model, size)
        walk = gait_synthesis.walk_along(
            person, clips, path, 200, np.random.default_rng(1)
        )
        steps = np.linalg.norm(np.diff(walk.pelvis[:, [0, 2]], axis=0), axis=1)
        legs = np.linalg.norm(np.diff(person.rest[[1, 4, 7]], axis=0), axis=1).sum()
        speed.append(steps.mean() / legs)
    assert speed[0] == pytest.approx(speed[1], rel=0.03)  # other seams may be chosen


def test_toes_bend_rather_than_go_through_the_floor(person, walk):
    G, x = person.joints(walk.poses, walk.pelvis)
    toes = np.flatnonzero(person.weights[:, [10, 11]].max(axis=1) > 0.5)
    lowest = [
        person.vertices(g, y, toes)[:, 1].min()
        for g, y in zip(G[::3], x[::3], strict=True)
    ]
    assert min(lowest) > -0.045  # m
    assert np.mean(np.array(lowest) < -0.03) < 0.03


def test_clips_are_walks_of_validation_subjects_if_there_are_any(clips):
    training = [dataclasses.replace(c, split="train") for c in clips]
    kept = gait_synthesis.walking_clips([*training, *clips[:2]], "x")
    assert [c.split for c in kept] == ["val", "val"]
    fast = [dataclasses.replace(c, fps=60.0) for c in clips]
    assert all(c.fps == 30 for c in gait_synthesis.walking_clips(fast, "x"))
    assert len(gait_synthesis.walking_clips(training, "x")) == len(clips)
    dances = [dataclasses.replace(c, motion="dance") for c in clips]
    with pytest.raises(ValueError, match="dances.npz: no walk"):
        gait_synthesis.walking_clips(dances, "dances.npz")
    short = [
        dataclasses.replace(c, poses=c.poses[:30], trans=c.trans[:30]) for c in clips
    ]
    with pytest.raises(ValueError, match="1.4 s"):
        gait_synthesis.walking_clips(short, "x")


@pytest.mark.parametrize("level", ["E", "M", "D"])
def test_a_camera_keeps_the_person_in_its_image(walk, level):
    handling, rng = camera_paths.HANDLING[level], np.random.default_rng(2)
    place = np.array([0.0, -5.0])
    for T in (
        camera_paths.film_room(walk.pelvis, place, handling, rng),
        camera_paths.film_following(walk.pelvis, handling, rng),
    ):
        p_C = np.einsum("tab,ta->tb", T[:, :3, :3], walk.pelvis - T[:, :3, 3])
        assert (np.abs(p_C[:, :2]) < 0.45 * p_C[:, 2:]).all()
        assert np.allclose(np.linalg.det(T[:, :3, :3]), 1)
