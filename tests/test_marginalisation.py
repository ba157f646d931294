"""The oldest frames as a prior: exact, where the dense normal equations are."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from own_factors import CameraSmoothness
from problems import dense, make

import bodyslam_jax.graph as g
from bodyslam_jax.solver import marginalise


def normal_equations(problem, state):
    jacobian, residual = dense(problem, state)
    return jacobian.T @ jacobian, jacobian.T @ residual


def schur(matrix, slope, gone, left):
    """What eliminating coordinates leaves, by dense linear algebra."""
    inverse = np.linalg.pinv(matrix[np.ix_(gone, gone)], rcond=1e-13, hermitian=True)
    gain = matrix[np.ix_(left, gone)] @ inverse
    reduced = matrix[np.ix_(left, left)] - gain @ matrix[np.ix_(gone, left)]
    return reduced, slope[left] - gain @ slope[gone]


CASES = [
    pytest.param({"frames": 14, "known": True, "steady": True}, 5, id="cameras"),
    pytest.param({"frames": 14, "length": 4}, 6, id="short tracks"),
    pytest.param({"people": 1, "extras": True}, 4, id="person", marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("options", "frames"), CASES)
def test_prior_and_rest_have_the_marginal_of_the_whole(options, frames):
    problem, _, state = make(**options)
    prior, rest = marginalise(problem, state, frames)
    whole, whole_slope = normal_equations(problem, state)
    # What is left: measured by the rest, or in the prior.
    part, part_slope = normal_equations(rest, state)
    place = np.asarray(prior.coordinates)
    part[np.ix_(place, place)] += prior.information
    part_slope[place] += prior.slope
    left = np.flatnonzero(np.diag(part) > 0)
    gone = np.setdiff1d(np.flatnonzero(np.diag(whole) > 0), left)
    assert len(gone) > 6 * (frames - 3)
    expected, slope = schur(whole, whole_slope, gone, left)
    unit = 1 / np.sqrt(np.diag(expected))
    scaled = lambda x: unit[:, None] * x * unit
    np.testing.assert_allclose(
        scaled(part[np.ix_(left, left)]), scaled(expected), atol=1e-7
    )
    found = unit * part_slope[left]
    np.testing.assert_allclose(found, unit * slope, atol=1e-6 * abs(unit * slope).max())


def test_variables_of_old_frames_are_held_and_landmarks_that_they_observe():
    problem, _, state = make(frames=14, length=4)
    _, rest = marginalise(problem, state, 6)
    tracks = next(f for f in rest.factors if isinstance(f, g.Reprojection))
    used = np.isfinite(np.asarray(tracks.sigma))
    assert used.any()
    assert np.asarray(tracks.frame)[used].min() >= 6
    assert not np.asarray(rest.free.cameras)[:5].any()
    assert np.asarray(rest.free.cameras)[6:13].all()
    free = np.all(np.asarray(rest.free.landmarks) > 0, axis=1)
    assert np.all(free[np.asarray(tracks.landmark)[used]])


def test_cost_is_that_of_the_best_old_variables():
    """Of linear residuals: cameras that move evenly, along one line."""
    frames = 12
    zeros = lambda *shape: jnp.asarray(np.zeros(shape))
    state = g.State(
        scale=jnp.asarray(1.0),
        cameras=jnp.asarray(np.tile(np.eye(4), (frames, 1, 1)))
        .at[:, 0, 3]
        .set(np.random.default_rng(0).normal(size=frames)),
        roots=zeros(0, frames, 4, 4),
        poses=zeros(0, frames, 23, 3),
        shapes=zeros(0, 10),
        landmarks=zeros(0, 3),
        intrinsics=jnp.asarray(np.array([600.0, 600, 320, 240])),
    )
    sigma = jnp.asarray(np.full((frames, 2), 0.1)).at[:2].set(jnp.inf)
    problem = g.make_problem([CameraSmoothness(sigma=sigma)], state)
    prior, rest = marginalise(problem, state, 7)
    whole, slope = normal_equations(problem, state)
    step, unravel = ravel_pytree(state.zero_step())
    left = np.asarray(prior.coordinates)
    free = np.flatnonzero(np.diag(whole) > 0)
    gone = free[free < left.min()]
    moved = np.zeros(len(step))
    # Of centres: `scale` comes first in a step, then six numbers of each camera.
    centre = (left - 1) % 6 >= 3
    moved[left] = np.where(centre, np.random.default_rng(1).normal(size=len(left)), 0)
    best = np.linalg.lstsq(
        whole[np.ix_(gone, gone)], -slope[gone] - whole[gone] @ moved, rcond=None
    )[0]

    def cost(x):
        moved_state = state.retract(unravel(jnp.asarray(x)))
        return float(problem.cost(moved_state)) - float(rest.cost(moved_state))

    others = np.zeros(len(step))
    others[gone] = np.linalg.lstsq(whole[np.ix_(gone, gone)], -slope[gone], rcond=None)[
        0
    ]
    others_cost = cost(others)
    moved_by = prior.cost(unravel(jnp.asarray(moved)))
    moved[gone] = best
    assert float(moved_by) == pytest.approx(cost(moved) - others_cost, rel=1e-9)
    none = jax.jit(lambda p, step: p.cost(step))(prior, state.zero_step())
    assert float(none) == 0.0


def test_old_frames_that_nothing_ties_to_the_rest_leave_an_empty_prior():
    _, _, state = make(frames=14)
    known = g.CameraPrior(cameras=state.cameras, sigma=jnp.ones((14, 6)))
    problem = g.make_problem([known], state)
    prior, rest = marginalise(problem, state, 5)
    assert prior.information.shape == (0, 0)
    assert float(prior.cost(state.zero_step())) == 0.0
    assert not np.asarray(rest.free.cameras)[:5].any()


@pytest.mark.parametrize("frames", [0, 14])
def test_some_frames_go_and_some_stay(frames):
    problem, _, state = make(frames=14)
    with pytest.raises(ValueError, match="frames: .* expected 1 to 13"):
        marginalise(problem, state, frames)
