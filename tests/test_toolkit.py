"""Programs as users of the library write them: `import bodyslam_jax as bs`, no more."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jaxtyping import Array, Float

import bodyslam_jax as bs

FRAMES = 40


@pytest.fixture(scope="module")
def case():
    return bs.simulate_case("M2", frames=FRAMES, family="follow")


@pytest.fixture(scope="module")
def built(case):
    """With cameras and landmarks held, a solve has few unknowns."""
    return bs.build(case, hold=("cameras", "landmarks"))


@pytest.fixture(scope="module")
def solution(built):
    return bs.solve(*built)


class CameraPosition(bs.FrameFactor):
    """A position sensor on the camera, m in the world of the map."""

    position: Float[Array, "t 3"]
    sigma: Float[Array, " t"]
    keys = (("camera", 0), ("scale", 0))

    def frame_residual(self, data, window, shared):
        position, sigma = data
        return (shared.scale * window[0].camera[:3, 3] - position) / sigma


class KnownStature(bs.FrameFactor):
    """Heights at rest, measured once for each person; linear in SMPL β."""

    body: bs.BodyModel
    height: Float[Array, " h"]
    sigma: Float[Array, " h"]
    keys = (("shape", 0),)

    def frame_residual(self, data, window, shared):
        height, sigma = data
        rest = self.body.template[:, 1] + self.body.shape_dirs[:, 1] @ shared.shape
        return (rest.max() - rest.min() - height)[None] / sigma


class KnownScale(bs.FrameFactor):
    """Metres per unit of the map, measured once."""

    metres: Float[Array, ""]
    sigma: Float[Array, ""]
    keys = (("scale", 0),)

    def frame_residual(self, data, window, shared):
        metres, sigma = data
        return (shared.scale - metres)[None] / sigma


def positions(state, scale=2.0, sigma=0.01):
    path = scale * state.cameras[:, :3, 3]
    return CameraPosition(path, jnp.full(len(path), sigma))


def stature(body, state, height=1.8, sigma=1e-3):
    people = len(state.shapes)
    return KnownStature(body, jnp.full(people, height), jnp.full(people, sigma))


def test_the_top_level_has_the_names_of_the_toolkit():
    names = (
        "simulate_case build solve weights with_weights rescaled vmap_over_devices "
        "evaluate stack_pairs FrameFactor check_factor run read_sequence Config Result "
        "State Problem load_body_model load_motion_model"
    ).split()
    assert set(names) <= set(bs.__all__)
    for name in set(names) - {"stack_pairs"}:
        assert callable(getattr(bs, name))


def test_a_simulated_case_is_built_and_solved(case, built, solution):
    problem, state = built
    assert solution.status == "converged"
    assert solution.cost < problem.cost(state)
    # Cameras are held: nothing but the people and the scale has moved.
    np.testing.assert_array_equal(solution.state.cameras, state.cameras)
    assert abs(float(solution.state.scale) / case.map_scale - 1) < 0.2
    errors = bs.evaluate(case.trajectories(solution.state), case.truth)
    assert float(errors["j_ate_sim3"]) < 0.3


def test_groups_to_hold_are_refused_by_name(case):
    with pytest.raises(ValueError, match=r"hold: found \('camera',\), expected .*'cam"):
        bs.build(case, hold=("camera",))


def test_weights_are_inverse_variances_by_term(built):
    problem, state = built
    weights = bs.weights(problem)
    assert {"human_motion", "keypoints", "landmarks", "body_pose", "shape"} <= {
        *weights
    }
    np.testing.assert_allclose(weights["shape"], 0.4**-2)
    np.testing.assert_allclose(weights["body_pose"], 0.2**-2)
    changed = bs.with_weights(problem, human_motion=100.0, keypoints=0.5)
    found = bs.weights(changed)
    np.testing.assert_allclose(found["human_motion"], 100.0, rtol=1e-12)
    np.testing.assert_allclose(found["keypoints"], 0.5, rtol=1e-12)
    # The cost of a term is λ times its robust loss, and other terms stay.
    before, after = (p.cost_by_term(state) for p in (problem, changed))
    terms = {"HumanMotion": "human_motion", "KeypointReprojection": "keypoints"}
    for term, name in terms.items():
        ratio = found[name] / weights[name]
        np.testing.assert_allclose(after[term] / before[term], ratio, rtol=1e-9)
    assert after["RootSmoothness"] == before["RootSmoothness"] > 0


@pytest.mark.slow
def test_weights_of_the_papers_preset_are_the_papers(case):
    weights = bs.weights(bs.build(case, bs.Config.paper())[0])
    np.testing.assert_allclose(weights["landmarks"], 64 / 2.25**2)
    np.testing.assert_allclose(weights["human_motion"], 100.0)
    np.testing.assert_allclose(weights["shape"], 1.0)
    np.testing.assert_allclose(weights["body_pose"], 1.0)


@pytest.mark.parametrize(
    "weights, message",
    [
        ({"humanmotion": 1.0}, "weights: no term 'humanmotion', expected among"),
        ({"human_motion": 0.0}, "weights.human_motion: found 0.0, expected above 0"),
        ({"human_motion": np.ones(2)}, r"weights.human_motion: shape \(2,\), expected"),
    ],
)
def test_weights_that_cannot_be_are_refused(built, weights, message):
    with pytest.raises(ValueError, match=message):
        bs.with_weights(built[0], **weights)


@pytest.mark.slow
def test_the_cost_by_term_is_a_differentiable_sum(built):
    problem, state = built
    terms = problem.cost_by_term(state)
    np.testing.assert_allclose(sum(terms.values()), problem.cost(state))
    slope = jax.grad(lambda s: problem.cost_by_term(s)["HumanMotion"])(state)
    assert np.isfinite(slope.scale) and slope.scale != 0
    cost_of = lambda lam: bs.with_weights(problem, human_motion=lam).cost(state)
    expected = terms["HumanMotion"] / bs.weights(problem)["human_motion"]
    np.testing.assert_allclose(jax.grad(cost_of)(2.0), expected, rtol=1e-9)


def test_rescaled_states_have_the_factors_as_leading_axis(built):
    problem, state = built
    factors = jnp.array([0.5, 2.0])
    several = bs.rescaled(state, factors)
    assert several.landmarks.shape == (2, *state.landmarks.shape)
    one = bs.rescaled(state, 2.0)
    np.testing.assert_allclose(several.cameras[1], one.cameras)
    np.testing.assert_allclose(one.cameras[:, :3, 3], 2 * state.cameras[:, :3, 3])
    np.testing.assert_array_equal(one.roots, state.roots)


@pytest.mark.slow
def test_a_position_sensor_determines_the_scale(built):
    problem, state = built
    factor = positions(state)
    report = bs.check_factor(factor, state)
    assert report.residual_shape == (FRAMES, 3)
    more = problem.with_factors(factor)
    assert more.names[-1] == "CameraPosition"
    assert bs.weights(more)["camera_position"] == pytest.approx(1e4)
    solution = bs.solve(more, state)
    assert solution.status == "converged"
    np.testing.assert_allclose(solution.state.scale, 2.0, rtol=0.01)


@pytest.mark.slow
def test_a_known_stature_is_counted_once(case, built):
    _, state = built
    factor = stature(case.body, state)
    report = bs.check_factor(factor, state)
    assert report.residual_shape == (1, 1, 1)
    rest = case.body.template[:, 1] + case.body.shape_dirs[:, 1] @ state.shapes[0]
    once = 0.5 * ((np.ptp(np.asarray(rest)) - 1.8) / 1e-3) ** 2
    np.testing.assert_allclose(factor.cost(state), once, rtol=1e-9)


@pytest.mark.slow
def test_a_known_stature_decides_the_shape(case, built):
    problem, state = built
    factor = stature(case.body, state)
    found = bs.solve(problem.with_factors(factor), state).state.shapes[0]
    rest = case.body.template[:, 1] + case.body.shape_dirs[:, 1] @ found
    np.testing.assert_allclose(np.ptp(np.asarray(rest)), 1.8, atol=5e-3)


@pytest.mark.slow
def test_a_factor_that_sees_a_scale_without_evidence_frees_it(built):
    problem, state = built
    shape = [f for f in problem.factors if type(f).__name__ == "ShapePrior"]
    held = dataclasses.replace(problem, factors=tuple(shape))
    held = eqx.tree_at(lambda p: p.free.scale, held, jnp.zeros(()))
    factor = KnownScale(jnp.array(3.0), jnp.array(0.1))
    assert bs.check_factor(factor, state).residual_shape == (1, 1)
    assert float(held.with_factors(factor).free.scale) == 1
    assert float(problem.with_factors(factor).free.scale) == 1


class Undeclared(CameraPosition):
    keys = (("camera", 0),)


class NotFinite(CameraPosition):
    def frame_residual(self, data, window, shared):
        position, sigma = data
        zero = (shared.scale - shared.scale) * position
        return jnp.linalg.norm(zero)[None] / sigma


class NotTraceable(CameraPosition):
    def frame_residual(self, data, window, shared):
        if data[1] > 0:
            return window[0].camera[:3, 3] * shared.scale
        return window[0].camera[:3, 3]


class NoAxis(CameraPosition):
    def frame_residual(self, data, window, shared):
        return shared.scale * window[0].camera[0, 3] - data[0][0]


class WrongPadding(CameraPosition):
    padding = {"sigma": 1.0}


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind, message",
    [
        (Undeclared, r"Undeclared.keys: found .* depends on scale; expected"),
        (NotFinite, r"NotFinite.frame_residual: .* derivatives by .* not finite"),
        (NotTraceable, r"NotTraceable.frame_residual: cannot be traced"),
        (NoAxis, r"NoAxis.frame_residual: shape \(\) for each frame, expected one"),
        (WrongPadding, r"WrongPadding.padding: with 2 frames more"),
    ],
)
def test_factors_that_the_solver_cannot_use_are_refused(built, kind, message):
    _, state = built
    good = positions(state)
    with pytest.raises(ValueError, match=message) as refused:
        bs.check_factor(kind(good.position, good.sigma), state)
    assert "\n" not in str(refused.value)


def test_shapes_that_do_not_fit_are_refused_by_name(built):
    problem, state = built
    good = positions(state)
    short = eqx.tree_at(lambda f: f.position, good, good.position[:-1])
    with pytest.raises(ValueError, match=r"CameraPosition.position: shape \(39, 3\)"):
        problem.with_factors(short)
    with pytest.raises(ValueError, match=r"CameraPosition.position: shape \(39, 3\)"):
        bs.check_factor(short, state)


@pytest.mark.slow
def test_a_prior_of_ones_own_pulls_the_optimum(built, solution):
    """A weak belief about the size of people, on each person's β_0, once."""

    class TallPeople(bs.FrameFactor):
        size: Float[Array, " h"]
        keys = (("shape", 0),)

        def frame_residual(self, data, window, shared):
            return (shared.shape[:1] - data[0]) / 0.01

    problem, state = built
    prior = TallPeople(jnp.full(len(state.shapes), 2.0))
    found = bs.solve(problem.with_factors(prior), solution.state).state
    np.testing.assert_allclose(found.shapes[:, 0], 2.0, atol=0.1)
    # Larger people in the same pixels are farther away, and the map is larger.
    assert found.scale > solution.state.scale


@pytest.mark.slow
def test_a_motion_model_of_ones_own_is_a_function_and_parameters(built):
    problem, state = built
    default = problem.motion.predict

    def shorter_steps(parameters, *of_person):
        model, factor = parameters
        found = default(model, *of_person)
        return dataclasses.replace(found, translation=factor * found.translation)

    scales = [
        float(bs.solve(other, state).state.scale)
        for factor in (1.0, 1.5)
        for other in [
            problem.with_motion_model(
                shorter_steps, (problem.motion.model, jnp.asarray(factor))
            )
        ]
    ]
    assert scales[1] > 1.02 * scales[0]


def test_a_state_is_saved_and_loaded(solution, tmp_path):
    state = solution.state
    np.savez(tmp_path / "state.npz", **vars(state))
    with np.load(tmp_path / "state.npz") as archive:
        again = bs.State(**{name: jnp.asarray(archive[name]) for name in archive})
    assert eqx.tree_equal(again, state)
    eqx.tree_serialise_leaves(tmp_path / "state.eqx", state)
    assert eqx.tree_equal(
        eqx.tree_deserialise_leaves(tmp_path / "state.eqx", state), state
    )


@pytest.mark.slow
def test_optax_lowers_the_raw_cost(built):
    problem, state = built
    with jax.numpy_dtype_promotion("standard"):
        method = optax.adam(1e-3)
        step, memory = state.zero_step(), method.init(state.zero_step())

        @jax.jit
        def descend(step, memory):
            cost = lambda x: problem.cost(
                state.retract(jax.tree.map(jnp.multiply, x, problem.free))
            )
            value, slope = jax.value_and_grad(cost)(step)
            change, memory = method.update(slope, memory)
            return optax.apply_updates(step, change), memory, value

        costs = []
        for _ in range(20):
            step, memory, cost = descend(step, memory)
            costs.append(float(cost))
    assert costs[-1] < costs[0]


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["adam", "structured"])
def test_solvers_are_selected_by_name(built, solver):
    problem, state = built
    solution = bs.solve(problem, state, solver=solver)
    assert solution.cost < problem.cost(state)


@pytest.mark.parametrize("solver", ["optimistix_lm", "jaxopt_lm"])
def test_dense_solvers_refuse_large_problems_with_their_size(built, solver):
    with pytest.raises(ValueError, match=f"{solver} is for small problems.*found .*40"):
        bs.solve(*built, solver=solver)
