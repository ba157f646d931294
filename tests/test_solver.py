"""The structured solver against dense algebra, stock solvers and the truth."""

import dataclasses
import functools
import importlib
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
import scipy.sparse
from jax.flatten_util import ravel_pytree
from own_factors import CameraSmoothness
from problems import bent, dense, factorised, make, structured_step

import bodyslam_jax.graph as g
from bodyslam_jax.geometry.camera import project
from bodyslam_jax.graph import CHUNK
from bodyslam_jax.solver import (
    Stage,
    marginals,
    restrict,
    solve,
    trace,
)
from bodyslam_jax.solver.batching import sequential_vmap
from bodyslam_jax.solver.blocks import sizes_of
from bodyslam_jax.solver.compilation import quick_options
from bodyslam_jax.solver.implicit import MAX_DIRECTIONS, gmres
from bodyslam_jax.solver.linearise import linearise
from bodyslam_jax.solver.linearise.landmark import gather
from bodyslam_jax.solver.padding import pad
from bodyslam_jax.solver.second_order import add_second_order, curvature_of, next_share
from bodyslam_jax.solver.solve import check_start
from bodyslam_jax.solver.triangular import invert_lower

TIGHT = (Stage(rtol=1e-13, max_steps=60),)
STOCK = ["optimistix_lm", "jaxopt_lm"]


def unpadded(step, state):
    t, l = len(state.cameras), len(state.landmarks)
    cut = {
        "cameras": step.cameras[:t],
        "roots": step.roots[:, :t],
        "poses": step.poses[:, :t],
        "landmarks": step.landmarks[:l],
    }
    return g.Step(**{**vars(step), **cut})


def own_sizes(monkeypatch):
    """Has problems laid out in sizes of their own, as those are that fit in no common
    size."""
    monkeypatch.setattr("bodyslam_jax.graph.layout.SIZES", ())


def out_of_time(monkeypatch):
    """Has chunks reordered in short videos too, where it does not pay."""
    own_sizes(monkeypatch)
    monkeypatch.setattr("bodyslam_jax.graph.ordering._MAX_COST_RATIO", np.inf)


def last(monkeypatch, count):
    """Has so many of the longest tracks eliminated last, in two groups."""
    if not count:
        return
    own_sizes(monkeypatch)
    longest = lambda span, *_: np.argsort(-span, kind="stable")[:count]
    monkeypatch.setattr("bodyslam_jax.graph.layout.choose_long_tracks", longest)
    monkeypatch.setattr("bodyslam_jax.graph.layout._GROUP_LANDMARKS", count // 2)


@pytest.mark.parametrize(
    "options",
    [
        {"frames": 33, "landmarks": 60, "known": True},
        # The camera goes there and back: chunks do not stand in the order of time, by
        # which it is held steady.
        pytest.param(
            {
                "frames": 53,
                "landmarks": 60,
                "again": True,
                "steady": True,
                "free_intrinsics": True,
            },
            marks=pytest.mark.slow,
        ),
        # Points that are seen all the time go last, with intrinsics and others that do.
        pytest.param(
            {
                "frames": 43,
                "landmarks": 60,
                "far": 8,
                "known": True,
                "free_intrinsics": True,
            },
            marks=pytest.mark.slow,
        ),
        pytest.param(
            {"frames": 43, "people": 1, "landmarks": 60, "far": 8, "again": True},
            marks=pytest.mark.slow,
        ),
        {"frames": 12, "people": 1},
        # Long tracks: a chunk shares landmarks with several others.
        pytest.param(
            {"frames": 33, "people": 1, "landmarks": 40, "length": 30},
            marks=pytest.mark.slow,
        ),
        pytest.param(
            {"frames": 12, "people": 2, "extras": True, "free_intrinsics": True},
            marks=pytest.mark.slow,
        ),
        # Without postures, and without anything that ties a person's frames.
        pytest.param(
            {"frames": 13, "people": 2, "held": "poses"}, marks=pytest.mark.slow
        ),
        pytest.param(
            {"frames": 12, "people": 1, "without": g.HumanMotion},
            marks=pytest.mark.slow,
        ),
    ],
)
def test_step_is_that_of_the_dense_normal_equations(options, monkeypatch):
    options = dict(options)
    if options.get("again"):
        out_of_time(monkeypatch)
    last(monkeypatch, options.get("far", 0))
    held, without = options.pop("held", None), options.pop("without", ())
    problem, _, state = make(1, **options)
    assert problem.layout.lasting == options.get("far", 0)
    assert (problem.layout.order is not None) == options.get("again", False)
    kept = tuple(f for f in problem.factors if not isinstance(f, without))
    problem = dataclasses.replace(problem, factors=kept)
    problem = restrict(problem, tuple(set(g.VARIABLES) - {held}))
    jac, residual = dense(problem, state)
    jac, damping = scipy.sparse.csr_array(jac), 1e-3
    hessian = jac.T @ jac
    diagonal = hessian.diagonal()
    extra = np.where(diagonal > 1e-100, damping * diagonal, 1.0)
    damped = hessian + scipy.sparse.diags_array(extra)
    expected = factorised(damped)(-jac.T @ residual)
    step = structured_step(*pad(problem, state), jnp.asarray(damping))
    found, _ = ravel_pytree(unpadded(step, state))
    assert abs(found - expected).max() < 1e-9 * abs(expected).max()


@pytest.mark.slow
def test_gauss_newton_reaches_the_same_optimum():
    problem, _, start = make()
    best = solve(problem, start, schedule=TIGHT)
    found = solve(problem, start, schedule=TIGHT, damping=0.0)
    assert best.status == found.status == "converged"
    assert found.histories[0].damping[0] == 0
    assert float(found.cost) == pytest.approx(float(best.cost), rel=1e-8)


@pytest.mark.slow
def test_last_steps_know_what_keypoints_bend():
    problem, _, start = make(2, people=1, frames=12, noise=5.0)
    robust = g.Reprojection, g.KeypointReprojection
    # Second derivatives of robust losses are left out, and would hide the rest.
    factors = tuple(
        dataclasses.replace(f, loss=g.Squared()) if isinstance(f, robust) else f
        for f in problem.factors
    )
    problem = dataclasses.replace(problem, factors=factors)
    run = lambda state, steps, damping=1e-4: (
        solve(
            problem,
            state,
            schedule=(Stage(rtol=0.0, max_steps=steps),),
            damping=damping,
        ).state
    )
    best = run(run(start, 100), 100)
    rng = np.random.default_rng(0)
    move = 1e-3 * problem.free.poses * jnp.asarray(rng.standard_normal((1, 12, 23, 3)))
    near = best.retract(dataclasses.replace(best.zero_step(), poses=move))
    away = lambda state: float(jnp.abs(state.poses - best.poses).max())
    # Those of Gauss-Newton know of J^T J alone: errors halve with each.
    plain = away(run(near, 12, damping=0.0))
    assert away(run(near, 12)) < plain / 20 < 1e-5


def test_curvature_comes_in_when_steps_gain_little_and_goes_where_it_has_no_minimum():
    following = lambda share, accepted, gained: float(
        next_share(jnp.asarray(share), jnp.array(accepted), jnp.asarray(gained), 1.0)
    )
    assert following(0.0, True, 0.5) == following(0.0, False, 0.0) == 0
    share = following(0.0, True, 1e-4)
    assert 0 < share < 1
    assert share < following(share, True, 0.5) < 1
    assert following(share, False, 0.0) == share / 2
    assert following(0.99, True, 1e-4) == following(1.0, True, 1e-4) == 1


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_share_of_the_curvature_of_all_keypoints_joins_the_equations(dtype):
    problem, state, _ = make(people=1, frames=3, noise=5.0)
    problem, state = pad(problem, state)
    sizes = sizes_of(problem, state, np.dtype(dtype))
    like = eqx.filter_eval_shape(
        linearise, problem, gather(problem), state, sizes.dtype
    )
    lin = jax.tree.map(lambda x: jnp.ones(x.shape, x.dtype), like)
    (keypoints,) = (f for f in problem.factors if isinstance(f, g.KeypointReprojection))
    twice = dataclasses.replace(problem, factors=(*problem.factors, keypoints))
    bent = eqx.filter_jit(curvature_of)
    one, two = (bent(p, lin, state, sizes) for p in (problem, twice))
    assert all(x.dtype == dtype and jnp.any(x != 0) for x in jax.tree.leaves(one))
    assert eqx.tree_equal(two, jax.tree.map(lambda x: 2 * x, one), rtol=1e-5)
    # The share has the state's precision, which blocks may not have.
    found = add_second_order(lin, one, jnp.asarray(0.25, state.scale.dtype))
    for key, more in one.blocks.items():
        assert found.blocks[key].dtype == dtype
        assert jnp.allclose(found.blocks[key], 1 + more / 4)
    same = {key for key in lin.blocks if key not in one.blocks}
    assert same and all(found.blocks[k] is lin.blocks[k] for k in same)


@pytest.mark.slow
@pytest.mark.parametrize("solver", STOCK)
def test_all_second_order_solvers_reach_the_same_optimum(solver):
    problem, _, start = make()
    best = solve(problem, start, schedule=TIGHT)
    idle = (*TIGHT, Stage(("scale",), max_steps=0))
    found = solve(problem, start, solver=solver, schedule=idle)
    assert float(found.cost) == pytest.approx(float(best.cost), rel=1e-8)
    # At this tolerance rounding alone keeps optimistix from saying that it has.
    assert found.status == "converged" or solver == "optimistix_lm"
    assert found.num_steps[1] == 0


@pytest.mark.slow
@pytest.mark.parametrize("solver", STOCK)
def test_a_stock_solver_that_is_not_there_yet_says_so(solver):
    problem, _, start = make()
    few = (Stage(rtol=1e-13, max_steps=1),)
    found = solve(problem, start, solver=solver, schedule=few)
    assert found.status == "ran out of steps" and found.cost < found.first_cost


@pytest.mark.parametrize(
    "solver", [*(pytest.param(name, marks=pytest.mark.slow) for name in STOCK), "adam"]
)
def test_a_stock_solver_that_meets_nan_gives_back_the_start_and_says_so(solver):
    problem, _, start = make()
    lost = problem.factors[0].pixel.at[3].set(jnp.nan)
    problem = eqx.tree_at(lambda p: p.factors[0].pixel, problem, lost)
    schedule = (Stage(max_steps=12),) if solver == "adam" else TIGHT
    found = solve(problem, start, solver=solver, schedule=schedule)
    assert found.status == "cost is not finite"
    assert jnp.array_equal(found.state.cameras, start.cameras)


def test_first_order_steps_end_by_themselves_only_where_the_cost_stays():
    problem, _, start = make()
    found = solve(problem, start, solver="adam", schedule=(Stage(max_steps=12),))
    assert found.status == "ran out of steps"
    assert found.num_steps == (12,)
    assert found.cost < found.first_cost
    loose = (Stage(max_steps=12, rtol=2.0),)
    found = solve(problem, start, solver="adam", schedule=loose)
    assert found.status == "converged"


@pytest.mark.slow
def test_landmarks_known_besides_reach_the_same_optimum_as_in_stock_solvers():
    problem, _, start = make(known=True)
    found = solve(problem, start, schedule=TIGHT)
    other = solve(problem, start, solver="optimistix_lm", schedule=TIGHT)
    assert float(found.cost) == pytest.approx(float(other.cost), rel=1e-8)
    without = eqx.tree_at(lambda p: p.factors, problem, problem.factors[1:])
    assert float(without.cost(found.state)) < 0.9 * float(found.cost)


@pytest.mark.slow
def test_first_order_steps_lower_the_cost():
    problem, _, start = make(2, frames=5, landmarks=15)
    found = solve(problem, start, solver="adam", schedule=(Stage(max_steps=200),))
    assert found.cost < 0.1 * problem.cost(start)


def test_noise_free_scene_is_recovered_and_history_says_how():
    problem, truth, start = make(noise=0.0)
    found = solve(problem, start, schedule=TIGHT)
    assert found.status == "converged"
    assert found.cost < 1e-16
    seen = jnp.unique(problem.factors[0].landmark)
    error = (found.state.landmarks - truth.landmarks)[seen]
    assert jnp.median(jnp.abs(error)) < 1e-8
    steps = int(found.num_steps[0])
    cost = found.histories[0].cost[: steps + 1]
    assert (jnp.diff(cost) <= 0).all()
    assert jnp.isclose(cost[0], problem.cost(start))


@pytest.mark.slow
def test_person_and_scale_are_recovered_from_ten_times_off_either_way():
    problem, truth, start = make(4, people=1, frames=12, noise=0.0)
    scales = []
    for factor in (0.1, 1.0, 10.0):
        off = eqx.tree_at(lambda s: s.scale, start, truth.scale * factor)
        found = solve(problem, off, schedule=TIGHT)
        assert found.status == "converged"
        scales.append(float(found.state.scale))
    assert np.allclose(scales, float(truth.scale), rtol=1e-5)


@pytest.mark.slow
def test_order_of_landmarks_does_not_matter():
    problem, _, start = make()
    count = len(start.landmarks)
    order = np.random.default_rng(0).permutation(count)
    factor = problem.factors[0]
    renamed = jnp.asarray(np.argsort(order))[factor.landmark]
    shuffled = eqx.tree_at(lambda f: f.landmark, factor, renamed)
    other_start = eqx.tree_at(lambda s: s.landmarks, start, start.landmarks[order])
    other = g.make_problem([shuffled], other_start, free=problem.free)
    first = solve(problem, start, schedule=TIGHT)
    second = solve(other, other_start, schedule=TIGHT)
    assert jnp.isclose(first.cost, second.cost, rtol=1e-9)
    moved = second.state.cameras - first.state.cameras
    assert jnp.abs(moved).max() < 1e-6


@pytest.mark.slow
def test_inliers_count_as_if_there_were_no_outliers():
    problem, _, start = make(noise=0.5)
    factor = problem.factors[0]
    wrong = jnp.arange(len(factor.frame)) % 29 == 3
    pixel = factor.pixel + jnp.where(wrong[:, None], jnp.array([30.0, -45.0]), 0.0)
    problem = eqx.tree_at(lambda p: p.factors[0].pixel, problem, pixel)
    with_loss = lambda loss: eqx.tree_at(lambda p: p.factors[0].loss, problem, loss)
    left_out = eqx.tree_at(
        lambda p: p.factors[0].sigma,
        with_loss(g.Squared()),
        jnp.where(wrong, jnp.inf, factor.sigma),
    )
    first = solve(problem, start, schedule=TIGHT).state
    best = solve(left_out, first, schedule=TIGHT).state
    found = solve(with_loss(g.BlakeZisserman(5.0)), first, schedule=TIGHT).state
    away = lambda state: jnp.abs(state.cameras - best.cameras).max()
    assert away(found) < 1e-5 < 1e-3 < away(first)


def test_the_world_and_unit_of_the_map_do_not_matter():
    problem, _, start = make()
    size, turn = 3.0, np.asarray(g.retract_pose(jnp.eye(4), 0.1 * jnp.arange(6.0)))
    cameras = jnp.asarray(turn) @ start.cameras
    cameras = cameras.at[:, :3, 3].multiply(size)
    points = size * (start.landmarks @ turn[:3, :3].T + turn[:3, 3])
    moved = eqx.tree_at(lambda s: (s.cameras, s.landmarks), start, (cameras, points))
    other = g.make_problem(problem.factors, moved)
    first, second = (
        solve(p, s, schedule=TIGHT) for p, s in ((problem, start), (other, moved))
    )
    assert jnp.isclose(first.cost, second.cost, rtol=1e-8)


@pytest.mark.slow
def test_starts_are_mapped_over_in_one_go():
    problem, truth, start = make()
    rng = np.random.default_rng(1)
    starts = [scenes.perturb(rng, problem, truth, size=0.01) for _ in range(2)]
    # What is mapped cannot be refused: it comes back, and the status says so.
    starts.append(eqx.tree_at(lambda s: s.landmarks, start, jnp.nan * start.landmarks))
    batch = jax.tree.map(lambda *x: jnp.stack(x), *starts)
    together = jax.vmap(lambda s: solve(problem, s, schedule=TIGHT))(batch)
    assert together.status.tolist() == ["converged"] * 2 + ["cost is not finite"]
    assert jnp.isnan(together.state.landmarks[2]).all()
    alone = [float(solve(problem, s, schedule=TIGHT).cost) for s in starts[:2]]
    assert np.allclose(together.cost[:2], alone, rtol=1e-8)


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="maps all at once")
def test_a_cpu_maps_in_turn():
    """Each problem takes its own branch, which is then no choice between both."""

    def turn(x, name):
        return {name: jax.lax.cond(x > 0, lambda: 2 * x, lambda: -x), "name": name}

    mapped = jax.vmap(lambda x: sequential_vmap(turn)(x, "y")["y"])
    x = jnp.array([1.0, -3.0])
    assert mapped(x).tolist() == [2.0, 3.0]
    assert "cond[" in str(jax.make_jaxpr(mapped)(x))
    at_once = jax.vmap(lambda x: turn(x, "y")["y"])
    assert "cond[" not in str(jax.make_jaxpr(at_once)(x))


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="maps all at once")
def test_mapping_outside_of_jit_calls_the_program_that_is_compiled_already():
    calls = []

    def program(x, y):
        calls.append(x)
        return x + y

    mapped = jax.vmap(sequential_vmap(jnp.add, program), (0, None))
    given = jnp.array([1.0, -3.0]), jnp.array(0.5)
    assert mapped(*given).tolist() == [1.5, -2.5]
    assert len(calls) == 2
    assert jax.jit(mapped)(*given).tolist() == [1.5, -2.5]
    assert len(calls) == 2


@pytest.mark.slow
def test_gradients_of_solutions_are_mapped_over():
    problem, _, start = make()

    def place(shift, schedule=TIGHT):
        pixels = lambda p: p.factors[0].pixel
        data = eqx.tree_at(pixels, problem, pixels(problem) + shift)
        return solve(data, start, schedule=schedule).state.cameras[-1, 0, 3]

    shifts = jnp.array([0.0, 0.3])
    found = jax.vmap(jax.grad(place))(shifts)
    places = jax.vmap(place)(jnp.concatenate([shifts + 1e-3, shifts - 1e-3]))
    expected = (places[:2] - places[2:]) / 2e-3
    assert np.allclose(found, expected, rtol=1e-4)
    # Nor does a stage without steps hold what the one before moved.
    idle = (*TIGHT, Stage(("scale",), max_steps=0))
    assert np.allclose(jax.grad(place)(shifts[1], idle), found[1], rtol=1e-9)


@pytest.mark.parametrize("backend", ["cpu", "gpu"])
def test_triangular_matrices_of_any_width_are_inverted(backend, monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    rng = np.random.default_rng(0)
    for n in (1, 24, 25, 69):
        lower = np.tril(rng.standard_normal((2, n, n))) + 4 * np.sqrt(n) * np.eye(n)
        inverse = jax.jit(invert_lower)(jnp.asarray(lower))
        assert np.allclose(inverse @ lower, np.eye(n), atol=1e-12)


@pytest.mark.slow
def test_single_precision_reaches_the_same_optimum():
    problem, _, start = make()
    half = lambda tree: jax.tree.map(
        lambda x: x.astype(jnp.float32) if eqx.is_inexact_array(x) else x, tree
    )
    double = solve(problem, start, schedule=TIGHT)
    single = solve(half(problem), half(start))
    assert single.state.cameras.dtype == jnp.float32
    assert float(single.cost) == pytest.approx(float(double.cost), rel=1e-4)


@pytest.mark.slow
def test_single_precision_serves_people_and_covariances_too():
    problem, _, start = make(people=1, frames=12)
    half = lambda tree: jax.tree.map(
        lambda x: x.astype(jnp.float32) if eqx.is_inexact_array(x) else x, tree
    )
    double = solve(problem, start, schedule=TIGHT)
    single = solve(half(problem), half(start))
    assert single.state.poses.dtype == jnp.float32
    assert float(single.cost) == pytest.approx(float(double.cost), rel=1e-3)
    spread = marginals(half(problem), single.state)
    assert all(jnp.isfinite(x).all() for x in jax.tree.leaves(spread))
    exact = marginals(problem, double.state)
    # Rounding, and the damping that keeps it from harm, tell more than noise does.
    assert 0.5 < float(spread.scale) / float(exact.scale) < 2


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        {
            "frames": 43,
            "landmarks": 150,
            "known": True,
            "again": True,
            "far": 8,
            "free_intrinsics": True,
        },
        pytest.param(
            {"people": 1, "frames": 12, "some_held": True}, marks=pytest.mark.slow
        ),
        pytest.param(
            {"people": 1, "frames": 12, "at": "truth"}, marks=pytest.mark.slow
        ),
        pytest.param(
            {"frames": 13, "people": 2, "landmarks": 60}, marks=pytest.mark.slow
        ),
        pytest.param(
            {"frames": 33, "people": 1, "landmarks": 60, "length": 30},
            marks=pytest.mark.slow,
        ),
    ],
)
def test_marginal_covariances_are_blocks_of_the_inverse(options, monkeypatch):
    if options.get("again"):
        out_of_time(monkeypatch)
    last(monkeypatch, options.get("far", 0))
    at = options.get("at", "minimum" if "people" in options else "truth")
    scene = {name: value for name, value in options.items() if name != "at"}
    problem, state, start = make(9, **scene)
    if at == "minimum":
        state = solve(problem, start, schedule=TIGHT).state
    assert problem.layout.lasting == options.get("far", 0)
    assert (problem.layout.order is not None) == options.get("again", False)
    jac, _ = dense(problem, state)
    jac = scipy.sparse.csr_array(jac)
    hessian = jac.T @ jac
    second_order = scipy.sparse.csr_array(bent(problem, state))
    # Away from a minimum what keypoints add_second_order may leave no inverse.
    if at == "minimum":
        hessian = hessian + second_order
    else:
        lowest = np.linalg.eigvalsh((hessian + second_order).toarray())[0]
        assert lowest < -1 or "people" not in options
    diagonal = hessian.diagonal()
    extra = np.where(diagonal > 1e-100, 1e-11 * diagonal, 1.0)
    inverse_times = factorised(hessian + scipy.sparse.diags_array(extra))
    mask = np.asarray(ravel_pytree(problem.free)[0])
    zero, unravel = ravel_pytree(state.zero_step())

    def metric(x):
        moved = state.retract(unravel(x))
        centres = moved.scale * moved.cameras[:, :3, 3]
        pelvis = g.world_from_root(moved)[..., :3, 3].reshape(-1, 3)
        ours = centres, moved.scale * moved.landmarks, pelvis, moved.shapes
        return *ours, moved.scale[None, None], moved.intrinsics[None]

    spread = marginals(problem, state)
    people = spread.people.reshape(-1, 3, 3)
    intrinsics = spread.intrinsics[None] if options.get("free_intrinsics") else []
    found = spread.cameras, spread.landmarks, people, spread.shapes
    found = *found, spread.scale[None, None, None], intrinsics
    assert spread.intrinsics.shape == (4 * len(intrinsics),) * 2
    for by_step, block in zip(jax.jit(jax.jacfwd(metric))(zero), found, strict=True):
        if not len(block):
            continue
        by_step = mask * np.asarray(by_step)
        solved = inverse_times(by_step.reshape(-1, len(mask)).T).T
        expected = by_step @ solved.reshape(by_step.shape).swapaxes(-1, -2)
        size = np.trace(expected, axis1=1, axis2=2)
        error = abs(np.asarray(block) - expected).max(axis=(1, 2))
        known = size <= 10 * np.median(size)  # the rest is as good as not seen
        assert known.sum() > 0.8 * len(known)
        assert (error[known] < 1e-3 * size[known] + 1e-12).all()


@pytest.mark.slow
def test_covariances_do_not_depend_on_how_chunks_stand(monkeypatch):
    """Steps of chunks in another order are those of dense equations, see above."""
    own_sizes(monkeypatch)
    in_time, state, _ = make(9, frames=63, people=2, landmarks=80)
    assert in_time.layout.order is None
    order = np.array([3, 0, 5, 1, 6, 2, 4])
    monkeypatch.setattr("bodyslam_jax.graph.ordering._MAX_COST_RATIO", np.inf)
    monkeypatch.setattr("bodyslam_jax.graph.ordering._spectral", lambda *_: order)
    problem = g.make_problem(in_time.factors, state)
    assert problem.layout.order.tolist() == order.tolist()
    assert problem.layout.reach == 6
    found, expected = marginals(problem, state), marginals(in_time, state)
    for name in ("scale", "cameras", "people", "shapes", "landmarks"):
        one, other = getattr(found, name), getattr(expected, name)
        size = np.abs(other).max(axis=tuple(range(1, other.ndim)), keepdims=True)
        assert (np.abs(one - other) <= 1e-5 * size).all()


@pytest.mark.slow
def test_covariances_do_not_depend_on_what_is_eliminated_last(monkeypatch):
    options = {"frames": 33, "people": 1, "landmarks": 60, "far": 8}
    before, state, _ = make(9, **options)
    last(monkeypatch, 8)
    after = g.make_problem(before.factors, state)
    assert (before.layout.lasting, after.layout.lasting) == (0, 8)
    expected, found = (marginals(p, state) for p in (before, after))
    for name in ("scale", "cameras", "people", "shapes", "landmarks"):
        one, other = getattr(found, name), getattr(expected, name)
        size = np.abs(other).max(axis=tuple(range(1, other.ndim)), keepdims=True)
        # What landmarks have to do with the scale is little of their covariance; that
        # of a point without parallax (10 m² and more) is the inverse of rounding.
        limit = np.where(size < 10, 1e-6, 1e-4) * size
        assert (np.abs(one - other) <= limit).all(), name


@pytest.mark.slow
def test_what_is_eliminated_last_serves_every_kind_of_solve(monkeypatch):
    before, _, start = make(landmarks=40, frames=23, far=8)
    last(monkeypatch, 8)
    after = g.make_problem(before.factors, start)
    best = solve(before, start, schedule=TIGHT)
    found = solve(after, start, schedule=TIGHT)
    assert float(found.cost) == pytest.approx(float(best.cost), rel=1e-9)
    mixed = solve(after, start, schedule=TIGHT, mixed_precision=True)
    assert float(mixed.cost) == pytest.approx(float(best.cost), rel=1e-9)
    half = lambda tree: jax.tree.map(
        lambda x: x.astype(jnp.float32) if eqx.is_inexact_array(x) else x, tree
    )
    single = solve(half(after), half(start))
    assert float(single.cost) == pytest.approx(float(best.cost), rel=1e-4)

    def place(shift):
        pixels = lambda p: p.factors[0].pixel
        data = eqx.tree_at(pixels, after, pixels(after) + shift)
        return solve(data, start, schedule=TIGHT).state.landmarks[-1, 2]

    shifts, size = jnp.array([0.0, 0.3]), 1e-3
    slopes = jax.vmap(jax.grad(place))(shifts)
    places = jax.vmap(place)(jnp.concatenate([shifts + size, shifts - size]))
    assert np.allclose(slopes, (places[:2] - places[2:]) / (2 * size), rtol=1e-4)


@pytest.mark.slow
def test_marginal_covariances_are_mapped_over():
    problem, _, start = make(known=True)
    states = [start, solve(problem, start, schedule=TIGHT).state]
    batch = jax.tree.map(lambda *x: jnp.stack(x), *states)
    mapped = jax.vmap(lambda s: marginals(problem, s))
    found = eqx.filter_jit(mapped, compiler_options=quick_options())(batch)
    for k, state in enumerate(states):
        alone = marginals(problem, state)
        for one, other in (
            (found.cameras, alone.cameras),
            (found.landmarks, alone.landmarks),
        ):
            size = np.abs(other).max(axis=(-2, -1), keepdims=True)
            # A point that is as good as not seen is where rounding puts it.
            known = (size > 0) & (size < 1e3)
            assert known.sum() > 5
            assert (np.abs(one[k] - other) * known <= 1e-9 * size).all()


def test_factors_that_reach_too_far_are_refused():
    class Far(CameraSmoothness):
        @property
        def keys(self):
            return ("camera", 0), ("camera", CHUNK)

        def frame_residual(self, data, window, shared):
            return (window[0].camera - window[CHUNK].camera)[:3, 3] / data[0]

    problem, state, start = make()
    far = Far(jnp.full((len(state.cameras), 2), 0.1))
    problem = g.make_problem([*problem.factors, far], state)
    with pytest.raises(ValueError, match=f"{CHUNK} frames apart.*{CHUNK - 1} at most"):
        solve(problem, start)


def test_gradient_of_a_solution_is_that_of_solving_again():
    """By pixels, and by weights: the sigmas and the scale of the loss."""
    problem, _, start = make()
    rng = np.random.default_rng(5)
    draw = lambda *shape: jnp.asarray(rng.standard_normal(shape))
    factor, along = problem.factors[0], draw(7, 3)
    toward, unequal = draw(*factor.pixel.shape), draw(*factor.sigma.shape)
    start = solve(problem, start, schedule=TIGHT).state

    def value(by):
        changed = dataclasses.replace(
            factor,
            pixel=factor.pixel + by[0] * toward,
            sigma=factor.sigma * jnp.exp(by[1] * unequal),
            loss=g.Cauchy(factor.loss.scale * jnp.exp(by[2])),
        )
        there = eqx.tree_at(lambda p: p.factors, problem, (changed,))
        # The start depends on what the derivative is taken by; the solution does not.
        near = eqx.tree_at(lambda s: s.landmarks, start, start.landmarks + by[0])
        found = solve(there, near, schedule=(Stage(rtol=1e-15, max_steps=60),))
        return jnp.sum(along * found.state.cameras[:, :3, 3])

    # Solving again is exact to 1e-8 or so, which the step must be far above.
    size, zero = 1e-2, jnp.zeros(3)
    for slope, step in zip(jax.grad(value)(zero), size * jnp.eye(3), strict=True):
        numeric = float(value(step) - value(-step)) / (2 * size)
        assert float(slope) == pytest.approx(numeric, rel=1e-3)


def test_a_linear_system_is_solved_or_its_solution_is_nan():
    rng = np.random.default_rng(0)
    n = MAX_DIRECTIONS + 10
    matrix = np.eye(n) + 0.5 * rng.standard_normal((n, n)) / np.sqrt(n)
    right = jnp.asarray(rng.standard_normal(n))
    solved = jax.jit(
        lambda a, b: gmres(lambda x, share: share * b - a @ x, b, rtol=1e-12)
    )
    found = solved(jnp.asarray(matrix), right)
    assert np.allclose(matrix @ found, right, atol=1e-9)
    assert (solved(jnp.asarray(matrix), 0 * right) == 0).all()
    # What is left by a cyclic shift falls after as many products as there are unknowns,
    # which are more than are made before starting anew.
    shift = jnp.roll(jnp.eye(n), 1, axis=0)
    assert jnp.isnan(solved(shift, jnp.eye(n)[0])).all()


@pytest.mark.parametrize(
    "case", ["no landmarks", "one observation each", "empty frame", "behind", "halves"]
)
def test_poor_data_gives_a_status_and_finite_numbers(case):
    problem, truth, start = make()
    factor = problem.factors[0]
    sigma, landmarks = factor.sigma, start.landmarks
    if case == "no landmarks":
        sigma = jnp.full_like(sigma, jnp.inf)
    elif case == "one observation each":
        first = np.unique(np.asarray(factor.landmark), return_index=True)[1]
        keep = np.zeros(len(sigma), bool)
        keep[first] = True
        sigma = jnp.where(jnp.asarray(keep), sigma, jnp.inf)
    elif case == "empty frame":
        sigma = jnp.where(factor.frame == 3, jnp.inf, sigma)
    elif case == "behind":
        landmarks = landmarks.at[:5].multiply(-1)
    else:
        early = factor.landmark < 12
        sigma = jnp.where(early == (factor.frame < 4), sigma, jnp.inf)
    problem = eqx.tree_at(lambda p: p.factors[0].sigma, problem, sigma)
    start = eqx.tree_at(lambda s: s.landmarks, start, landmarks)
    found = solve(problem, start)
    assert isinstance(found.status, str)
    assert found.cost <= problem.cost(start)
    assert all(jnp.isfinite(x).all() for x in jax.tree.leaves(found.state))


@pytest.mark.slow
def test_a_person_in_a_single_frame_and_no_landmarks():
    rng = np.random.default_rng(13)
    truth = scenes.truth(rng, 7, 1, 0)
    factors = scenes.person_factors(rng, truth)
    alone = jnp.arange(7) == 2
    hide = lambda x: jnp.where(alone.reshape(-1, *[1] * (x.ndim - 2)), x, jnp.inf)
    factors[0] = eqx.tree_at(lambda f: f.sigma, factors[0], replace_fn=hide)
    factors[2] = eqx.tree_at(lambda f: f.sigma, factors[2], replace_fn=hide)
    nothing = jnp.zeros_like(factors[1].whitening)
    factors[1] = eqx.tree_at(lambda f: f.whitening, factors[1], nothing)
    factors[2] = eqx.tree_at(lambda f: f.correlation, factors[2], jnp.zeros((1, 7)))
    problem = g.make_problem(factors, truth)
    start = scenes.perturb(rng, problem, truth)
    found = solve(problem, start)
    assert found.cost < problem.cost(start)
    assert jnp.allclose(found.state.roots[:, 3:], start.roots[:, 3:])


def test_another_size_of_state_and_what_is_not_finite_are_refused():
    problem, _, start = make()
    lost = start.cameras.at[2, :3, 3].set(jnp.nan)
    lost = eqx.tree_at(lambda s: s.cameras, start, lost)
    with pytest.raises(ValueError, match="state.cameras: 3 of 112 values are not fin"):
        solve(problem, lost)
    short = eqx.tree_at(lambda s: s.cameras, start, start.cameras[:-1])
    with pytest.raises(ValueError, match=r"shape \(6, 4, 4\), expected \(7, 4, 4\)"):
        solve(problem, short)


@pytest.mark.slow
def test_covariances_are_as_large_as_errors_on_simulated_noise(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "benchmarks")
    bench = importlib.import_module("solver_calibration")
    # A tenth of the noise that videos have: covariances are those of the linear part.
    found = bench.calibration(20, draws=60, noise=0.1)["squared"]
    for name in ("cameras, m", "people, m", "landmarks, m"):
        square, inside = found[name]
        assert abs(square - 1) < 0.15, name
        assert abs(inside - 0.95) < 0.03, name
    # Ten shapes, one scale a draw: the mean of so few is known to a tenth or so.
    assert abs(found["scale"][0] - 1) < 0.6
    assert abs(found["shape"][0] - 1) < 0.2


@pytest.mark.slow
def test_covariances_are_as_large_as_errors_among_outliers(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "benchmarks")
    bench = importlib.import_module("solver_calibration")
    found = bench.calibration(20, draws=60, noise=0.1, robust=True)
    for name in ("cameras, m", "people, m", "landmarks, m"):
        square, inside = found["inliers"][name]
        assert abs(square - 1) < 0.2, name
        assert abs(inside - 0.95) < 0.03, name
    # The Cauchy loss, for which inliers say less, takes errors to be larger.
    assert found["default"]["cameras, m"][0] < found["inliers"]["cameras, m"][0] - 0.05


def test_a_cost_that_is_not_finite_is_a_status():
    problem, _, start = make()
    lost = problem.factors[0].pixel.at[3].set(jnp.nan)
    problem = eqx.tree_at(lambda p: p.factors[0].pixel, problem, lost)
    found = solve(problem, start)
    assert found.status == "cost is not finite"
    assert jnp.array_equal(found.state.cameras, start.cameras)


def test_groups_of_variables_go_by_their_names():
    with pytest.raises(ValueError, match=r"\['camera', 'pose'\], .*'cameras'"):
        Stage(("camera", "landmarks", "pose"))
    problem, _, _ = make()
    with pytest.raises(ValueError, match="'scales'"):
        restrict(problem, ("scales",))


class Seen(eqx.Module):
    translation: jax.Array
    rotation: jax.Array
    body_pose: jax.Array


def stride(model, body, orientation, body_pose, shape, present):
    """A motion model in one line, of three frames: the more the legs swing, and the
    larger the person, the longer the step."""
    swing = body_pose[:, 0, 0] - body_pose[:, 1, 0]
    swing = swing + 0.5 * jnp.roll(swing, 2)
    step = model * jnp.stack([0 * swing, 0.01 * swing, 0.05 + 0.02 * swing], -1)
    step = step * (1 + 0.05 * shape[0])
    return Seen(step, jnp.zeros_like(step), body_pose)


@pytest.mark.slow
def test_gradient_with_people_and_a_motion_model_is_that_of_solving_again():
    problem, _, start = make(people=1)
    present = jnp.ones((1, 7), bool)
    motion = g.MotionPredictor(stride, jnp.asarray(1.0), scenes.body_model(), present)
    problem = g.make_problem(problem.factors, start, motion=motion)
    exact = (Stage(rtol=1e-15, max_steps=120),)
    start = solve(problem, start, schedule=exact).state
    toward = np.random.default_rng(6).standard_normal(problem.factors[1].pixel.shape)

    def value(size, gain):
        where = lambda p: (p.factors[1].pixel, p.motion.model)
        pixel = problem.factors[1].pixel + size * jnp.asarray(toward)
        there = eqx.tree_at(where, problem, (pixel, gain))
        found = solve(there, start, schedule=exact).state
        return found.scale + jnp.sum(found.roots[0, :, 2, 3]) + found.shapes[0, 0]

    slopes = jax.grad(value, argnums=(0, 1))(jnp.asarray(0.0), jnp.asarray(1.0))
    for which, size in ((0, 1e-2), (1, 1e-3)):
        at = lambda d: value(jnp.asarray(d[0]), jnp.asarray(d[1]))
        ahead, behind = [0.0, 1.0], [0.0, 1.0]
        ahead[which] += size
        behind[which] -= size
        numeric = (at(ahead) - at(behind)) / (2 * size)
        assert float(slopes[which]) == pytest.approx(float(numeric), rel=5e-3)


def test_a_stage_ends_where_a_step_would_gain_less_than_its_tolerance():
    """Within that of the optimum, as steps shrink fast there; and says so."""
    problem, _, start = make()
    best = solve(problem, start, schedule=TIGHT)
    found = solve(problem, start, schedule=(Stage(rtol=0.0, atol=0.05),))
    assert found.status == "converged"
    assert 0 <= found.cost - best.cost < 0.05
    assert found.num_steps[0] < best.num_steps[0]


SINGLE = lambda x: x.astype(jnp.float32)


@pytest.mark.parametrize(
    "where, change, message",
    [
        ("landmarks", SINGLE, "landmarks: found float32, expected float64 as in the p"),
        ("scale", lambda x: x.astype(jnp.float16), "scale: found float16, expected fl"),
        ("landmarks", lambda x: x[:, :2], "shape (25, 2), expected (25, 3)"),
        ("landmarks", lambda x: x[:-1], "shape (24, 3), expected (25, 3)"),
        ("intrinsics", lambda x: jnp.zeros(8), "shape (8,), expected (4,)"),
        ("intrinsics", lambda x: jnp.zeros(5), "shape (5,), expected (4,)"),
        ("poses", lambda x: jnp.zeros((2, 7, 23, 3)), "(2, 7, 23, 3), expected (0, 7"),
        ("roots", lambda x: jnp.zeros((1, 7, 4, 4)), "(1, 7, 4, 4), expected (0, 7"),
        ("cameras", jnp.zeros_like, "cameras: 7 of 7 are no rigid poses"),
        ("cameras", lambda x: x.at[1, 0, 3].set(jnp.nan), "1 of 112 values are not"),
    ],
)
def test_a_state_that_does_not_fit_its_problem_is_refused(where, change, message):
    problem, _, start = make()
    other = eqx.tree_at(lambda s: getattr(s, where), start, replace_fn=change)
    for used in (solve, marginals):
        with pytest.raises(ValueError) as refused:
            used(problem, other)
        assert message in str(refused.value) and str(refused.value).startswith("state")
        assert "\n" not in str(refused.value)


def test_people_are_refused_by_a_problem_made_for_none():
    problem, _, _ = make()
    state = scenes.truth(np.random.default_rng(0), 7, 1, 25)
    with pytest.raises(
        ValueError, match=r"roots: shape \(1, 7, 4, 4\), expected \(0, "
    ):
        solve(problem, state)


def test_a_state_is_held_against_its_problem_within_jit_by_its_shapes():
    problem, _, start = make()
    short = eqx.tree_at(lambda s: s.intrinsics, start, jnp.zeros(8))
    with pytest.raises(ValueError, match=r"shape \(8,\), expected \(4,\)"):
        jax.eval_shape(lambda s: solve(problem, s).cost, short)
    single = jax.tree.map(SINGLE, start)
    with pytest.raises(ValueError, match="found float32, expected float64"):
        jax.eval_shape(lambda s: marginals(problem, s).cameras, single)


def test_a_padded_problem_takes_its_padded_state():
    check_start(*pad(*make()[::2]))


def test_a_problem_without_factors_is_refused():
    problem, _, start = make()
    empty = dataclasses.replace(problem, factors=())
    for used in (solve, marginals):
        with pytest.raises(ValueError, match="problem.factors: found none, expected"):
            used(empty, start)


def test_a_solve_that_takes_no_step_is_refused():
    problem, _, start = make()
    for schedule in ((), (Stage(max_steps=0),)):
        for solver in ("structured", "adam"):
            with pytest.raises(ValueError, match="schedule: (no|every) stage"):
                solve(problem, start, solver=solver, schedule=schedule)


@pytest.mark.parametrize("damping", [-1.0, float("nan"), float("inf")])
def test_a_damping_that_is_none_is_refused(damping):
    problem, _, start = make()
    costs = functools.partial(trace, observe=problem.cost)
    for used in (solve, costs):
        with pytest.raises(ValueError, match=f"damping: {damping}, expected 0 or more"):
            used(problem, start, damping=damping)


def test_watched_solves_refuse_what_a_solve_refuses():
    problem, _, start = make()
    other = dataclasses.replace(start, landmarks=start.landmarks[:-1])
    used = functools.partial(trace, observe=problem.cost)
    with pytest.raises(ValueError, match="state.landmarks: shape"):
        used(problem, other)
    with pytest.raises(ValueError, match="schedule: no stage"):
        used(problem, start, schedule=())


@pytest.mark.slow
def test_derivatives_where_landmarks_or_single_coordinates_are_held():
    """Points seen once tell where a camera is if they are held, and what pulls at a
    coordinate that is held turns with the rest."""
    rng = np.random.default_rng(0)
    state = scenes.truth(rng, 3, 0, 30)
    landmark = np.arange(30)
    frame = landmark // 10
    camera = np.asarray(state.cameras)[frame]
    apart = np.asarray(state.landmarks) - camera[:, :3, 3]
    p_C = np.einsum("mji,mj->mi", camera[:, :3, :3], apart)
    factor = g.Reprojection(
        frame=jnp.asarray(frame),
        landmark=jnp.asarray(landmark),
        pixel=project(state.intrinsics, jnp.asarray(p_C))
        + jnp.asarray(rng.standard_normal((30, 2))),
        sigma=jnp.ones(30),
        loss=g.Cauchy(jnp.asarray(1.5)),
    )
    every = jax.tree.map(jnp.ones_like, state.zero_step())
    every = dataclasses.replace(every, scale=jnp.zeros(()))
    held = g.set_constant(every, "landmarks", "intrinsics")
    yaw = dataclasses.replace(held, cameras=held.cameras.at[:, 1].set(0.0))
    exact = (Stage(rtol=1e-15, max_steps=200),)
    by_map = (Stage(free=("cameras",), rtol=1e-15, max_steps=200),)
    toward = jnp.asarray(rng.standard_normal((30, 2)))
    cases = (
        (held, exact),
        (yaw, exact),
        (g.set_constant(every, "intrinsics"), by_map),
    )
    for free, schedule in cases:
        problem = g.make_problem([factor], state, free=free)
        # Of rotations of which a part is held the way there decides: a short one.
        start = solve(problem, state, schedule=schedule).state

        def value(size, problem=problem, start=start, schedule=schedule):
            pixel = factor.pixel + size * toward
            there = eqx.tree_at(lambda p: p.factors[0].pixel, problem, pixel)
            found = solve(there, start, schedule=schedule).state.cameras
            return jnp.sum(found[:, :3, 3] * jnp.arange(1.0, 10.0).reshape(3, 3))

        slope = float(jax.grad(value)(0.0))
        numeric = float(value(1e-2) - value(-1e-2)) / 2e-2
        assert slope == pytest.approx(numeric, rel=2e-3)


@pytest.mark.slow
def test_marginal_covariances_are_differentiable():
    """By standard deviations of keypoints, by those of landmarks, and by the state."""
    problem, _, start = make(people=1, known=True)
    state = solve(problem, start).state
    spread = marginals(problem, state)
    kinds, rng = (g.KeypointReprojection, g.Reprojection), np.random.default_rng(3)
    sigmas_of = lambda p: [
        next(f for f in p.factors if isinstance(f, kind)).sigma for kind in kinds
    ]
    sigmas = sigmas_of(problem)
    ways = [jnp.asarray(rng.standard_normal(sigma.shape)) for sigma in sigmas]
    move = state.zero_step()
    move = dataclasses.replace(
        move, cameras=move.cameras.at[3, 3].set(1.0), roots=move.roots + 0.1
    )

    def value(by):
        sizes = [
            jnp.where(
                jnp.isfinite(sigma),
                jnp.where(jnp.isfinite(sigma), sigma, 1.0) * jnp.exp(by[k] * way),
                jnp.inf,
            )
            for k, (sigma, way) in enumerate(zip(sigmas, ways, strict=True))
        ]
        there = eqx.tree_at(sigmas_of, problem, sizes)
        found = marginals(there, state.retract(jax.tree.map(lambda x: by[2] * x, move)))
        deviation = jnp.sqrt(jnp.trace(found.cameras[1:], axis1=1, axis2=2))
        return jnp.sum(deviation) + found.scale + jnp.sum(found.shapes)

    slopes = jax.grad(value)(jnp.zeros(3))
    assert all(jnp.isfinite(x).all() for x in jax.tree.leaves(spread))
    for slope, step in zip(slopes, 1e-5 * jnp.eye(3), strict=True):
        numeric = float(value(step) - value(-step)) / 2e-5
        assert float(slope) == pytest.approx(numeric, rel=1e-4)
