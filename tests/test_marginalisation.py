"""The first frames as a prior: what is left has the solution of the whole."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float
from problems import dense, make, normal_equations, structured_step

import bodyslam_jax as bs
import bodyslam_jax.graph as g
from bodyslam_jax.geometry import so3
from bodyslam_jax.solver import Stage, marginalise, marginals
from bodyslam_jax.solver.padding import pad

TIGHT = (Stage(max_steps=60, rtol=1e-15, atol=1e-15),)
COUPLED = tuple(range(16))
"""Joints that `Linear` sees together; others are chains by themselves."""


class Linear(g.FrameFactor):
    """Sums of everything that is added up: `r = (A x - z) / σ`; with postures of two
    frames, without of three."""

    mixture: Float[Array, "d n"]
    measured: Float[Array, "h t d"]
    sigma: Float[Array, "h t"]
    posed: bool = eqx.field(static=True, default=False)
    padding = {"sigma": jnp.inf}

    @property
    def keys(self):
        names = ("camera", "root", *(("pose",) if self.posed else ()))
        common = ("scale", "shape", "intrinsics", "drift")
        lags = range(2 if self.posed else 3)
        return (
            *((name, lag) for name in names for lag in lags),
            *((name, 0) for name in common),
        )

    def frame_residual(self, data, window, shared):
        measured, sigma = data
        parts = [f.camera[:3, 3] for f in window] + [f.root[:3, 3] for f in window]
        if self.posed:
            parts += [f.pose[: len(COUPLED), 0] for f in window]
        parts += [shared.scale[None], shared.shape, shared.intrinsics, shared["drift"]]
        return (self.mixture @ jnp.concatenate(parts) - measured) / sigma


class Hangs(g.FrameFactor):
    """A person's axis is along gravity, a variable: `r = (C_WH^T g - e_y) / σ`."""

    sigma: Float[Array, "h t"]
    padding = {"sigma": jnp.inf}
    keys = (("camera", 0), ("root", 0), ("gravity", 0))

    def frame_residual(self, data, window, shared):
        C_WH = window[0].camera[:3, :3] @ window[0].root[:3, :3]
        return (C_WH.T @ shared["gravity"] - jnp.array([0.0, 1, 0])) / data[0]


def linear(people=2, frames=40):
    """Free is what is added up: centres, globals, turns of joints about one axis."""
    rng = np.random.default_rng(0)
    state = scenes.truth(rng, frames, people, 0)
    state = dataclasses.replace(
        state, poses=state.poses.at[..., 1:].set(0.0), globals=jnp.array([0.3, -0.2])
    )
    count = 1 + 10 + 4 + 2
    posed, other = count + 12 + 2 * len(COUPLED), count + 18
    sigma = np.full((people, frames), 0.5)
    sigma[:, :2] = np.inf
    normal = lambda *shape: jnp.asarray(rng.standard_normal(shape))
    there = jnp.ones((people, frames), bool)
    factors = [
        *(
            Linear(
                mixture=0.3 * normal(30, size),
                measured=normal(people, frames, 30),
                sigma=jnp.asarray(sigma),
                posed=size == posed,
            )
            for size in (posed, other)
        ),
        g.BodyPosePrior(
            rotation=state.poses + jnp.zeros(3).at[0].set(0.1),
            sigma=jnp.full((people, frames, 23), 0.2),
            correlation=g.ar1_correlation(there, 0.9),
        ),
        g.ShapePrior(
            shape=jnp.zeros((people, frames, 10)),
            sigma=jnp.full((people, frames, 10), jnp.inf).at[:, 0].set(1.0),
        ),
        g.IntrinsicsPrior(state.intrinsics[None], jnp.full((1, 4), 2.0)),
        g.CameraPrior(state.cameras, jnp.full((frames, 6), 3.0)),
    ]
    free = jax.tree.map(jnp.ones_like, state.zero_step())
    free = dataclasses.replace(
        free,
        cameras=free.cameras.at[:, :3].set(0.0),
        roots=free.roots.at[..., :3].set(0.0),
        poses=free.poses.at[..., 1:].set(0.0),
    )
    problem = g.make_problem(factors, state, free=free, named=(("drift", 2),))
    return problem, state


def solution(problem, state, **options):
    return bs.solve(problem, state, schedule=TIGHT, **options).state


def farthest(problem, state, other):
    """The largest free coordinate of the step from one state to another, by group."""
    step = only_free(problem, state.local(other))
    return {k: float(jnp.abs(x).max()) for k, x in vars(step).items() if x.size}


def remaining(state, left, frames):
    """What of a state is in the state that is left, and its frames as they were."""
    start = frames - g.CHUNK
    return dataclasses.replace(
        state,
        cameras=state.cameras[start:],
        roots=state.roots[:, start:],
        poses=state.poses[:, start:],
        landmarks=state.landmarks[left.landmarks],
    )


def only_free(problem, step):
    return jax.tree.map(jnp.multiply, problem.free, step)


@pytest.mark.slow
@pytest.mark.parametrize("people", [0, 2])
def test_a_linear_problem_has_the_solution_of_the_whole(people):
    problem, state = linear(people)
    if not people:
        problem = dataclasses.replace(problem, factors=problem.factors[4:])
        steady = jnp.full((40, 2), 0.5).at[:2].set(jnp.inf)
        problem = problem.with_factors(scenes.CameraSmoothness(sigma=steady))
    batch = solution(problem, state, damping=0.0)
    assert farthest(problem, state, batch)["cameras"] > 1e-3
    # Twice: the first prior goes into the second.
    once = marginalise(problem, state, 10)
    twice = marginalise(once.problem, once.state, 20)
    for left, frames in ((once, 10), (twice, 20)):
        found = solution(left.problem, left.state, damping=0.0)
        expected = remaining(batch, left, frames)
        assert max(farthest(left.problem, found, expected).values()) < 1e-9


CASES = [
    pytest.param({"known": True, "steady": True, "length": 4}, id="cameras"),
    pytest.param({"landmarks": 60, "length": 12}, id="long tracks"),
    pytest.param(
        {"people": 1, "extras": True, "free_intrinsics": True, "some_held": True},
        id="all factors",
        marks=pytest.mark.slow,
    ),
]


@pytest.mark.parametrize("options", CASES)
def test_prior_and_rest_have_the_normal_equations_of_the_whole(options):
    """Less what is gone, by dense linear algebra; and the solver steps by them."""
    problem, _, state = make(frames=20, **options)
    left = marginalise(problem, state, 10)
    whole, slope = normal_equations(*dense(problem, state))
    part, part_slope = normal_equations(*dense(left.problem, left.state))
    place = ravel_pytree(state.zero_step())[1](jnp.arange(len(slope), dtype=float))
    place = dataclasses.replace(place, landmarks=place.landmarks[left.landmarks])
    place = np.asarray(ravel_pytree(place)[0]).astype(int)
    kept = np.flatnonzero(np.diag(part) > 0)
    assert len(left.landmarks) < len(state.landmarks)
    there = place[kept]
    gone = np.setdiff1d(np.flatnonzero(np.diag(whole) > 0), there)
    assert len(gone) >= 6 * 7
    inverse = np.linalg.pinv(whole[np.ix_(gone, gone)], rcond=1e-13, hermitian=True)
    gain = whole[np.ix_(there, gone)] @ inverse
    expected = whole[np.ix_(there, there)] - gain @ whole[np.ix_(gone, there)]
    unit = 1 / np.sqrt(np.diag(expected))
    found = part[np.ix_(kept, kept)]
    np.testing.assert_allclose(np.outer(unit, unit) * (found - expected), 0, atol=1e-8)
    down = unit * (slope[there] - gain @ slope[gone])
    np.testing.assert_allclose(
        unit * part_slope[kept], down, atol=1e-7 * abs(down).max()
    )
    if options.get("extras"):
        return  # the solver's steps by such a prior are in the linear problem
    padded = pad(left.problem, left.state)
    step = structured_step(*padded, jnp.asarray(1e-3))
    cut = remaining_step(step, left.state)
    extra = np.where(np.diag(part) > 0, 1e-3 * np.diag(part), 1.0)
    best = np.linalg.solve(part + np.diag(extra), -part_slope)
    np.testing.assert_allclose(ravel_pytree(cut)[0], best, atol=1e-8 * abs(best).max())


@pytest.mark.parametrize(
    "people", [0, pytest.param(1, marks=pytest.mark.slow)], ids=["map", "person"]
)
@pytest.mark.parametrize("gauge", [True, False], ids=["held", "free"])
def test_steps_far_from_the_first_estimates_are_those_of_the_prior_s_cost(
    people, gauge
):
    problem, _, state = make(frames=20, people=people)
    given = problem if gauge else without_gauge(problem)
    left = marginalise(given, state, 10)
    assert bool(left.problem.factors[-1].invariant.all()) == (not gauge)
    rng = np.random.default_rng(0)
    away = scenes.perturb(rng, left.problem, left.state, size=0.2)
    part, slope = normal_equations(*dense(left.problem, away))
    extra = np.where(np.diag(part) > 0, 1e-3 * np.diag(part), 1.0)
    best = np.linalg.solve(part + np.diag(extra), -slope)
    step = structured_step(*pad(left.problem, away), jnp.asarray(1e-3))
    found, _ = ravel_pytree(remaining_step(step, left.state))
    np.testing.assert_allclose(found, best, atol=1e-8 * abs(best).max())


def test_predictions_that_look_back_beyond_the_past_stay_as_they_are():
    """Also in a factor that has no weight in the past."""
    problem, _, state = make(frames=20, people=1)
    left = marginalise(problem, state, 10)
    valid = jnp.ones((1, 20), bool).at[:, :15].set(False)
    predicted = {
        "translation": jnp.full((1, 20, 3), 7.0),
        "leg": jnp.ones((1, 1, 1)),
        "rotation": jnp.zeros((1, 20, 3)),
        "body_pose": jnp.zeros((1, 20, 23, 3)),
        "valid": valid,
    }
    of_motion = lambda p: p.factors[2].factor
    assert isinstance(of_motion(left.problem), g.HumanMotion)
    found = of_motion(left.problem.with_prediction(predicted)).translation
    before = of_motion(left.problem).translation
    np.testing.assert_array_equal(found[:, :15], before[:, :15])
    np.testing.assert_array_equal(found[:, 15:], 7.0)


def remaining_step(step, state):
    t, l = len(state.cameras), len(state.landmarks)
    return dataclasses.replace(
        step,
        cameras=step.cameras[:t],
        roots=step.roots[:, :t],
        poses=step.poses[:, :t],
        landmarks=step.landmarks[:l],
    )


@pytest.mark.slow
def test_linearised_near_the_solution_the_prior_leads_close_to_it():
    # Without noise: what Gauss-Newton leaves out is in proportion to residuals.
    problem, _, state = make(frames=20, landmarks=120, length=6, noise=0.0)
    plain = [dataclasses.replace(f, loss=g.Squared()) for f in problem.factors]
    problem = dataclasses.replace(problem, factors=tuple(plain))
    batch = solution(problem, state)
    away = []
    for size in (1e-3, 1e-4):
        off = scenes.perturb(np.random.default_rng(1), problem, batch, size=size)
        left = marginalise(problem, off, 10)
        expected = remaining(batch, left, 10)
        found = solution(left.problem, left.state)
        away.append(farthest(left.problem, found, expected)["cameras"])
    # What is lost is of second order.
    assert away[0] < 1e-3
    assert away[1] < 0.02 * away[0]


@pytest.mark.slow
def test_what_is_left_is_as_uncertain_as_in_the_whole():
    problem, _, state = make(frames=20, landmarks=60, people=1)
    # What keypoints bend is in covariances, and not in the prior.
    kinds = g.Reprojection, g.ShapePrior, g.HumanMotion, g.BodyPosePrior
    posed = g.RootPositionPrior(
        position=state.roots[..., :3, 3],
        sigma=jnp.full((1, 20, 2), 0.05),
        correlation=g.ar1_correlation(jnp.ones((1, 20), bool), 0.9),
    )
    turned = g.RootOrientation(
        orientation=state.roots[..., :3, :3],
        sigma=jnp.full((1, 20), 0.2),
        correlation=jnp.zeros((1, 20)),
    )
    kept = [f for f in problem.factors if isinstance(f, kinds)]
    problem = g.make_problem([*kept, posed, turned], state)
    left = marginalise(problem, state, 10)
    whole = marginals(problem, state)
    part = marginals(left.problem, left.state)
    known = {"rtol": 1e-4, "atol": 1e-6}
    np.testing.assert_allclose(part.scale, whole.scale, **known)
    np.testing.assert_allclose(part.cameras[10:], whole.cameras[10:], **known)
    np.testing.assert_allclose(part.people[:, 10:], whole.people[:, 10:], **known)
    np.testing.assert_allclose(part.shapes, whole.shapes, **known)


@pytest.mark.slow
def test_a_simulated_clip_is_solved_in_two_windows_as_it_is_whole(forget):
    """With the factors and the motion model of a run."""
    problem, state = bs.build(bs.simulate_case("M2", frames=40))
    well = (Stage(max_steps=60, rtol=1e-9),)
    forget()  # all at once they take 2.7 GB
    batch = bs.solve(problem, state, schedule=well).state
    forget()
    left = marginalise(problem, batch, 10)
    forget()
    found = bs.solve(left.problem, left.state, schedule=well).state
    away = farthest(left.problem, found, remaining(batch, left, 10))
    assert away["scale"] < 1e-5
    assert max(away["cameras"], away["roots"]) < 1e-4


def similar(state, turn=(0.4, -0.7, 0.2), shift=(3.0, -1.0, 2.0), ratio=2.5):
    """The same scene elsewhere, turned, in another unit."""
    C, shift = so3.exp(jnp.asarray(turn)), jnp.asarray(shift)
    moved = lambda r: ratio * r @ C.T + shift
    cameras = state.cameras.at[:, :3, :3].set(C @ state.cameras[:, :3, :3])
    cameras = cameras.at[:, :3, 3].set(moved(state.cameras[:, :3, 3]))
    return dataclasses.replace(
        state,
        scale=state.scale / ratio,
        cameras=cameras,
        landmarks=moved(state.landmarks),
    )


def without_gauge(problem):
    free = dataclasses.replace(
        problem.free, cameras=jnp.ones_like(problem.free.cameras)
    )
    return dataclasses.replace(problem, free=free)


@pytest.mark.parametrize(
    "people", [0, pytest.param(1, marks=pytest.mark.slow)], ids=["map", "person"]
)
def test_what_nothing_measured_the_prior_does_not(people):
    """Where the map is, how it is turned, and its unit; at any state."""
    problem, _, state = make(frames=20, people=people, landmarks=60)
    left = marginalise(without_gauge(problem), state, 10)
    prior = left.problem.factors[-1]
    rng = np.random.default_rng(0)
    there = scenes.perturb(rng, left.problem, left.state, size=0.05)
    cost = float(prior.cost(there))
    assert cost > 2 + 2 * float(prior.cost(left.state))
    assert float(prior.cost(similar(there))) == pytest.approx(cost, rel=1e-8)
    # With something that says where the map is, the prior says it, too.
    known = g.CameraPrior(cameras=state.cameras, sigma=jnp.full((20, 6), 0.1))
    held = marginalise(without_gauge(problem.with_factors(known)), state, 10)
    other = held.problem.factors[-1]
    assert float(other.cost(similar(left.state))) > 1 + float(other.cost(left.state))
    # And so it does where the first camera is held.
    first = marginalise(problem, state, 10).problem.factors[-1]
    moved = similar(left.state, turn=(0.0, 0, 0.1), shift=(0.0, 0, 0), ratio=1.0)
    assert float(first.cost(moved)) > 1 + float(first.cost(left.state))


@pytest.mark.slow
def test_gravity_turns_with_cameras_and_map():
    problem, _, state = make(frames=20, people=1)
    problem, state = problem.with_variables(
        state, gravity=bs.Variable(np.array([0.1, 0.9, -0.2]))
    )
    problem = problem.with_factors(Hangs(sigma=jnp.full((1, 20), 0.05)))
    left = marginalise(without_gauge(problem), state, 10)
    prior = left.problem.factors[-1]

    def turned(angle, with_gravity):
        turn = angle * jnp.array([0.5, -0.3, 0.8])
        moved = similar(left.state, turn=turn, shift=jnp.zeros(3), ratio=1.0)
        gravity = so3.exp(with_gravity * turn) @ left.state.globals
        return prior.residual(dataclasses.replace(moved, globals=gravity))

    along = lambda x: jnp.linalg.norm(jax.jacfwd(lambda a: turned(a, x))(0.0))
    assert along(1.0) < 1e-5 * along(0.0)


def test_a_prior_is_in_any_unit_of_the_map():
    problem, _, state = make(frames=20)
    left = marginalise(problem, state, 10)
    there = scenes.perturb(np.random.default_rng(0), left.problem, left.state)
    larger, moved = bs.rescaled(left.problem, there, 3.0)
    prior, other = left.problem.factors[-1], larger.factors[-1]
    assert float(other.cost(moved)) == pytest.approx(float(prior.cost(there)), rel=1e-9)


def test_disabled_it_has_no_cost():
    problem, _, state = make(frames=20)
    left = marginalise(problem, state, 10)
    off = g.disable(left.problem, g.MarginalPrior)
    there = scenes.perturb(np.random.default_rng(0), left.problem, left.state)
    assert left.problem.factors[-1].cost(there) > 1
    assert off.factors[-1].cost(there) == 0


@pytest.mark.slow
def test_solves_in_single_precision_and_within_jit():
    problem, _, state = make(frames=20, landmarks=120, length=6)
    batch = solution(problem, state)
    left = marginalise(problem, batch, 10)
    traced = jax.jit(lambda p, s: bs.solve(p, s, schedule=TIGHT).state)
    arrays, static = eqx.partition(left.problem, eqx.is_array)
    away = scenes.perturb(np.random.default_rng(0), left.problem, left.state, 0.003)
    found = traced_solve(traced, arrays, static, away)
    assert farthest(left.problem, found, left.state)["cameras"] < 1e-6
    low = lambda x: x.astype(np.float32) if eqx.is_inexact_array(x) else x
    single, start = jax.tree.map(low, (problem, batch))
    left = marginalise(single, start, 10)
    assert left.problem.factors[-1].root.dtype == jnp.float32
    away = jax.tree.map(low, away)
    found = bs.solve(left.problem, away).state
    assert found.cameras.dtype == jnp.float32
    expected = jax.tree.map(low, remaining(batch, left, 10))
    assert farthest(left.problem, found, expected)["cameras"] < 2e-3


def traced_solve(traced, arrays, static, state):
    return jax.jit(lambda a, s: traced.__wrapped__(eqx.combine(a, static), s))(
        arrays, state
    )


def test_old_frames_that_nothing_ties_to_the_rest_leave_a_prior_of_nothing():
    _, _, state = make(frames=20)
    known = g.CameraPrior(cameras=state.cameras, sigma=jnp.ones((20, 6)))
    problem = g.make_problem([known], state)
    left = marginalise(problem, state, 10)
    assert not left.problem.factors[-1].root.any()
    assert not left.problem.free.cameras[:10].any()
    assert left.problem.free.cameras[10:19].any()


@pytest.mark.parametrize("frames", [0, 5, 20])
def test_whole_chunks_go_and_some_frames_stay(frames):
    problem, _, state = make(frames=20)
    with pytest.raises(ValueError, match="multiple of 10 from 10 to 19"):
        marginalise(problem, state, frames)


def test_there_is_one_prior_of_no_more_frames_than_there_are():
    problem, _, state = make(frames=20)
    left = marginalise(problem, state, 10)
    prior = left.problem.factors[-1]
    with pytest.raises(ValueError, match="2 `MarginalPrior`, expected one"):
        left.problem.with_factors(prior)
    short, _, state = make(frames=7)
    with pytest.raises(ValueError, match="MarginalPrior: couples .* expected at most"):
        short.with_factors(prior)
