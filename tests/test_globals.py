"""Named globals: variables that all frames have in common, with priors."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

import bodyslam_jax.graph as g
from bodyslam_jax.graph import Variable
from bodyslam_jax.solver import Stage, marginals, solve

FRAMES = 12
# With no more steps than a history has rows, covariances share the program of a solve.
EXACT = (Stage(rtol=1e-14, max_steps=64),)


class Receiver(g.FrameFactor):
    """A position sensor on a lever arm, whose clock is late by an unknown time.

    `r = (s (c_k - τ (c_k - c_{k-1})) + C_k a - z_k) / σ`, τ in frames.
    """

    position: Float[Array, "t 3"]
    sigma: Float[Array, " t"]
    keys = (("camera", 0), ("camera", 1), ("scale", 0), ("late", 0), ("arm", 0))

    def frame_residual(self, data, window, shared):
        position, sigma = data
        now, before = (frame.camera for frame in window)
        delay = shared["late"][0] * (now[:3, 3] - before[:3, 3])
        arm = now[:3, :3] @ shared["arm"]
        return (shared.scale * (now[:3, 3] - delay) + arm - position) / sigma


LATE, ARM = 0.4, np.array([0.1, -0.2, 0.05])


def receiver(state: g.State, noise: float = 0.002, seed: int = 3) -> Receiver:
    c, C = np.asarray(state.cameras[:, :3, 3]), np.asarray(state.cameras[:, :3, :3])
    delay = LATE * np.diff(c, axis=0, prepend=c[:1])
    z = float(state.scale) * (c - delay) + C @ ARM
    z = z + noise * np.random.default_rng(seed).standard_normal(z.shape)
    sigma = np.full(len(c), noise)
    return Receiver(position=jnp.asarray(z), sigma=jnp.asarray(sigma))


def make(people: int = 0, landmarks: int = 60, frames: int = FRAMES):
    rng = np.random.default_rng(5)
    truth = scenes.truth(rng, frames, people, landmarks)
    factors = [scenes.reprojection(rng, truth, noise=0.3)]
    factors += scenes.person_factors(rng, truth) if people else []
    problem = g.make_problem(factors, truth)
    start = scenes.perturb(rng, problem, truth)
    problem, start = problem.with_variables(
        start, late=Variable(0.0, sigma=1.0), arm=Variable(np.zeros(3), sigma=0.5)
    )
    return problem.with_factors(receiver(truth)), start, truth


@pytest.mark.parametrize("people", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_named_globals_are_estimated_with_their_covariance(people):
    problem, start, truth = make(people)
    found = solve(problem, start, schedule=EXACT)
    assert found.status == "converged"
    named = problem.named(found.state.globals)
    assert set(named) == {"late", "arm"}
    spread = np.sqrt(np.diagonal(marginals(problem, found.state).globals))
    error = np.concatenate([named["late"] - LATE, named["arm"] - ARM])
    assert (abs(error) < 4 * spread).all() and (spread < 0.3).all()
    assert float(found.state.scale) == pytest.approx(float(truth.scale), rel=0.05)


def test_the_optimum_is_that_of_a_dense_solver():
    problem, start, _ = make(landmarks=20, frames=8)
    found = solve(problem, start, schedule=EXACT)
    dense = solve(problem, start, solver="optimistix_lm", schedule=(Stage(rtol=1e-10),))
    assert float(found.cost) == pytest.approx(float(dense.cost), rel=1e-6)
    np.testing.assert_allclose(found.state.globals, dense.state.globals, atol=1e-4)


def test_covariances_are_the_inverse_of_the_dense_information():
    problem, start, _ = make(landmarks=20, frames=8)
    state = solve(problem, start, schedule=EXACT).state
    zero, unravel = ravel_pytree(state.zero_step())
    mask = np.asarray(ravel_pytree(problem.free)[0]) > 0
    residual = lambda flat: jnp.concatenate(
        [
            g.robustify(f.loss, f.residual(state.retract(unravel(flat)))).ravel()
            for f in problem.factors
        ]
    )
    jacobian = np.asarray(jax.jacfwd(residual)(zero))[:, mask]
    information = jacobian.T @ jacobian
    # Points that no two frames see have no depth, and tell nothing of the rest.
    least = np.where(np.diagonal(information) > 0, 1e-11 * np.diagonal(information), 1)
    information += np.diag(least)
    names = jax.tree.map(jnp.zeros_like, state.zero_step())
    names = dataclasses.replace(names, globals=jnp.ones(4))
    at = np.asarray(ravel_pytree(names)[0])[mask] > 0
    expected = np.linalg.inv(information)[np.ix_(at, at)]
    found = np.asarray(marginals(problem, state).globals)
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-9)


def test_without_a_measurement_a_variable_stays_at_its_prior():
    rng = np.random.default_rng(0)
    truth = scenes.truth(rng, FRAMES, 0, 40)
    plain = g.make_problem([scenes.reprojection(rng, truth)], truth)
    problem, start = plain.with_variables(truth, drift=Variable([0.5, -1.0], sigma=0.2))
    start = dataclasses.replace(start, globals=start.globals + 3.0)
    state = solve(problem, start).state
    np.testing.assert_allclose(state.globals, [0.5, -1.0], atol=1e-8)
    covariance = marginals(problem, state).globals
    np.testing.assert_allclose(covariance, 0.04 * np.eye(2), rtol=1e-6, atol=1e-12)
    same = solve(plain, truth).state
    np.testing.assert_allclose(state.landmarks, same.landmarks, atol=1e-5)


@pytest.mark.slow
def test_solutions_differentiate_by_the_prior_of_a_variable():
    problem, start, _ = make(landmarks=20, frames=8)
    start = solve(problem, start, schedule=EXACT).state
    which = [isinstance(f, g.GlobalPrior) for f in problem.factors].index(True)

    def late(mean):
        moved = eqx.tree_at(lambda p: p.factors[which].mean, problem, mean[None])
        return solve(moved, start, schedule=EXACT).state.globals[0]

    h = 0.05
    expected = (late(jnp.asarray(h)) - late(jnp.asarray(-h))) / (2 * h)
    slope = jax.grad(late)(jnp.asarray(0.0))
    assert float(slope) == pytest.approx(float(expected), rel=1e-3)
    both = jax.vmap(late)(jnp.array([0.0, h]))
    np.testing.assert_allclose(both[1], late(jnp.asarray(h)), rtol=1e-6)


def test_names_that_are_unknown_or_taken_are_refused():
    problem, start, truth = make()
    plain = g.make_problem(
        [scenes.reprojection(np.random.default_rng(0), truth)], truth
    )
    with pytest.raises(ValueError, match="no variable 'late'.*with_variables"):
        plain.with_factors(receiver(truth))
    with pytest.raises(ValueError, match="'late' is a variable already"):
        problem.with_variables(start, late=Variable(0.0))
    with pytest.raises(ValueError, match="identifier other than"):
        problem.with_variables(start, scale=Variable(1.0))
    with pytest.raises(ValueError, match="finite"):
        problem.with_variables(start, other=Variable(np.nan))
    with pytest.raises(ValueError, match="above 0"):
        problem.with_variables(start, other=Variable(1.0, sigma=0.0))
    with pytest.raises(ValueError, match="expected the 4 of state.globals"):
        g.make_problem(problem.factors[:1], start)


@pytest.mark.slow
def test_variables_keep_single_precision():
    problem, start, _ = make(landmarks=20, frames=8)
    single = jax.tree.map(
        lambda x: x.astype(jnp.float32) if eqx.is_inexact_array(x) else x,
        (problem, start),
    )
    found = solve(*single)
    assert found.state.globals.dtype == jnp.float32
    exact = solve(problem, start).state
    np.testing.assert_allclose(found.state.globals, exact.globals, atol=2e-2)
