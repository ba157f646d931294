"""Factors that are absent unless a weight switches them on."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import scenes

from bodyslam_jax import graph, motion
from bodyslam_jax.config import GraphWeights
from bodyslam_jax.initialisation import optional_factors

T = 4


def predicted():
    """A prediction for one person, not valid in the first frame."""
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


def made(fps=30.0, **weights):
    weights = dataclasses.replace(GraphWeights(), **weights)
    return optional_factors(predicted(), fps, weights)


def test_nothing_is_added_by_default():
    assert made() == []
    assert made(orientation_sigma=float("inf")) == []


def test_people_turn_as_predicted_where_the_prediction_is_valid():
    (turning,) = made(fps=15.0, orientation_sigma=0.05)
    assert isinstance(turning, graph.RelativeOrientation)
    np.testing.assert_allclose(turning.rotation[0], [[0.0] * 3] + [[0.1] * 3] * 3)
    np.testing.assert_allclose(turning.sigma[0], [np.inf, 0.1, 0.1, 0.1])
    state = scenes.truth(np.random.default_rng(0), frames=T, landmarks=8)
    problem = graph.make_problem([turning], state)
    other = problem.with_prediction({"rotation": 2 * turning.rotation})
    np.testing.assert_allclose(other.factors[0].rotation, 2 * turning.rotation)
