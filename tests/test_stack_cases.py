"""Several problems as one: `stack_cases`, for `jax.vmap` and `jax.jit`."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import make

import bodyslam_jax as bs
import bodyslam_jax.graph as g


@pytest.fixture(scope="module")
def cases():
    """Of different lengths and numbers of landmarks, two people in each."""
    short = make(seed=2, people=2, frames=7, landmarks=25)
    long = make(seed=3, people=2, frames=15, landmarks=31)
    return [(problem, start) for problem, _, start in (short, long)]


def of(tree, k):
    return jax.tree.map(lambda x: x[k], tree)


def test_costs_of_stacked_cases_are_those_of_each(cases):
    problems, states = bs.stack_cases(cases)
    together = jax.jit(jax.vmap(lambda p, s: p.cost_by_term(s)))(problems, states)
    for k, (problem, state) in enumerate(cases):
        for name, cost in problem.cost_by_term(state).items():
            np.testing.assert_allclose(together[name][k], cost, rtol=1e-9)


@pytest.mark.slow
def test_solutions_of_stacked_cases_are_those_of_each(cases):
    problems, states = bs.stack_cases(cases)
    found = jax.vmap(bs.solve)(problems, states)
    for k, (problem, state) in enumerate(cases):
        alone = bs.solve(problem, state)
        assert found.status[k] == alone.status == "converged"
        np.testing.assert_allclose(found.cost[k], alone.cost, rtol=1e-8)
        num = len(state.cameras)
        cameras = found.state.cameras[k]
        np.testing.assert_allclose(cameras[:num], alone.state.cameras, atol=1e-5)
        np.testing.assert_allclose(found.state.scale[k], alone.state.scale, rtol=1e-4)


def test_lambda_of_a_stacked_case_is_its_own(cases):
    """What padding adds has no sigma, and no share in the mean."""
    problems, _ = bs.stack_cases(cases)
    for k, (problem, _) in enumerate(cases):
        for name, weight in bs.weights(problem).items():
            mapped = jax.vmap(bs.weights)(problems)[name][k]
            np.testing.assert_allclose(mapped, weight, rtol=1e-12)


@pytest.mark.slow
def test_cases_of_several_common_sizes_get_the_largest():
    """Of 15 and 40 frames, which alone are padded to 20 and 60."""
    cases = [make(seed=1, frames=n, landmarks=30)[::2] for n in (15, 40)]
    alone = [problem.layout.num_chunks for problem, _ in cases]
    problems, states = bs.stack_cases(cases)
    assert alone[0] < alone[1] == problems.layout.num_chunks
    assert states.cameras.shape[:2] == (2, 10 * alone[1])
    mapped = jax.vmap(lambda p, s: p.cost(s))(problems, states)
    costs = [float(problem.cost(state)) for problem, state in cases]
    np.testing.assert_allclose(mapped, costs, rtol=1e-9)


def test_cases_that_differ_are_refused_in_one_line(cases):
    problem, state = cases[0]
    fewer = dataclasses.replace(problem, factors=problem.factors[1:])
    held = dataclasses.replace(problem, variables=problem.variables[1:])
    one = make(seed=2, people=1, frames=7, landmarks=25)
    for other, what in (
        ((fewer, state), "0 and 1 have terms"),
        ((held, state), "0 and 1 have variables"),
        (one[::2], "0 and 1 have people 2 and 1"),
    ):
        with pytest.raises(ValueError, match=what) as caught:
            bs.stack_cases([cases[0], other])
        assert "\n" not in str(caught.value)
    with pytest.raises(ValueError, match="found none"):
        bs.stack_cases([])


def test_what_fits_no_common_size_is_refused():
    t = 1100
    eye = jnp.tile(jnp.eye(4), (t, 1, 1))
    state = g.State(
        scale=jnp.asarray(1.0),
        cameras=eye,
        roots=jnp.zeros((0, t, 4, 4)),
        poses=jnp.zeros((0, t, 23, 3)),
        shapes=jnp.zeros((0, 10)),
        landmarks=jnp.zeros((1, 3)),
        intrinsics=jnp.array([500.0, 500.0, 320.0, 240.0]),
    )
    sigma = jnp.full(t, jnp.inf).at[0].set(1.0)
    prior = g.ScalePrior(scale=jnp.ones(t), sigma=sigma)
    with pytest.raises(ValueError, match="up to 1100 frames and 1 landmarks, expected"):
        bs.stack_cases([(g.make_problem([prior], state), state)])


@pytest.mark.slow
def test_simulated_cases_are_built_stacked_and_compared_with_their_truths():
    made = [bs.simulate_case("M2", frames=n, family="follow") for n in (30, 40)]
    problems, states = bs.stack_cases(made, hold=("cameras", "landmarks"))
    found = jax.vmap(bs.solve)(problems, states)
    pairs = [
        (case.trajectories(of(found.state, k)), case.truth)
        for k, case in enumerate(made)
    ]
    errors = jax.jit(jax.vmap(bs.evaluate))(*bs.stack_pairs(pairs))
    assert (np.asarray(errors["j_ate_sim3"]) < 0.3).all()
    for k, case in enumerate(made):
        alone = bs.solve(*bs.build(case, hold=("cameras", "landmarks")))
        np.testing.assert_allclose(found.state.scale[k], alone.state.scale, rtol=1e-6)
