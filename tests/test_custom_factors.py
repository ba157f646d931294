"""Factors of one's own: frames that the solver adds weigh nothing."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

import bodyslam_jax.graph as g
from bodyslam_jax import solver
from bodyslam_jax.graph.padding import Masked

T = 7
"""Frames: the solver rounds them up to 10."""
WEIGHT = 3.0


class Position(g.FrameFactor):
    """Positions of the camera in metres, as by a satellite receiver."""

    place: Float[Array, "t 3"]
    trust: Float[Array, " t"]
    loss: g.Loss = g.Squared()
    of_people = False
    time_fields = ("place", "trust")

    @property
    def keys(self):
        return ("camera", 0), ("scale", 0)

    def data(self):
        return self.place, self.trust

    def frame_residual(self, data, window, shared):
        place, trust = data
        return (shared.scale * window[0].camera[:3, 3] - place) * self.weight(trust)

    def weight(self, trust):
        return trust


class Declared(Position):
    """Declares the value with which a frame has no weight."""

    padding = {"trust": 0.0}


class Deviation(Position):
    """Has a standard deviation, by another name than `sigma`."""

    padding = {"trust": jnp.inf}

    def weight(self, trust):
        return 1 / trust


class Precision(Position):
    """A diagonal precision, the square of a weight."""

    def weight(self, trust):
        return jnp.sqrt(trust)


class Speed(g.FrameFactor):
    """Velocities of the camera: not defined between two frames at the same time."""

    time: Float[Array, " t"]
    speed: Float[Array, "t 3"]
    loss: g.Loss = g.Squared()
    of_people = False
    time_fields = ("time", "speed")

    @property
    def keys(self):
        return ("camera", 0), ("camera", 1), ("scale", 0)

    def data(self):
        before = jnp.concatenate([self.time[:1] - 1, self.time[:-1]])
        return self.time - before, self.speed

    def frame_residual(self, data, window, shared):
        seconds, speed = data
        shift = window[0].camera[:3, 3] - window[1].camera[:3, 3]
        return shared.scale * shift / seconds - speed


def made_up():
    """A path in units of the map, with the scale alone to be found."""
    rng = np.random.default_rng(0)
    cameras = np.tile(np.eye(4), (T, 1, 1))
    cameras[:, :3, 3] = rng.standard_normal((T, 3)) + [2.0, 0.0, 0.0]
    state = g.State(
        scale=jnp.asarray(1.0),
        cameras=jnp.asarray(cameras),
        roots=jnp.zeros((0, T, 4, 4)),
        poses=jnp.zeros((0, T, 23, 3)),
        shapes=jnp.zeros((0, 10)),
        landmarks=jnp.zeros((0, 3)),
        intrinsics=jnp.array([500.0, 500.0, 320.0, 240.0]),
    )
    place = 2.7 * cameras[:, :3, 3] + 0.1 * rng.standard_normal((T, 3))
    place[-1] += 1.0  # the last one is what would be repeated
    free = jax.tree.map(jnp.zeros_like, state.zero_step())
    free = dataclasses.replace(free, scale=jnp.ones(()))
    return state, jnp.asarray(place), free


def best_scale(state, place, weight):
    path = np.asarray(state.cameras[:, :3, 3])
    weight = np.broadcast_to(weight, T)[:, None] ** 2
    return (weight * path * place).sum() / (weight * path**2).sum()


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind, trust",
    [
        (Position, WEIGHT),
        (Declared, WEIGHT),
        (Deviation, 1 / WEIGHT),
        (Precision, WEIGHT**2),
    ],
)
def test_added_frames_have_no_weight_whatever_the_name_of_a_field(kind, trust):
    state, place, free = made_up()
    factor = kind(place=place, trust=jnp.full(T, trust))
    problem = g.make_problem([factor], state, free=free)
    solution = solver.solve(problem, state)
    assert solution.status == "converged"
    expected = best_scale(state, place, WEIGHT)
    np.testing.assert_allclose(float(solution.state.scale), expected, rtol=1e-9)
    cost = float(problem.cost(solution.state))
    np.testing.assert_allclose(float(solution.cost), cost, rtol=1e-12)


def test_a_measurement_may_be_missing_where_the_factor_says_how():
    state, place, free = made_up()
    trust = jnp.full(T, 0.1).at[-1].set(jnp.inf)
    problem = g.make_problem([Deviation(place, trust)], state, free=free)
    found = float(solver.solve(problem, state).state.scale)
    weight = np.append(np.full(T - 1, 10.0), 0.0)
    np.testing.assert_allclose(found, best_scale(state, place, weight), rtol=1e-9)
    with pytest.raises(ValueError, match="If inf is a missing one, say so: `padding`"):
        g.make_problem([Position(place, trust)], state, free=free)


def test_a_problem_made_within_jit_is_the_same():
    state, place, free = made_up()

    @eqx.filter_jit
    def scale_of(state, place, trust):
        factor = Position(place, trust)
        problem = g.make_problem([factor], state, free=free)
        return solver.solve(problem, state).state.scale

    found = scale_of(state, place, jnp.full(T, WEIGHT))
    np.testing.assert_allclose(found, best_scale(state, place, WEIGHT), rtol=1e-9)


@pytest.mark.slow
def test_a_factor_is_not_evaluated_in_added_frames():
    """Values and derivatives of all that it is made of are numbers."""
    state, _, free = made_up()
    factor = Speed(jnp.arange(float(T)) / 30.0, jnp.ones((T, 3)))
    plain = factor.cost(state)
    padded = g.pad_factor(factor, state, 3)
    assert isinstance(padded, Masked)
    longer = g.extend_state(state, 3)
    cost = lambda factor, state: factor.cost(state)
    value, slope = eqx.filter_jit(eqx.filter_value_and_grad(cost))(padded, longer)
    np.testing.assert_allclose(value, plain, rtol=1e-12)
    slopes = [slope.factor.time, slope.factor.speed]
    assert all(np.isfinite(x).all() and np.any(x) for x in slopes)
    by_state = jax.grad(lambda s: padded.cost(s))(longer)
    assert np.isfinite(by_state.cameras).all() and by_state.cameras[:T].any()
    assert not by_state.cameras[T:].any()
    problem = g.make_problem([factor], state, free=free)
    assert solver.solve(problem, state).status == "converged"


class Wrong(Position):
    padding = {"trust": 1.0}


class Unknown(Position):
    padding = {"sigma": jnp.inf}


class Forgotten(Position):
    time_fields = ("place",)


@pytest.mark.parametrize(
    "kind, message",
    [
        (Wrong, r"Wrong.padding: with 2 frames more, .* the cost is .*, expected"),
        (Unknown, r"Unknown.padding: found 'sigma', expected fields among"),
        (
            Forgotten,
            r"Forgotten.time_fields: .* expected 'trust', an array over frame",
        ),
    ],
)
def test_factors_that_added_frames_would_change_are_refused(kind, message):
    state, place, free = made_up()
    with pytest.raises(ValueError, match=message) as refused:
        g.make_problem([kind(place, jnp.full(T, WEIGHT))], state, free=free)
    assert "\n" not in str(refused.value)


def test_own_factors_can_be_disabled():
    state, place, free = made_up()
    factors = [Position(place, jnp.full(T, WEIGHT)), Declared(place, jnp.ones(T))]
    problem = g.make_problem(factors, state, free=free)
    for kind, name in ((Position, "position"), (Declared, "declared")):
        muted = g.disable(problem, kind)
        assert muted.names == problem.names
        (cost,) = (f.cost(state) for f in g.disable(muted, Position).factors[:1])
        assert float(cost) == 0
        one = muted.cost_by_term(state)[name]
        assert float(one) == 0
    np.testing.assert_allclose(
        g.disable(problem, Declared).cost(state), factors[0].cost(state)
    )
