"""Steps in single precision, on the way to the same place in double precision."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from problems import dense, make

from bodyslam_jax.geometry.lengths import LENGTHS
from bodyslam_jax.solver import Stage, solve, trace
from bodyslam_jax.solver.compilation import quick_options
from bodyslam_jax.solver.elimination.schur import half_inverse
from bodyslam_jax.solver.linearise import linearise
from bodyslam_jax.solver.linearise.landmark import gather
from bodyslam_jax.solver.padding import pad
from bodyslam_jax.solver.solve import MIN_MIXED_FRAMES, is_mixed, method_of, run
from bodyslam_jax.solver.step import Trial

TIGHT = (Stage(rtol=1e-12, max_steps=60),)


def mixed(problem, state, schedule=TIGHT):
    return solve(problem, state, schedule=schedule, mixed_precision=True)


@pytest.mark.slow
def test_it_ends_where_double_precision_ends():
    problem, _, start = make()
    best = solve(problem, start, schedule=TIGHT)
    found = mixed(problem, start)
    assert found.status == "converged"
    assert {x.dtype for x in jax.tree.leaves(found.state)} == {np.dtype(np.float64)}
    assert float(found.cost) == pytest.approx(float(best.cost), rel=1e-11)
    np.testing.assert_allclose(found.state.cameras, best.state.cameras, atol=1e-5)

    def slope(state):
        jacobian, residual = dense(problem, state)
        return abs(jacobian.T @ residual).max()

    assert slope(found.state) < 1e-4 * slope(start)


@pytest.mark.slow
def test_only_factors_are_in_single_precision():
    problem, _, start = make()
    problem, start = pad(problem, start)
    method = method_of((Stage(max_steps=1),), 1e-4, start.scale.dtype, mixed=True)
    _, final = run(problem, start, method)
    single, double = np.dtype(np.float32), np.dtype(np.float64)
    assert {x.dtype for x in jax.tree.leaves(final.factor)} == {single}
    assert {x.dtype for x in final.lin.blocks.values()} == {single}
    assert {x.dtype for x in final.lin.gradient.values()} == {double}
    assert {t.gradient.dtype for t in final.lin.landmarks} == {double}
    assert final.lin.costs.dtype == double


@pytest.mark.slow
def test_slopes_and_costs_are_those_of_double_precision():
    problem, _, state = make(frames=12, people=1)
    problem, state = pad(problem, state)
    whole = eqx.filter_jit(linearise, compiler_options=quick_options())
    double = whole(problem, gather(problem), state)
    single = whole(problem, gather(problem), state, np.dtype(np.float32))
    slopes = lambda lin: (
        (lin.gradient, lin.globals_gradient, lin.costs),
        [table.gradient for table in lin.landmarks],
    )
    pairs = zip(*map(jax.tree.leaves, (slopes(double), slopes(single))), strict=True)
    for expected, found in pairs:
        np.testing.assert_allclose(found, expected, atol=1e-13 * abs(expected).max())
    posture = "pose", "pose", 0
    exact = double.blocks[posture]
    assert single.blocks[posture].dtype == np.float32
    np.testing.assert_allclose(
        single.blocks[posture], exact, atol=1e-6 * abs(exact).max()
    )


@pytest.mark.slow
def test_products_are_of_all_bits_where_a_gpu_would_leave_some_out():
    problem, _, start = make()
    program = str(jax.make_jaxpr(lambda s: mixed(problem, s).cost)(start))
    assert "precision=(Precision.HIGHEST, Precision.HIGHEST)" in program
    assert "precision=None" not in program


@pytest.mark.slow
def test_the_state_s_own_single_precision_is_left_as_it_is():
    problem, _, start = make()
    to_single = lambda x: x.astype(jnp.float32) if x.dtype == jnp.float64 else x
    problem, start = jax.tree.map(to_single, (problem, start))
    schedule = (Stage(max_steps=5),)
    plain = solve(problem, start, schedule=schedule)
    found = mixed(problem, start, schedule)
    assert found.cost.dtype == jnp.float32
    assert float(found.cost) == float(plain.cost)


@pytest.mark.slow
def test_it_maps_over_starts_and_has_the_derivatives_of_double_precision():
    problem, _, start = make()
    batch = jax.tree.map(lambda x: jnp.stack([x, x]), start)
    both = jax.jit(jax.vmap(lambda s: mixed(problem, s).cost))(batch)
    np.testing.assert_allclose(both, float(mixed(problem, start).cost), rtol=1e-12)

    def place(sigma, mixed_precision):
        other = eqx.tree_at(lambda p: p.factors[0].sigma, problem, sigma)
        found = solve(other, start, schedule=TIGHT, mixed_precision=mixed_precision)
        return jnp.sum(found.state.cameras[-1, :3, 3])

    sigma = problem.factors[0].sigma
    by_mixed = jax.grad(place)(sigma, True)
    by_double = jax.grad(place)(sigma, False)
    scale = float(abs(by_double).max())
    assert scale > 0
    np.testing.assert_allclose(by_mixed, by_double, atol=1e-4 * scale)


@pytest.mark.slow
def test_watched_it_is_the_same_solve():
    problem, _, start = make()
    best = mixed(problem, start)
    settings = dict(schedule=TIGHT, mixed_precision=True)
    _, costs = trace(problem, start, problem.cost, **settings)
    assert len(costs) == 1 + TIGHT[0].max_steps
    assert float(costs[-1]) == pytest.approx(float(best.cost), rel=1e-10)


@pytest.mark.slow
def test_a_baseline_has_one_precision():
    problem, _, start = make()
    with pytest.raises(ValueError, match="mixed_precision: adam has one precision"):
        solve(problem, start, solver="adam", mixed_precision=True)


@pytest.mark.slow
def test_people_and_a_scale_ten_times_off():
    problem, _, start = make(frames=12, people=1)
    best = solve(problem, start, schedule=TIGHT)
    off = eqx.tree_at(lambda s: s.scale, start, 0.1 * start.scale)
    found = mixed(problem, off)
    assert float(found.cost) == pytest.approx(float(best.cost), rel=1e-6)
    assert float(found.state.scale) == pytest.approx(float(best.state.scale), rel=1e-3)


@pytest.mark.slow
def test_landmarks_own_blocks_are_those_of_double_precision():
    problem, _, state = make(far=2)
    problem, state = pad(problem, state)
    whole = eqx.filter_jit(linearise, compiler_options=quick_options())
    double = whole(problem, gather(problem), state)
    single = whole(problem, gather(problem), state, np.dtype(np.float32))
    for expected, found in zip(double.landmarks, single.landmarks, strict=True):
        assert found.cross.dtype == np.float32
        scale = abs(expected.own).max()
        np.testing.assert_allclose(found.own, expected.own, atol=1e-13 * scale)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_no_pivot_of_a_landmark_is_below_its_damping(dtype):
    # Without depth, and with a last pivot that rounding makes negative.
    own = np.array([[1.0, 1, 1], [1, 1, 1], [1, 1, 1 - 1e-6]], dtype)
    damping = np.full((1, 3, 1), 1e-9, dtype)
    rows = half_inverse(jnp.asarray(own)[None, :, :, None], jnp.asarray(damping))
    for row in rows:
        assert all(bool(jnp.isfinite(x).all()) for x in row)
        assert float(row[-1].max()) <= 1e-9**-0.5 * (1 + 1e-6)


def test_the_least_damping_rises_where_a_factorisation_failed():
    blank: Any = (None,) * len(Trial._fields)
    failed = Trial(*blank)._replace(damping=jnp.asarray(1e-8), finite=jnp.array(False))

    def after(trial, least, dtype: Any = np.float32):
        return float(trial.next_least(jnp.asarray(least), dtype))

    assert after(failed, 1e-12) == pytest.approx(1e-7)
    assert after(failed, 1e-6) == pytest.approx(1e-6)
    far = failed._replace(damping=jnp.asarray(1e-2))
    assert after(far, 1e-12) == pytest.approx(1e-6)
    assert after(failed._replace(finite=jnp.array(True)), 1e-12) == 1e-12
    # In double precision it is the curvature of keypoints that fails, not rounding.
    assert after(failed, 1e-12, np.float64) == 1e-12


def test_the_default_is_single_precision_for_long_problems_without_people():
    zero = lambda people, frames: scenes.truth(np.random.default_rng(0), frames, people)
    assert is_mixed(None, zero(0, 61))
    assert not is_mixed(None, zero(0, 60))
    assert not is_mixed(None, zero(1, 61))
    assert not is_mixed(False, zero(0, 61))
    assert is_mixed(True, zero(1, 7))
    assert MIN_MIXED_FRAMES - 1 in LENGTHS  # no size has two programs
