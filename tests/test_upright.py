"""Trunks of people on their feet point where they do on average."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes

from bodyslam_jax import graph
from bodyslam_jax.config import GraphWeights
from bodyslam_jax.initialisation import upright_factor
from bodyslam_jax.initialisation.upright import mean_up

ON = GraphWeights(upright_sigma=0.1)


def people(lean, num=2, frames=30):
    """Somebody stands before a camera that turns, and leans by `lean` rad, `h t`."""
    rng = np.random.default_rng(4)
    state = scenes.truth(rng, frames=frames, people=num, landmarks=5)
    roots = np.array(state.roots)
    for h, k in np.ndindex(num, frames):
        a = lean[h, k]
        tilt = np.array(
            [[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]]
        )
        upright = np.diag([1.0, -1.0, -1.0]) @ tilt
        roots[h, k, :3, :3] = np.asarray(state.cameras[k, :3, :3]).T @ upright
    return dataclasses.replace(state, roots=jnp.asarray(roots))


def test_up_is_the_mean_direction_of_trunks():
    lean = np.tile(0.2 * np.sin(np.arange(30) * 2 * np.pi / 10), (2, 1))
    state, there = people(lean), np.ones((2, 30), bool)
    np.testing.assert_allclose(mean_up(state, there), [0, -1, 0], atol=1e-12)
    factor = upright_factor(state, there, 30.0, ON)
    assert factor is not None
    error = np.linalg.norm(factor.residual(state), axis=-1)
    np.testing.assert_allclose(error, 2 * np.sin(abs(lean) / 2) / 0.1, atol=1e-9)


def test_people_who_lie_or_are_absent_have_no_factor():
    lean = np.zeros((2, 30))
    lean[1] = np.where(np.arange(30) % 2, 1.2, -1.2)
    there = np.ones((2, 30), bool)
    there[0, :5] = False
    factor = upright_factor(people(lean), there, 30.0, ON)
    assert factor is not None
    known = np.isfinite(np.asarray(factor.sigma))
    assert known[0, 5:].all() and not known[0, :5].any() and not known[1].any()
    # Twice the frames a second say twice as often the same.
    faster = upright_factor(people(lean), there, 60.0, ON)
    assert faster is not None
    np.testing.assert_allclose(faster.sigma[0, 9], 0.1 * np.sqrt(2))
    nobody = np.zeros((2, 30), bool)
    assert upright_factor(people(lean), nobody, 30.0, ON) is None
    assert upright_factor(people(lean), there, 30.0, GraphWeights()) is None
    lying = upright_factor(people(lean[1:], num=1), there[1:], 30.0, ON)
    assert lying is None


def test_bending_down_occasionally_is_an_outlier():
    lean = np.zeros((1, 30))
    lean[0, 10:14] = 1.2
    state, there = people(lean, num=1), np.ones((1, 30), bool)
    factor = upright_factor(state, there, 30.0, ON)
    assert factor is not None
    s = graph.squared_norm(factor.residual(state))[0]
    weight = np.asarray(factor.loss.weight(s))
    assert (weight[10:14] < 0.1).all() and (weight[:10] > 0.75).all()


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_the_factor_is_invariant_to_rotations_of_the_world(dtype):
    state = people(0.1 * np.random.default_rng(0).standard_normal((2, 30)))
    there = np.ones((2, 30), bool)
    turn = jnp.asarray(scenes.look(0.7, -0.4) @ scenes.look(0.1, 1.1).T)
    cameras = state.cameras.at[:, :3].set(turn @ state.cameras[:, :3])
    other = dataclasses.replace(state, cameras=cameras)
    cast = lambda x: jax.tree.map(lambda a: a.astype(dtype), x)
    here, turned = (upright_factor(s, there, 30.0, ON) for s in (state, other))
    assert here is not None and turned is not None
    cost = lambda f, s: f.cost(s)
    rtol = 1e-9 if dtype == jnp.float64 else 1e-3
    found = jax.jit(cost)(cast(turned), cast(other))
    np.testing.assert_allclose(found, here.cost(state), rtol=rtol)
