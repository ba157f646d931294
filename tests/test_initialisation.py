"""Terms of the graph that are off unless a weight says how far they are trusted."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import scenes

from bodyslam_jax import graph, motion
from bodyslam_jax.config import GraphWeights
from bodyslam_jax.initialisation import optional_factors

T = 4


def seen():
    """What is predicted of one person, in whose first frame it means nothing."""
    turn = np.full((T, 3), 0.1)
    turn[0] = np.nan
    one = motion.Prediction(
        translation=jnp.zeros((T, 3)),
        covariance=jnp.ones((T, 3, 3)),
        body_pose=jnp.zeros((T, 23, 3)),
        rotation=jnp.asarray(turn),
        valid=jnp.ones(T, bool).at[0].set(False),
    )
    return jax.tree.map(lambda x: x[None], one)


def made(fps=30.0, there=None, **weights):
    state = scenes.truth(np.random.default_rng(0), frames=T, landmarks=8)
    there = np.ones((1, T), bool) if there is None else there
    body = scenes.body_model()
    weights = dataclasses.replace(GraphWeights(), **weights)
    factors = optional_factors(state, seen(), there, fps, body, weights)
    return state, factors


def test_nothing_is_added_that_is_not_asked_for():
    assert made()[1] == []
    off = float("inf")
    assert made(orientation_sigma=off, stance_sigma=off, camera_smoothness=off)[1] == []


def test_people_turn_as_predicted_where_that_means_something():
    state, (turning,) = made(fps=15.0, orientation_sigma=0.05)
    assert isinstance(turning, graph.RelativeOrientation)
    np.testing.assert_allclose(turning.rotation[0], [[0.0] * 3] + [[0.1] * 3] * 3)
    np.testing.assert_allclose(turning.sigma[0], [np.inf, 0.1, 0.1, 0.1])
    problem = graph.make_problem([turning], state)
    other = problem.with_prediction({"rotation": 2 * turning.rotation})
    np.testing.assert_allclose(other.factors[0].rotation, 2 * turning.rotation)


def test_the_lowest_point_of_the_feet_stands_while_its_owner_is_there():
    there = np.array([[True, True, True, False]])
    state, (stance,) = made(there=there, stance_sigma=0.01)
    assert isinstance(stance, graph.StanceFoot)
    low = graph.stance_mask(stance.body, state, jnp.asarray(there))
    np.testing.assert_array_equal(jnp.isfinite(stance.sigma), low)
    assert low.any() and not low[0, 0].any() and not low[0, 3].any()
    np.testing.assert_allclose(stance.sigma[low], 0.01)


def test_a_steady_camera_is_steady_in_metres():
    state, (steady,) = made(fps=15.0, camera_smoothness=0.02)
    assert isinstance(steady, graph.CameraSmoothness)
    assert np.isinf(steady.sigma[:2]).all()
    # Per frame squared: four times as much in a frame twice as long.
    np.testing.assert_allclose(steady.sigma[2:, 0], 0.08)
    np.testing.assert_allclose(steady.sigma[2:, 1] * float(state.scale), 0.08)
