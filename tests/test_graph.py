"""State, losses, factors, and where their measurements lie."""

import dataclasses
import inspect
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
import scenes
from jax.flatten_util import ravel_pytree
from jax.test_util import check_grads
from problems import bent, make

import bodyslam_jax.graph as g
from bodyslam_jax.body import local_keypoints
from bodyslam_jax.geometry import so3
from bodyslam_jax.graph.keypoint_jacobian import (
    keypoint_jacobian,
)


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.mark.slow
@pytest.mark.parametrize("angle", [0.0, 1e-9, 1.0, np.pi, 3.2])
def test_retraction_of_a_rotation_composes_and_does_not_jump(angle):
    start = angle * jnp.array([0.6, 0.0, 0.8])
    step = jnp.array([0.02, -0.03, 0.05])
    moved = jax.jit(g.retract_rotation)(start, step)
    matrix = jax.jit(lambda w: jaxlie.SO3.exp(w).as_matrix())
    assert jnp.allclose(matrix(moved), matrix(start) @ matrix(step), atol=1e-12)
    assert jnp.linalg.norm(moved - start) < 0.2  # continuous also beyond pi
    retract = jax.jit(lambda s: g.retract_rotation(start, jnp.asarray(s)))
    check_grads(retract, (step,), order=1)


@pytest.mark.parametrize("size", [0.0, 1e-6, 0.5])
def test_local_is_the_step_that_retraction_takes(size, rng):
    state = scenes.truth(rng, frames=4, people=2, landmarks=3)
    flat, unravel = ravel_pytree(state.zero_step())
    step = unravel(jnp.asarray(size * rng.standard_normal(flat.shape)))
    there_and_back = jax.jit(lambda state, step: state.local(state.retract(step)))
    found, _ = ravel_pytree(there_and_back(state, step))
    np.testing.assert_allclose(found, ravel_pytree(step)[0], atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    "loss",
    [g.Squared(), g.Cauchy(1.5), g.GemanMcClure(2.0), g.BlakeZisserman(3.5)],
)
def test_lifted_residual_has_the_loss_as_norm_and_its_gradient(loss, rng):
    residual = jnp.asarray(3 * rng.standard_normal((7, 2)))
    rho = lambda r: jnp.sum(loss.rho(jnp.sum(r**2, axis=-1)))
    lifted = lambda r: jnp.sum(g.robustify(loss, r) ** 2)
    assert jnp.allclose(lifted(residual), rho(residual), rtol=1e-12)
    assert jnp.allclose(jax.grad(lifted)(residual), jax.grad(rho)(residual))
    zero = jnp.zeros((1, 2))
    assert jnp.isfinite(jax.grad(lifted)(zero)).all()


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_blake_zisserman_ignores_outliers(dtype):
    share, area, sigma = 0.03, 160.0**2, 0.7
    c2 = 2 * np.log((1 - share) * area / (2 * np.pi * sigma**2 * share))
    loss = g.BlakeZisserman(jnp.asarray(c2**0.5, dtype))
    s = np.array([0.0, 1e-6, 1.0, 9.0, c2, 400.0, 1e12])
    likely = lambda s: (
        (1 - share) * np.exp(-s / 2) / (2 * np.pi * sigma**2) + share / area
    )
    rho, weight = loss.rho(jnp.asarray(s, dtype)), loss.weight(jnp.asarray(s, dtype))
    assert rho.dtype == weight.dtype == dtype
    rest = 2e-6 if dtype == jnp.float32 else 1e-12
    assert np.allclose(rho, 2 * np.log(likely(0.0) / likely(s)), atol=rest, rtol=rest)
    inlier = 1 - share / area / likely(s)
    assert np.allclose(weight, inlier, atol=rest)
    assert weight[4] == pytest.approx(0.5, abs=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("c", [0.3, 1.5, 4.5, 9.0])
def test_costs_of_small_errors_are_exact_in_single_precision(c):
    s = jnp.array([0, 1e-12, 1e-6, 1e-4, 0.1, 0.9999, 1.0, 1.1, 30.0, 3e38])
    single = s.astype(jnp.float32)
    loss = g.BlakeZisserman(jnp.asarray(c, jnp.float32))
    outlier, x = np.exp(-(c**2) / 2), np.asarray(s)
    large = -2 * np.log((np.exp(-x / 2) + outlier) / (1 + outlier))
    expected = np.where(x < 1e-3, x / (1 + outlier), large)
    assert np.allclose(loss.rho(single), expected, rtol=5e-5, atol=0)
    slope = jax.vmap(jax.grad(loss.rho))(single)
    assert np.allclose(slope, loss.weight(single), rtol=1e-5, atol=1e-30)


def test_keypoint_jacobian_is_that_of_the_keypoints(rng):
    body = scenes.body_model()
    pose = jnp.asarray(0.4 * rng.standard_normal((23, 3)))
    shape = jnp.asarray(rng.standard_normal(10))
    points = lambda w, b: local_keypoints(body, w, b, "body25", 0.7)
    moved = lambda s: points(g.retract_rotation(pose, s), shape)
    found = jax.jit(lambda w, b: keypoint_jacobian(body, w, b, "body25", 0.7))(
        pose, shape
    )
    by_pose = jax.jit(jax.jacfwd(moved))(jnp.zeros((23, 3)))
    assert jnp.allclose(found[0], jax.jit(points)(pose, shape), atol=1e-12)
    assert jnp.allclose(
        found[1].transpose(1, 0, 2), by_pose.reshape(25, 3, 69), atol=1e-12
    )
    by_shape = jax.jit(jax.jacfwd(points, 1))(pose, shape)
    assert jnp.allclose(found[2], by_shape, atol=1e-12)


@pytest.mark.slow
def test_curvature_of_keypoints_is_the_second_order_term(rng):
    problem, state, _ = make(people=1, frames=3, noise=15.0)
    normal = lambda *shape: jnp.asarray(rng.standard_normal(shape))
    state = state.retract(
        dataclasses.replace(
            state.zero_step(),
            roots=jnp.pad(1.5 * normal(1, 3, 3), ((0, 0), (0, 0), (0, 3))),
            poses=0.3 * normal(1, 3, 23, 3),
        )
    )
    (factor,) = [f for f in problem.factors if isinstance(f, g.KeypointReprojection)]
    weight = factor.loss.weight(jnp.sum(factor.residual(state) ** 2, axis=-1))
    assert weight.min() < 0.5
    curvature = eqx.filter_jit(lambda f, s: f.curvature(s))
    turns, by_shape = curvature(factor, state)
    exact = bent(problem, state)
    _, unravel = ravel_pytree(state.zero_step())
    place = unravel(np.arange(len(exact), dtype=float))
    shape = np.asarray(place.shapes[0], int)
    for k in range(3):
        rows = [place.roots[0, k, :3], place.poses[0, k].reshape(-1)]
        rows = np.concatenate(rows).astype(int)
        size = abs(exact[np.ix_(rows, rows)]).max()
        assert size > 1
        assert np.allclose(turns[0, k], exact[np.ix_(rows, rows)], atol=1e-10 * size)
        assert np.allclose(
            by_shape[0, k], exact[np.ix_(rows, shape)], atol=1e-10 * size
        )
    # Keypoints are linear in the shape.
    assert np.allclose(exact[np.ix_(shape, shape)], 0, atol=1e-10 * abs(exact).max())
    half = lambda tree: jax.tree.map(
        lambda x: x.astype(jnp.float32) if eqx.is_inexact_array(x) else x, tree
    )
    for single, double in zip(
        curvature(half(factor), half(state)), (turns, by_shape), strict=True
    ):
        assert single.dtype == jnp.float32
        assert np.allclose(single, double, atol=1e-4 * abs(double).max())


def every_factor(rng):
    """One factor of each class, on a state with lens distortion."""
    state = scenes.truth(rng, frames=4, people=1, landmarks=8)
    lens = jnp.array([0.1, -0.05, 0.002, -0.001])
    intrinsics = jnp.concatenate([state.intrinsics, lens])
    state = eqx.tree_at(lambda s: s.intrinsics, state, intrinsics)
    factors = [scenes.reprojection(rng, state), *scenes.person_factors(rng, state)]
    state = eqx.tree_at(lambda s: s.globals, state, jnp.array([0.3, -1.0]))
    prior = g.GlobalPrior(
        mean=jnp.array([0.1, 0.2]),
        sigma=jnp.array([0.5, 2.0]),
        name="drift",
        globals_at=(("drift", 0, 2),),
    )
    return [*factors, *scenes.extra_factors(rng, state), prior], state


def test_every_residual_has_the_derivative_of_finite_differences(rng):
    factors, state = every_factor(rng)
    classes = {
        x for x in vars(g).values() if isinstance(x, type) and issubclass(x, g.Factor)
    }
    classes = {x for x in classes if not inspect.isabstract(x)}
    classes.remove(g.MarginalPrior)  # tests/test_marginalisation.py
    assert {type(factor) for factor in factors} >= classes, "a class without a test"
    step = jax.tree.map(
        lambda x: jnp.asarray(rng.standard_normal(x.shape)), state.zero_step()
    )
    moved = lambda size: state.retract(jax.tree.map(lambda s: size * s, step))
    residuals = lambda size: [f.residual(moved(size)).reshape(-1) for f in factors]

    # One program for all: compiling is what takes the time.
    @jax.jit
    def linear(size):
        closed = [along(f, state, step) for f in factors]
        return *jax.jvp(residuals, (size,), (jnp.ones_like(size),)), closed

    size = 1e-6
    _, slope, closed = linear(0.0)
    ahead, behind = linear(size)[0], linear(-size)[0]
    for factor, s, c, a, b in zip(factors, slope, closed, ahead, behind, strict=True):
        numeric = (a - b) / (2 * size)
        scale = 1 + jnp.abs(numeric).max()
        assert jnp.abs(s - numeric).max() < 1e-6 * scale, type(factor).__name__
        assert jnp.abs(s).max() > 0, type(factor).__name__
        if c is not None:
            assert jnp.abs(s - c).max() < 1e-10 * scale, type(factor).__name__
    known = {type(f) for f, c in zip(factors, closed) if c is not None}
    assert known == {
        g.KeypointReprojection,
        g.HumanMotion,
        g.BodyPosePrior,
        g.GroundContact,
        g.FootContact,
        g.RootOrientation,
        g.AngularAccelerationPrior,
        g.RootSmoothness,
    }


def test_residuals_of_all_frames_at_once_are_those_of_each_frame(rng):
    factors, state = every_factor(rng)
    factors = [f for f in factors if isinstance(f, g.FrameFactor)]

    @jax.jit
    def both():
        each = [g.FrameFactor.residual(factor, state) for factor in factors]
        return each, [factor.residual(state) for factor in factors]

    for factor, each, found in zip(factors, *both(), strict=True):
        size = 1 + jnp.abs(each).max()
        assert jnp.abs(found - each).max() < 1e-11 * size, type(factor).__name__


def along(factor, state, step):
    """The derivative along a step by the closed form; `None` without one."""
    if not isinstance(factor, g.FrameFactor):
        return None
    found = factor.jacobians(state)
    if found is None:
        found = factor.map_frames(lambda d, w, s, _: factor.jacobian(d, w, s), state)
    if found is None:
        return None
    h, t = state.roots.shape[:2]
    total = 0.0
    for (name, lag), block in found[1].items():
        x = {
            "camera": jnp.broadcast_to(step.cameras, (h, t, 6)),
            "root": step.roots,
            "pose": step.poses if factor.per_joint else step.poses.reshape(h, t, 69),
            "scale": jnp.broadcast_to(step.scale, (h, t, 1)),
            "shape": jnp.broadcast_to(step.shapes[:, None], (h, t, 10)),
            "intrinsics": jnp.broadcast_to(step.intrinsics, (h, t, 8)),
        }[name]
        x = x[:, jnp.maximum(jnp.arange(t) - lag, 0)]
        x = jnp.expand_dims(x, tuple(range(2, block.ndim + 1 - x.ndim)))
        total = total + jnp.einsum("...dn,...n->...d", block, x)
    return total.reshape(-1)


def test_posture_residual_of_correlated_errors_is_white(rng):
    t, rho = 4000, 0.96
    error = np.zeros((t, 23, 3))
    error[0] = rng.standard_normal((23, 3))
    for k in range(1, t):
        white = rng.standard_normal((23, 3))
        error[k] = rho * error[k - 1] + np.sqrt(1 - rho**2) * white
    state = scenes.truth(rng, frames=t, people=1, landmarks=0)
    state = eqx.tree_at(lambda s: s.poses, state, 1e-3 * jnp.asarray(error)[None])
    there = jnp.ones((1, t), bool)
    factor = g.BodyPosePrior(
        rotation=jnp.zeros((1, t, 23, 3)),
        sigma=jnp.full((1, t, 23), 1e-3),
        correlation=g.ar1_correlation(there, rho),
    )
    whitened = factor.residual(state)
    assert abs(jnp.var(whitened) - 1) < 0.01
    assert abs(jnp.mean(whitened[0, 1:] * whitened[0, :-1])) < 0.01


@pytest.mark.slow
def test_a_missing_joint_does_not_affect_the_next_frame(rng):
    """Neither its placeholder nor, in derivatives, its infinite sigma does."""
    state = scenes.truth(rng, 4, 1, 2)
    factor = g.BodyPosePrior(
        rotation=state.poses + 0.1,
        sigma=jnp.full((1, 4, 23), 0.3).at[0, 1, 4].set(jnp.inf),
        correlation=g.ar1_correlation(jnp.ones((1, 4), bool), 0.9),
    )
    other = eqx.tree_at(
        lambda f: f.rotation, factor, factor.rotation.at[0, 1, 4].set(2.0)
    )
    assert other.cost(state) == factor.cost(state)
    begins = factor.residual(state)[0, 2, 4]
    error = so3.between(factor.rotation, state.poses)
    assert jnp.allclose(begins, error[0, 2, 4] / 0.3, rtol=1e-12)
    one_by_one = factor.map_frames(
        lambda d, w, s, _: factor.frame_residual(d, w, s), state
    )
    assert jnp.allclose(one_by_one, factor.residual(state), rtol=1e-12)

    def cost(correlation):
        rho = jnp.asarray(correlation)
        return dataclasses.replace(factor, correlation=rho).cost(state)

    check_grads(cost, (factor.correlation,), 1, modes=("rev",), rtol=1e-6)
    by_sigma = jax.grad(lambda x: dataclasses.replace(factor, sigma=x).cost(state))
    assert jnp.isfinite(by_sigma(factor.sigma)).all()


def test_correlation_is_zero_after_a_gap():
    there = jnp.array([[True, True, False, True, True]])
    assert g.ar1_correlation(there, 0.9).tolist() == [[0.0, 0.9, 0.0, 0.0, 0.9]]


@pytest.mark.slow
def test_motion_residual_is_linear_in_scale_and_invariant_to_the_world(rng):
    state = scenes.truth(rng, frames=4, people=1, landmarks=8)
    factor = scenes.person_factors(rng, state)[1]
    at = lambda s: factor.residual(eqx.tree_at(lambda x: x.scale, state, s))
    middle = 0.5 * (at(jnp.asarray(1.0)) + at(jnp.asarray(3.0)))
    assert jnp.allclose(at(jnp.asarray(2.0)), middle, atol=1e-12)
    turn = jaxlie.SE3.exp(jnp.array([1.0, 2, 3, 0.3, -0.5, 0.8])).as_matrix()
    moved = eqx.tree_at(lambda x: x.cameras, state, turn @ state.cameras)
    assert jnp.allclose(factor.residual(moved), factor.residual(state), atol=1e-9)


def test_gauge_holds_seven_numbers(rng):
    free = g.gauge(scenes.truth(rng).cameras)
    assert int((free == 0).sum()) == 7
    assert not free[0].any()


@pytest.mark.slow
@pytest.mark.parametrize("again", [False, True])
@pytest.mark.parametrize(
    "frames, landmarks, far", [(3, 5, 0), (47, 60, 0), (230, 400, 0), (230, 400, 20)]
)
def test_layout_holds_every_observation_once(rng, frames, landmarks, far, again):
    state = scenes.truth(rng, frames=frames, people=0, landmarks=landmarks)
    frame, landmark = scenes.observations(rng, state, 25, again, far)
    layout = g.make_layout(frames, landmarks, frame, landmark)
    seen = []
    order = layout.order
    assert (order is not None) == (again and frames > 100)
    assert layout.lasting == 24 * (far > 0)
    order = np.arange(layout.num_chunks) if order is None else np.asarray(order)
    assert sorted(order) == list(range(layout.num_chunks))
    for b in layout.buckets:
        at = np.asarray(b.first_chunk)[:, None] * g.CHUNK + np.arange(b.row.shape[1])
        at = order[at // g.CHUNK] * g.CHUNK + at % g.CHUNK
        at = np.broadcast_to(at[:, :, None], b.row.shape)
        who = np.broadcast_to(np.asarray(b.landmark)[:, None], b.row.shape)
        row = np.asarray(b.row)
        there = row < len(frame)
        assert (frame[row[there]] == at[there]).all()
        assert (landmark[row[there]] == who[there]).all()
        assert (np.asarray(b.first_chunk) + b.width <= layout.num_chunks).all()
        seen.append(row[there])
    assert sorted(np.concatenate(seen)) == list(range(len(frame)))


def test_a_loop_closure_does_not_widen_the_band(rng):
    frames, landmarks = 600, 3000
    state = scenes.truth(rng, frames=frames, people=0, landmarks=landmarks)
    seen = scenes.observations(rng, state, 25, again=True)
    for people, more in itertools.product((0, 1), (0, 20)):
        # People may be seen in more frames than landmarks are.
        layout = g.make_layout(frames + more, landmarks, *seen, people)
        assert layout.num_chunks == 60 + 4 * (more > 0)
        assert layout.bandwidth <= 10
        place = np.argsort(np.asarray(layout.order))
        apart = np.abs(np.diff(place[: 60 + more // 10]))
        assert apart.max() <= layout.reach <= 4
    # Nor do points that are seen all the time: they are eliminated last.
    seen = scenes.observations(rng, state, 25, again=True, far=30)
    layout = g.make_layout(frames, landmarks, *seen)
    assert layout.lasting == 48
    assert layout.bandwidth <= 10
    lasting = np.concatenate([b.landmark.ravel() for b in layout.buckets if b.lasting])
    assert np.isin(np.arange(landmarks - 30, landmarks), lasting).all()
    # Without, the order of time is kept, which costs nothing.
    seen = scenes.observations(rng, state, 25)
    layout = g.make_layout(frames, landmarks, *seen)
    assert layout.order is None
    assert layout.reach == 1
    assert layout.used_bandwidth <= 6
