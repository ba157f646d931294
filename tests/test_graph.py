"""State, losses, factors and the door of a problem."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
import scenes
from jax.test_util import check_grads

import bodyslam_jax.graph as g
from bodyslam_jax.body import local_keypoints
from bodyslam_jax.graph._keypoint_jacobian import keypoint_jacobian


@pytest.fixture
def rng():
    return np.random.default_rng(0)


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


@pytest.mark.parametrize("loss", [g.Squared(), g.Cauchy(1.5), g.GemanMcClure(2.0)])
def test_lifted_residual_has_the_loss_as_norm_and_its_gradient(loss, rng):
    residual = jnp.asarray(3 * rng.standard_normal((7, 2)))
    rho = lambda r: jnp.sum(loss.rho(jnp.sum(r**2, axis=-1)))
    lifted = lambda r: jnp.sum(g.lift(loss, r) ** 2)
    assert jnp.allclose(lifted(residual), rho(residual), rtol=1e-12)
    assert jnp.allclose(jax.grad(lifted)(residual), jax.grad(rho)(residual))
    zero = jnp.zeros((1, 2))
    assert jnp.isfinite(jax.grad(lifted)(zero)).all()


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


def test_every_residual_has_the_derivative_of_finite_differences(rng):
    state = scenes.truth(rng, frames=4, people=1, landmarks=8)
    factors = [scenes.reprojection(rng, state), *scenes.person_factors(rng, state)]
    factors += scenes.extra_factors(rng, state)
    step = jax.tree.map(
        lambda x: jnp.asarray(rng.standard_normal(x.shape)), state.zero_step()
    )

    @jax.jit
    def residuals(size):
        moved = state.retract(jax.tree.map(lambda s: size * s, step))
        return [f.residual(moved).reshape(-1) for f in factors]

    size = 1e-6
    _, slope = jax.jvp(residuals, (0.0,), (1.0,))
    ahead, behind = residuals(size), residuals(-size)
    for factor, s, a, b in zip(factors, slope, ahead, behind, strict=True):
        numeric = (a - b) / (2 * size)
        scale = 1 + jnp.abs(numeric).max()
        assert jnp.abs(s - numeric).max() < 1e-6 * scale, type(factor).__name__
        assert jnp.abs(s).max() > 0, type(factor).__name__


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
    factor = g.Posture(
        rotation=jnp.zeros((1, t, 23, 3)),
        sigma=jnp.full((1, t, 23), 1e-3),
        correlation=g.runs(there, rho),
    )
    whitened = factor.residual(state)
    assert abs(jnp.var(whitened) - 1) < 0.01
    assert abs(jnp.mean(whitened[0, 1:] * whitened[0, :-1])) < 0.01


def test_runs_start_anew_after_a_gap():
    there = jnp.array([[True, True, False, True, True]])
    assert g.runs(there, 0.9).tolist() == [[0.0, 0.9, 0.0, 0.0, 0.9]]


def test_motion_residual_is_linear_in_scale_and_blind_to_the_world(rng):
    state = scenes.truth(rng, frames=5, people=2, landmarks=0)
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


@pytest.mark.parametrize("frames, landmarks", [(3, 5), (47, 60), (230, 400)])
def test_layout_holds_every_observation_once(rng, frames, landmarks):
    state = scenes.truth(rng, frames=frames, people=0, landmarks=landmarks)
    frame, landmark = scenes.observations(rng, state, length=25)
    layout = g.make_layout(frames, landmarks, frame, landmark)
    seen = []
    for b in layout.buckets:
        at = np.asarray(b.first_chunk)[:, None] * g.CHUNK + np.arange(b.row.shape[1])
        at = np.broadcast_to(at[:, :, None], b.row.shape)
        who = np.broadcast_to(np.asarray(b.landmark)[:, None], b.row.shape)
        row = np.asarray(b.row)
        there = row < len(frame)
        assert (frame[row[there]] == at[there]).all()
        assert (landmark[row[there]] == who[there]).all()
        assert (np.asarray(b.first_chunk) + b.width <= layout.num_chunks).all()
        seen.append(row[there])
    assert sorted(np.concatenate(seen)) == list(range(len(frame)))


def broken(problem_of, where, value):
    def make(rng):
        state = scenes.truth(rng, frames=4, people=1, landmarks=6)
        factors = [scenes.reprojection(rng, state), *scenes.person_factors(rng, state)]
        factors[problem_of] = eqx.tree_at(where, factors[problem_of], replace_fn=value)
        return factors, state

    return make


@pytest.mark.parametrize(
    "make, message",
    [
        (broken(0, lambda f: f.pixel, lambda x: x.at[0, 0].set(jnp.nan)), "not finite"),
        (broken(0, lambda f: f.frame, lambda x: x.at[0].set(99)), "0 to 3"),
        (broken(0, lambda f: f.landmark, lambda x: x.at[0].set(-1)), "0 to 5"),
        (broken(0, lambda f: f.sigma, lambda x: x.at[0].set(0.0)), "above 0"),
        (broken(1, lambda f: f.pixel, lambda x: x.at[0].set(jnp.inf)), "not finite"),
        (broken(2, lambda f: f.translation, lambda x: x[:, :3]), "expected to begin"),
    ],
)
def test_the_door_refuses(rng, make, message):
    factors, state = make(rng)
    with pytest.raises(ValueError, match=message):
        g.make_problem(factors, state)


def test_the_door_refuses_two_observations_in_one_frame(rng):
    state = scenes.truth(rng, frames=4, people=0, landmarks=6)
    factor = scenes.reprojection(rng, state)
    twice = jax.tree.map(
        lambda x: jnp.concatenate([x, x[:1]]) if jnp.ndim(x) else x, factor
    )
    with pytest.raises(ValueError, match="observed twice"):
        g.make_problem([twice], state)


def test_the_door_refuses_what_is_known_of_landmarks_that_are_not_there(rng):
    state = scenes.truth(rng, frames=4, people=0, landmarks=6)
    prior, seen = scenes.landmark_prior(rng, state), scenes.reprojection(rng, state)
    with pytest.raises(ValueError, match="3 landmarks have a prior and no"):
        g.make_problem([prior], state)
    short = jax.tree.map(lambda x: x[:5] if jnp.ndim(x) else x, prior)
    with pytest.raises(ValueError, match="5 places, expected one for each of 6"):
        g.make_problem([seen, short], state)


def test_a_problem_that_cannot_fit_says_how_many_frames_do(rng, monkeypatch):
    state = scenes.truth(rng, frames=40, people=1, landmarks=6)
    monkeypatch.setattr("os.sysconf", lambda name: 1000)
    with pytest.raises(ValueError, match="frames fit"):
        g.make_problem([scenes.reprojection(rng, state)], state)
