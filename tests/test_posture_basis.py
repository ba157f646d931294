"""Postures that move in the directions of a basis."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse
from jax.flatten_util import ravel_pytree
from problems import dense, make, normal_equations, structured_step

import bodyslam_jax.graph as g
from bodyslam_jax import people
from bodyslam_jax.geometry import so3
from bodyslam_jax.solver import Stage, marginalise, marginals, solve
from bodyslam_jax.solver.padding import pad

DAMPING = 1e-3
BASIS = people.posture_basis(12)


def with_basis(problem, basis):
    return dataclasses.replace(problem, basis=jnp.asarray(basis))


def one_step(problem, state):
    step = structured_step(*pad(problem, state), jnp.asarray(DAMPING))
    t, l = len(state.cameras), len(state.landmarks)
    cut = {"cameras": step.cameras[:t], "landmarks": step.landmarks[:l]}
    cut |= {"roots": step.roots[:, :t], "poses": step.poses[:, :t]}
    return dataclasses.replace(step, **cut)


def columns(problem, state):
    """A step by its coordinates: a matrix, with those of the basis last."""
    flat, unravel = ravel_pytree(state.zero_step())
    place = unravel(jnp.arange(len(flat), dtype=float))
    poses = np.asarray(place.poses, int).reshape(-1, 69)
    rest = np.setdiff1d(np.arange(len(flat)), poses)
    k = problem.basis.shape[1]
    found = np.zeros((len(flat), len(rest) + k * len(poses)))
    found[rest, np.arange(len(rest))] = 1.0
    free = np.asarray(problem.free.poses).reshape(-1, 69)
    for i, (rows, mask) in enumerate(zip(poses, free, strict=True)):
        at = len(rest) + k * i + np.arange(k)
        found[rows[:, None], at] = mask[:, None] * np.asarray(problem.basis)
    return found


def test_the_basis_that_ships_is_orthonormal_and_counted():
    basis = people.posture_basis()
    assert basis.shape == (69, 40)
    np.testing.assert_allclose(basis.T @ basis, np.eye(40), atol=1e-12)
    # Hands, which nothing of BODY_25 sees, stay.
    assert abs(basis.reshape(23, 3, 40)[[21, 22]]).max() < 1e-9
    for count in (0, 49):
        with pytest.raises(ValueError, match=f"count: {count}, expected .* 1 to 48"):
            people.posture_basis(count)


@pytest.mark.parametrize(
    "basis, message",
    [
        (np.eye(23), r"found shape \(23, 23\), expected \(69, k\)"),
        (np.ones((69, 2)), "columns are not orthonormal"),
    ],
)
def test_a_basis_that_is_none_is_refused(basis, message):
    problem, state, _ = make(frames=3, people=1)
    with pytest.raises(ValueError, match=f"basis: .*{message}"):
        g.make_problem(problem.factors, state, basis=basis)


@pytest.mark.slow
@pytest.mark.parametrize("past", [0, 10])
def test_steps_are_those_of_dense_equations_in_the_basis(past):
    """Of a whole problem, and of what a prior of its first frames stands for."""
    problem, state, start = make(
        *(1,), frames=23 if past else 12, people=1, extras=not past, some_held=not past
    )
    problem = with_basis(problem, BASIS)
    if past:
        left = marginalise(problem, start, past)
        problem, state = left.problem, left.state
    jac, residual = dense(problem, state)
    turn = columns(problem, state)
    jac = scipy.sparse.csr_array(jac) @ scipy.sparse.csr_array(turn)
    hessian, slope = normal_equations(jac, residual)
    diagonal = np.diag(hessian)
    extra = np.where(diagonal > 1e-100, DAMPING * diagonal, 1.0)
    expected = turn @ np.linalg.solve(hessian + np.diag(extra), -slope)
    found, _ = ravel_pytree(one_step(problem, state))
    assert abs(found - expected).max() < 1e-8 * abs(expected).max()


@pytest.mark.slow
def test_what_the_basis_does_not_span_of_a_posture_stays():
    problem, _, start = make(frames=12, people=1)
    problem = with_basis(problem, BASIS)
    step = one_step(problem, start).poses.reshape(-1, 69)
    beside = np.asarray(step) @ (np.eye(69) - BASIS @ BASIS.T)
    assert abs(beside).max() < 1e-12 < 1e-3 < abs(step).max()
    tight = (Stage(rtol=1e-12),)
    found = solve(problem, start, schedule=tight)
    assert found.status == "converged"
    # At the solution nothing pulls in the directions of the basis.
    slope = jax.jit(jax.grad(lambda d: problem.cost(found.state.retract(d))))
    pull = np.asarray(slope(found.state.zero_step()).poses).reshape(-1, 69)
    assert abs(pull @ BASIS).max() < 1e-3 * abs(pull).max()
    turned = so3.between(start.poses, found.state.poses)
    assert abs(turned[:, :, 21:]).max() < 1e-6 < 1e-3 < abs(turned).max()


@pytest.mark.slow
def test_derivatives_of_a_solution_are_those_in_the_basis():
    problem, _, start = make(frames=7, people=1)
    problem = with_basis(problem, BASIS)
    at = next(
        i
        for i, f in enumerate(problem.factors)
        if isinstance(f, g.KeypointReprojection)
    )
    best = solve(problem, start, schedule=(Stage(rtol=1e-14),)).state

    def size(shift):
        factor = problem.factors[at]
        assert isinstance(factor, g.KeypointReprojection)
        moved = dataclasses.replace(factor, pixel=factor.pixel + shift)
        factors = (*problem.factors[:at], moved, *problem.factors[at + 1 :])
        other = dataclasses.replace(problem, factors=factors)
        found = solve(other, best, schedule=(Stage(rtol=1e-14),)).state
        return found.shapes[0, 0] + jnp.sum(found.poses[0, :, 3])

    slope = jax.grad(size)(jnp.asarray(0.0))
    by_steps = (size(jnp.asarray(1e-2)) - size(jnp.asarray(-1e-2))) / 2e-2
    assert float(slope) == pytest.approx(float(by_steps), rel=1e-3)


@pytest.mark.slow
def test_covariances_with_a_full_basis_are_those_of_all_turns():
    problem, state, _ = make(frames=12, people=1)
    expected = marginals(problem, state)
    found = marginals(with_basis(problem, np.eye(69)), state)
    for some, exact in zip(*map(jax.tree.leaves, (found, expected)), strict=True):
        np.testing.assert_allclose(some, exact, rtol=1e-6, atol=1e-12)
