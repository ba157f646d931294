"""People whose displacement is not that of their steps do not determine the scale."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes

from bodyslam_jax import motion
from bodyslam_jax.config import GraphWeights
from bodyslam_jax.initialisation import (
    carried,
    lines_of_carried,
    motion_factor,
    scale_start,
)
from bodyslam_jax.types import ScaleStart

T, FPS, SCALE = 60, 20.0, 3.0


def made(moves, predicted, noise=0.0):
    """A person who moves along x at `moves` m/s with a prediction of `predicted`, and a
    camera that moves to and fro."""
    rng = np.random.default_rng(0)
    state = scenes.truth(rng, frames=T, landmarks=8)
    time = np.arange(T) / FPS
    cameras = np.tile(np.eye(4), (T, 1, 1))
    cameras[:, 0, 3] = 0.3 * np.sin(time) / SCALE
    roots = np.tile(np.eye(4), (1, T, 1, 1))
    roots[0, :, 0, 3] = moves * time - SCALE * cameras[:, 0, 3]
    roots[0, :, 2, 3] = 4.0
    roots[..., :3, 3] += rng.normal(0, noise, (1, T, 3))
    state = eqx.tree_at(
        lambda s: (s.cameras, s.roots),
        state,
        (jnp.asarray(cameras), jnp.asarray(roots)),
    )
    step = np.zeros((T, 3))
    step[:, 0] = predicted / FPS
    step[0] = np.nan
    one = motion.Prediction(
        translation=jnp.asarray(step),
        covariance=jnp.asarray(np.tile(1e-4 * np.eye(3), (T, 1, 1))),
        body_pose=jnp.zeros((T, 23, 3)),
        rotation=jnp.zeros((T, 3)),
        valid=jnp.ones(T, bool).at[0].set(False),
    )
    prediction = jax.tree.map(lambda x: x[None], one)
    return state, prediction


def found(state, prediction, scale=SCALE, present=None):
    present = np.ones((1, T), bool) if present is None else present
    return carried(state, prediction, present, scale, FPS)


@pytest.mark.parametrize("speed", [0.0, 0.7, 1.4, 3.0])
def test_people_who_walk_are_not_carried(speed):
    assert found(*made(speed, speed, noise=0.05)) == {}
    # An error of a half in steps or sizes is not taken for another cause.
    assert found(*made(speed, 1.5 * speed, noise=0.05)) == {}
    assert found(*made(speed, 0.6 * speed, noise=0.05)) == {}


@pytest.mark.parametrize(
    "moves, predicted", [(0.0, 1.4), (1.2, 0.0), (4.0, 0.5), (1, -1)]
)
def test_people_on_treadmills_on_wheels_or_carried_are_found(moves, predicted):
    (one,) = found(*made(moves, predicted, noise=0.05)).items()
    assert one[0] == 0
    assert one[1] == pytest.approx((moves, abs(predicted)), abs=0.2)
    (line,) = lines_of_carried({0: (1.2, 0.1)})
    assert "person 0 moves at 1.2 m/s where their posture predicts 0.1" in line


def test_nothing_is_concluded_from_few_frames():
    present = np.zeros((1, T), bool)
    present[0, ::2] = True
    assert found(*made(0.0, 1.4), present=present) == {}
    state, prediction = made(0.0, 1.4)
    assert carried(state, prediction, np.ones((1, T), bool), SCALE, 2.0 * T) == {}


def test_displacements_of_carried_people_have_no_weight():
    state, prediction = made(1.4, 1.4)
    assert scale_start(state, prediction, None).motion == pytest.approx(SCALE, rel=0.05)
    start = scale_start(state, prediction, None, without=(0,))
    assert start == ScaleStart()
    path = scale_start(state, prediction, None, path=2.0)
    assert path.without_motion().value == pytest.approx(2.0)
    body, weights = scenes.body_model(), dataclasses.replace(GraphWeights())
    with_term = motion_factor(prediction, state.shapes, body, weights)
    without = motion_factor(prediction, state.shapes, body, weights, without=(0,))
    assert np.abs(with_term.whitening).max() > 0
    np.testing.assert_array_equal(without.whitening, 0.0)
