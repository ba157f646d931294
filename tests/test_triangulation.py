"""Landmarks that lost their way come back, and nothing else moves."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes

import bodyslam_jax.graph as g
from bodyslam_jax.solver import Stage, solve
from bodyslam_jax.solver.retriangulation import triangulate_anew

TIGHT = (Stage(rtol=1e-12, max_steps=60),)
LOST = np.arange(0, 25, 3)


def make(noise=0.0, prior=False):
    rng = np.random.default_rng(5)
    state = scenes.truth(rng, frames=9, people=0, landmarks=25)
    tracks = scenes.reprojection(rng, state, noise=noise)
    factors = [tracks] + ([scenes.landmark_prior(rng, state, tracks)] if prior else [])
    return g.make_problem(factors, state), state


def lose(state, places, lost=LOST):
    landmarks = state.landmarks.at[lost].set(places)
    return eqx.tree_at(lambda s: s.landmarks, state, landmarks)


def terms_of(problem, state):
    return jnp.stack([factor.cost(state) for factor in problem.factors])


def seen_often(problem, count=3):
    seen = np.bincount(np.asarray(problem.factors[0].landmark), minlength=25)
    return np.isin(np.arange(25), LOST) & (seen >= count)


PLACES = {
    "far": lambda x: x * 1e7,
    "near": lambda x: x * 1e-3,
    "behind": lambda x: -x,
}


@pytest.mark.slow
@pytest.mark.parametrize("where", PLACES)
def test_lost_landmarks_are_found_exactly_and_others_stay(where):
    problem, truth = make()
    start = lose(truth, PLACES[where](truth.landmarks[LOST]))
    found, terms = jax.jit(triangulate_anew)(
        problem, start, terms_of(problem, start), 0.1
    )
    known = seen_often(problem, 2)
    assert known.sum() >= 5
    error = np.linalg.norm(np.asarray(found.landmarks - truth.landmarks), axis=-1)
    assert error[known].max() < 1e-6
    rest = ~np.isin(np.arange(25), LOST)
    assert (
        np.asarray(found.landmarks)[rest] == np.asarray(start.landmarks)[rest]
    ).all()
    assert np.allclose(terms, terms_of(problem, found), rtol=1e-9, atol=1e-12)


def test_one_outlier_among_a_few_sightings_does_not_carry_a_landmark_away():
    problem, truth = make()
    (tracks,) = problem.factors
    landmark = np.asarray(tracks.landmark)
    pixel = np.array(tracks.pixel)
    for l in LOST:
        pixel[np.flatnonzero(landmark == l)[:1]] += [25.0, -35.0]
    tracks = dataclasses.replace(tracks, pixel=jnp.asarray(pixel))
    problem = g.make_problem([tracks], truth)
    start = lose(truth, truth.landmarks[LOST] * 1e7)
    found, _ = triangulate_anew(problem, start, terms_of(problem, start), 0.1)
    known = seen_often(problem, 4)
    assert known.sum() >= 3
    error = np.linalg.norm(np.asarray(found.landmarks - truth.landmarks), axis=-1)
    assert error[known].max() < 0.3


@pytest.mark.slow
def test_cost_never_rises_and_what_is_held_or_says_nothing_stays():
    problem, truth = make(noise=1.0, prior=True)
    start = lose(truth, truth.landmarks[LOST] + 3.0)
    terms = terms_of(problem, start)
    found, lower = triangulate_anew(problem, start, terms, 0.1)
    assert (lower.sum() < terms.sum()) and (lower <= terms + 30).all()
    assert np.allclose(lower, terms_of(problem, found))
    held = dataclasses.replace(problem, free=g.set_constant(problem.free, "landmarks"))
    same, as_before = triangulate_anew(held, start, terms, 0.1)
    assert (same.landmarks == start.landmarks).all() and np.allclose(as_before, terms)
    # One sighting each: any depth fits.
    tracks = problem.factors[0]
    _, first = np.unique(np.asarray(tracks.landmark), return_index=True)
    pick = lambda x: x[first] if eqx.is_array(x) and x.ndim else x
    once = g.make_problem([jax.tree.map(pick, tracks)], truth)
    same, _ = triangulate_anew(once, start, terms_of(once, start), 0.1)
    assert (same.landmarks == start.landmarks).all()


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_maps_and_has_finite_gradients(dtype):
    problem, truth = make(noise=0.5)
    start = lose(truth, truth.landmarks[LOST] * 1e3)
    single = lambda x: x.astype(dtype) if eqx.is_inexact_array(x) else x
    problem, start = jax.tree.map(single, (problem, start))
    terms = terms_of(problem, start)
    one = lambda s: triangulate_anew(problem, s, terms, 0.1)[0].landmarks
    batch = jax.tree.map(lambda x: jnp.stack([x, x]), start)
    both = jax.jit(jax.vmap(one))(batch)
    assert both.dtype == dtype
    np.testing.assert_allclose(both[0], one(start), rtol=1e-3, atol=1e-3)
    slope = jax.grad(
        lambda c: one(eqx.tree_at(lambda s: s.cameras, start, c))[
            seen_often(problem)
        ].sum()
    )(start.cameras)
    assert np.isfinite(slope).all() and np.abs(slope).max() > 0


@pytest.mark.slow
@pytest.mark.parametrize("where", PLACES)
def test_a_solve_brings_lost_landmarks_back(where):
    problem, truth = make(noise=0.5)
    best = solve(problem, truth, schedule=TIGHT)
    few = np.flatnonzero(seen_often(problem, 5))
    start = lose(truth, PLACES[where](truth.landmarks[few]), few)
    found = solve(problem, start, schedule=TIGHT)
    assert float(found.cost) == pytest.approx(float(best.cost), rel=1e-6)
    costs = np.asarray(found.histories[0].cost)[: int(found.num_steps[0]) + 1]
    assert (np.diff(costs) <= 1e-9).all()
    assert costs[-1] == pytest.approx(float(found.cost))
