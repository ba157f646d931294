"""`experiment calibration`: people whom no prior knows, and errors over claims."""

import numpy as np
import pytest

from bodyslam_jax.body import load_body_model
from bodyslam_jax.config import Experiment
from bodyslam_jax.experiments import calibration
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.simulation.posing import Person
from bodyslam_jax.simulation.room import Box, Room, Terrain
from bodyslam_jax.types import Result


@pytest.fixture(scope="module")
def body():
    return load_body_model()


def test_a_limb_is_as_long_as_asked_and_nothing_else_changes(body):
    plain = Person(body, np.zeros(10))
    person = calibration.with_limbs(
        Person(body, np.zeros(10)), np.array([1.1, 1.0, 0.9, 1.0])
    )
    length = lambda p, a, b: np.linalg.norm(p.rest[b] - p.rest[a])
    for a, b, factor in ((1, 4, 1.1), (5, 8, 1.0), (16, 18, 0.9), (19, 21, 1.0)):
        expected = factor * length(plain, a, b)
        assert length(person, a, b) == pytest.approx(expected, rel=1e-12)
    # Soles stay under their feet: the mesh is as much taller as the thigh is longer.
    longer = plain.rest[1, 1] - plain.rest[4, 1]
    taller = np.ptp(person.skin[:, 1]) - np.ptp(plain.skin[:, 1])
    assert taller == pytest.approx(0.1 * longer, rel=0.05)


@pytest.mark.slow
def test_statures_are_those_of_the_population(body):
    person = Person(body, np.zeros(10))
    rng = np.random.default_rng(0)
    statures = [
        np.ptp(calibration.of_population(person, rng).skin[:, 1]) for _ in range(60)
    ]
    means = np.mean([mean for mean, _ in calibration.POPULATION])
    assert np.mean(statures) == pytest.approx(means, abs=0.04)
    assert 0.07 < np.std(statures) < 0.15


def test_people_are_the_same_in_every_run_and_differ():
    draw = lambda seed: calibration.drawn(seed, Experiment(), "bodies")
    assert draw(3) == draw(3) and draw(3) != draw(4)
    floors = [draw(seed)[1][0] for seed in range(80)]
    assert floors.count("level") > 25 and {"slope", "uneven"} < set(floors)


def test_errors_as_large_as_claimed_have_the_coverage_of_a_normal_distribution(
    tmp_path,
):
    rng = np.random.default_rng(1)
    rows = [
        {
            "sequence": str(i),
            "input": "bodies",
            "status": "ok",
            "z_scale": rng.standard_normal(),
            "z_stature": 2 * rng.standard_normal(),
            "z_up": np.sqrt((rng.standard_normal(2) ** 2).mean()),
            "z_joints": None,
            "joints_within_68": None,
            "joints_within_95": None,
            "z_heights": 0.5 * rng.standard_normal(),
            "heights_within_68": 0.9,
            "heights_within_95": 0.99,
        }
        for i in range(2000)
    ]
    files = calibration.write_calibration(tmp_path, rows, about="Simulated.")
    lines = files[0].read_text().splitlines()
    cells = lambda name: [
        float(x.split(" ")[0])
        for x in next(s for s in lines if s.startswith(f"| {name} | all")).split(" | ")[
            3:
        ]
        for x in [x.strip(" |")]
    ]
    for name in ("scale", "up"):
        rms, one, two = cells(name)
        assert rms == pytest.approx(1, abs=0.05)
        assert one == pytest.approx(0.68, abs=0.03)
        assert two == pytest.approx(0.95, abs=0.02)
    assert cells("stature")[0] == pytest.approx(2, abs=0.1)
    assert cells("pelvis over the floor (y)")[0] == pytest.approx(0.5, abs=0.05)
    assert cells("pelvis over the floor (y)")[1:] == [0.9, 0.99]
    assert not any(line.startswith("| joints") for line in lines)


@pytest.mark.parametrize("slope", [None, 0.1])
def test_the_true_world_is_that_of_the_first_camera_and_the_floor(slope):
    """A camera that looks down, rolled, to the world's -x: W has its heading alone."""
    t, side = 30, np.array([0.0, 1.0, 0.0])
    ahead = np.array([-1.0, 0.0, 0.0])
    down = np.cross(ahead, np.cross(side, ahead))
    level = np.stack([np.cross(-down, ahead), -down, ahead], axis=1)
    tilt = so3.exp(np.array([-0.3, 0.0, 0.0])) @ so3.exp(np.array([0.0, 0.0, 0.2]))
    T_WC = np.eye(4)
    T_WC[:3, :3], T_WC[:3, 3] = level @ tilt, [5.0, 1.7, 2.0]
    joints = np.zeros((1, t, 24, 3)) + [2.0, 0.4, 2.5]
    truth = Result(
        timestamps=np.arange(t) / 30,
        T_WC=np.tile(T_WC, (t, 1, 1)),
        scale=1.0,
        intrinsics=np.ones(4),
        landmarks=np.zeros((0, 3)),
        poses=np.zeros((1, t, 72)),
        trans=np.zeros((1, t, 3)),
        betas=np.zeros((1, 10)),
        joints=joints,
        present=np.ones((1, t), bool),
    )
    box = Box(np.zeros(3), np.ones(3), 0.0)
    room, floor = Room(box, ()), 0.0
    if slope is not None:
        room, floor = Terrain(box, (), lambda at: slope * at[..., 0]), 2 * slope
    found, eye = calibration.in_world(truth, room)
    assert eye == pytest.approx(1.7 - floor)
    # 3 m ahead, half a metre to the camera's left or right, 0.4 m above level 0.
    np.testing.assert_allclose(found[..., 2], 3.0, atol=1e-9)
    np.testing.assert_allclose(found[..., 1], 0.4 - floor, atol=1e-9)
    left = np.cross(np.array([0.0, 1.0, 0.0]), ahead)
    expected = (joints[0, 0, 0] - T_WC[:3, 3]) @ left
    np.testing.assert_allclose(found[..., 0], expected, atol=1e-9)
