"""One floor for everybody before a camera that does not move."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bodyslam_jax import graph, initialisation, pipeline, simulation
from bodyslam_jax.body import load_body_model, local_keypoints
from bodyslam_jax.body.skeleton import BODY25_TOES_AND_HEELS
from bodyslam_jax.config import Config, GraphWeights, Simulation
from bodyslam_jax.diagnostics.figures import floors_apart
from bodyslam_jax.ground.stances import in_free_fall
from bodyslam_jax.people import PersonState
from bodyslam_jax.pipeline.motion_prediction import (
    contact_predictor,
    contact_probability,
)
from bodyslam_jax.pipeline.people_floor import (
    View,
    common_height,
    on_floor,
    people_on_floor,
)
from bodyslam_jax.simulation import sequences
from bodyslam_jax.types import Intrinsics, Sequence

T, HEIGHT, PITCH = 30, 1.5, 0.2
Y = np.array([0.0, 1.0, 0.0])
R_CW = Rotation.from_rotvec([PITCH, 0, 0]).as_matrix() @ np.diag([1.0, -1.0, -1.0])
"""A camera that looks down a little, and along -z of a world whose y is up."""
STANDS = np.ones((2, T, 4))


@pytest.fixture(scope="module")
def body():
    return load_body_model(dtype=jnp.float64)


def standing(body, floors, places=((-0.5, -4.0), (1.0, -6.0))):
    """People who stand in different places on floors of different heights, m."""
    points = local_keypoints(body, jnp.zeros((23, 3)), jnp.zeros(10), "body25")
    low = float(points[np.array(BODY25_TOES_AND_HEELS), 1].min()) - 0.018
    roots = np.tile(np.eye(4), (len(floors), T, 1, 1))
    for h, (floor, place) in enumerate(zip(floors, places, strict=True)):
        roots[h, :, :3, :3] = R_CW
        roots[h, :, :3, 3] = R_CW @ [place[0], floor - HEIGHT - low, place[1]]
    people = PersonState(
        np.ones((len(floors), T), bool),
        roots,
        np.zeros((len(floors), T, 23, 3)),
        np.zeros((len(floors), 10)),
    )
    cameras = np.tile(np.eye(4), (T, 1, 1))
    return initialisation.first_state(
        cameras, np.zeros((0, 3)), people, np.array([500.0, 500.0, 320.0, 240.0])
    )


def view(fitted=(True, False)):
    present = np.ones((len(fitted), T), bool)
    return View(present, None, np.array(fitted), 30.0, ())


def test_people_of_wrong_sizes_stand_on_the_plane_between_their_feet(body):
    state = standing(body, [0.08, -0.04])
    weights = GraphWeights(ground_sigma=0.04, shape_sigma=0.5)
    floor = on_floor(state, STANDS, view(), body, weights)
    np.testing.assert_allclose(floor.normal, R_CW @ Y, atol=0.02)
    # In the camera's frame, so that the height over the plane is n x + d.
    assert 1.42 < float(floor.offset[0, 0]) < 1.54
    assert np.ptp(floor.offset) == 0
    sigma = np.asarray(floor.sigma)
    np.testing.assert_allclose(sigma[0], 0.5 * sigma[1])
    np.testing.assert_allclose(sigma[1], 0.04 * np.sqrt(T))
    on = people_on_floor(graph.make_problem([floor], state))
    assert on is not None and on.tolist() == [True, True]


def test_somebody_on_a_balcony_is_on_no_floor(body):
    floor = on_floor(
        standing(body, [2.0, 0.0]),
        np.where(np.arange(T)[:, None] < 20, STANDS, [[[0.0]], [[1.0]]]),
        view(),
        body,
        GraphWeights(),
    )
    sigma = np.asarray(floor.sigma)
    assert np.isinf(sigma[0]).all() and np.isfinite(sigma[1]).all()
    assert float(floor.offset[0, 0]) == pytest.approx(HEIGHT, abs=0.03)


@pytest.mark.parametrize(
    "floors, stands", [([2.5, 2.5], 1.0), ([0.0, 0.0], 0.0)], ids=["above", "in air"]
)
def test_without_feet_that_stand_below_the_camera_there_is_no_floor(
    body, floors, stands
):
    state = standing(body, floors)
    floor = on_floor(state, stands * STANDS, view(), body, GraphWeights())
    assert np.isinf(floor.sigma).all()
    assert people_on_floor(graph.make_problem([floor], state)) is None


def test_the_floor_of_most_frames_is_the_floor():
    height = np.array([[-1.5], [-1.6], [-0.3]]) * np.ones((3, 40))
    places = np.zeros((3, 40, 3))
    used = np.ones((3, 40), bool)
    level, on = common_height(height, places, used)
    assert -1.6 < level < -1.5 and on.tolist() == [True, True, False]
    # Far apart a floor whose slope is not known may be at both heights.
    places[2] = [0.0, 0.0, 12.0]
    assert common_height(height, places, used)[1].all()
    used[:2, 5:] = False  # too few frames
    assert common_height(height, places, used)[1].tolist() == [False, False, True]


@pytest.mark.parametrize("fps", [30.0, 60.0])
def test_a_jump_is_free_fall_and_a_walk_is_not(fps):
    t = np.arange(0, 3, 1 / fps)
    up = np.array([0.0, 0.6, 0.8])
    flies = (t > 1.0) & (t < 1.5)
    hop = np.where(flies, 9.81 / 2 * (t - 1.0) * (1.5 - t), 0.0)
    walk = 0.025 * np.sin(2 * np.pi * 2 * t)
    present = np.ones(len(t), bool)
    found = in_free_fall((hop + walk)[:, None] * up, present, up, fps)
    assert found[flies].mean() > 0.6 and not found[~flies].any()
    assert not in_free_fall(walk[:, None] * up, present, up, fps).any()
    # A gap in time has no acceleration.
    moved = np.where(t > 1.5, -0.5, 0.0)[:, None] * up
    assert in_free_fall(moved, present, up, fps).any()
    assert not in_free_fall(moved, np.abs(t - 1.5) > 0.05, up, fps).any()


def test_feet_do_not_stand_in_a_jump(body):
    state = standing(body, [0.0], [(0.0, -4.0)])
    present = np.ones((1, T), bool)
    people = PersonState(
        present,
        np.asarray(state.roots),
        np.asarray(state.poses),
        np.asarray(state.shapes),
    )
    lens = Intrinsics(np.array([500.0, 500.0, 320.0, 240.0]), 640, 480)
    time = np.arange(T) / 30
    sequence = Sequence("jump", None, time, lens)
    predictor = contact_predictor(sequence, people, body, Config())
    assert predictor is not None
    assert (contact_probability(predictor, state, 30.0).max(axis=-1) > 0.5).all()
    flies = (time > 0.3) & (time < 0.7)
    high = np.where(flies, 9.81 / 2 * (time - 0.3) * (0.7 - time), 0.0)
    up = high[:, None] * (R_CW @ Y)
    jump = dataclasses.replace(state, roots=state.roots.at[0, :, :3, 3].add(up))
    stands = contact_probability(predictor, jump, 30.0)[0].max(axis=-1)
    middle = np.abs(time - 0.5) < 0.1
    assert (stands[middle] == 0).all() and (stands[~flies] > 0.5).all()


@pytest.mark.slow
def test_two_people_before_a_tripod_stand_on_one_floor():
    body = load_body_model()
    settings = Simulation(sequence="E2", people=2, length=60)
    moving = simulation.simulate(settings, body)
    (first, second) = moving.actors
    still = sequences.measure(
        settings,
        "still",
        first.person,
        first.walk,
        np.repeat(moving.T_WC[:1], 60, axis=0),
        moving.room,
        tuple(np.random.default_rng(0).spawn(3)),  # pyright: ignore
        [(second.person, second.walk)],
    )
    given = dataclasses.replace(simulation.as_sequence(still), bodies=None)
    apart = {}
    for sigma in (None, 0.04):
        weights = dataclasses.replace(Config().weights, ground_sigma=sigma)
        config = dataclasses.replace(
            Config(), static_camera=True, weights=weights, uncertainty=False
        )
        result = pipeline.run(given, config)
        assert result.scale == 1.0
        apart[sigma] = floors_apart(result.joints, result.present, 30.0)
    assert apart[0.04] < 0.04 and apart[0.04] < 0.5 * apart[None]
