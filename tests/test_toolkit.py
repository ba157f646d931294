"""Programs as users of the library write them: `import bodyslam_jax as bs`, no more."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from jaxtyping import Array, Float

import bodyslam_jax as bs
from bodyslam_jax import graph
from bodyslam_jax.graph import Cauchy, Loss
from bodyslam_jax.solver.compilation import compiled

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


@compiled
def terms_of(problem, state):
    """The cost by term, in one program for all tests: one by one its operations take
    several times as long to compile."""
    return problem.cost_by_term(state)


def cost_of(problem, state):
    return sum(terms_of(problem, state).values())


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
    assert solution.cost < cost_of(problem, state)
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
    before, after = (terms_of(p, state) for p in (problem, changed))
    for name in ("human_motion", "keypoints"):
        ratio = found[name] / weights[name]
        np.testing.assert_allclose(after[name] / before[name], ratio, rtol=1e-9)
    assert after["root_smoothness"] == before["root_smoothness"] > 0


def test_a_term_has_one_name_everywhere(built):
    problem, state = built
    terms = terms_of(problem, state)
    assert problem.names == list(terms)
    assert set(bs.weights(problem)) <= set(terms)


def test_names_of_classes_are_understood_and_the_new_one_is_said(built):
    problem, state = built
    terms = terms_of(problem, state)
    with pytest.warns(DeprecationWarning, match="is called 'human_motion' now"):
        assert terms["HumanMotion"] == terms["human_motion"]
    with pytest.warns(DeprecationWarning, match="is called 'keypoints'"):
        old = bs.with_weights(problem, KeypointReprojection=0.5)
    assert float(bs.weights(old)["keypoints"]) == pytest.approx(0.5)
    with pytest.raises(KeyError, match="no term 'Nothing', expected among"):
        terms["Nothing"]
    # Costs map, stack and compare as those of a `dict`.
    doubled = jax.tree.map(lambda x: 2 * x, terms)
    assert float(doubled["shape"]) == 2 * float(terms["shape"])
    mapped = jax.vmap(lambda f: jax.tree.map(lambda x: f * x, terms))(jnp.ones(3))
    assert list(mapped) == list(terms) and mapped["shape"].shape == (3,)


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
    terms, cost = terms_of(problem, state), jax.jit(lambda s: problem.cost(s))
    np.testing.assert_allclose(sum(terms.values()), cost(state))
    of_term = lambda s: problem.cost_by_term(s)["human_motion"]
    slope = jax.jit(jax.grad(of_term))(state)
    assert np.isfinite(slope.scale) and slope.scale != 0
    cost_of = lambda lam: bs.with_weights(problem, human_motion=lam).cost(state)
    expected = terms["human_motion"] / bs.weights(problem)["human_motion"]
    found = jax.jit(jax.grad(cost_of))(2.0)
    np.testing.assert_allclose(found, expected, rtol=1e-9)


FACTORS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0)


class PathInMap(bs.FrameFactor):
    """A camera path in units of the map, which does not say so."""

    position: Float[Array, "t 3"]
    keys = (("camera", 0),)

    def frame_residual(self, data, window, shared):
        return (window[0].camera[:3, 3] - data[0]) / 0.01


class DeclaredPath(PathInMap):
    """The same with errors that are a share of the path's size, and saying so."""

    map_units = {"position": 1}

    def frame_residual(self, data, window, shared):
        length = jnp.linalg.norm(self.position.max(axis=0) - self.position.min(axis=0))
        return (window[0].camera[:3, 3] - data[0]) / (0.01 * length)


class BodySize(bs.FrameFactor):
    """A factor that sees no map at all."""

    size: Float[Array, " h"]
    keys = (("shape", 0),)

    def frame_residual(self, data, window, shared):
        return shared.shape[:1] - data[0]


class SaidScale(bs.FrameFactor):
    """Sayings of metres per unit of the map, some of them wrong."""

    metres: Float[Array, " t"]
    loss: Loss = Cauchy(jnp.array(3.0))
    keys = (("scale", 0),)
    map_units = {"metres": -1}

    def frame_residual(self, data, window, shared):
        return (shared.scale / data[0] - 1)[None] / 0.01


def in_another_unit(problem, state, factor):
    """With so many metres per unit of the map that nothing else changes."""
    problem, state = bs.rescaled(problem, state, factor)
    return problem, dataclasses.replace(state, scale=state.scale / factor)


def test_the_cost_does_not_depend_on_the_unit_of_the_map(built):
    problem, state = built
    expected = terms_of(problem, state)
    for factor in FACTORS:
        found = terms_of(*in_another_unit(problem, state, factor))
        for term, cost in expected.items():
            np.testing.assert_allclose(
                found[term], cost, rtol=1e-9, atol=1e-20, err_msg=term
            )
    assert {"ground", "landmark_prior"} <= set(expected)
    larger, start = bs.rescaled(problem, state, 2.0)
    assert cost_of(larger, start) > sum(expected.values()) + 1


@pytest.mark.slow
def test_a_batch_of_factors_is_a_batch_of_problems(built):
    problem, state = built
    problems, states = bs.rescaled(problem, state, jnp.array([0.5, 2.0]))
    assert states.landmarks.shape == (2, *state.landmarks.shape)
    one_problem, one = bs.rescaled(problem, state, 2.0)
    np.testing.assert_allclose(states.cameras[1], one.cameras)
    np.testing.assert_allclose(one.cameras[:, :3, 3], 2 * state.cameras[:, :3, 3])
    np.testing.assert_array_equal(one.roots, state.roots)
    assert one.scale == state.scale
    costs = jax.jit(jax.vmap(lambda p, s: p.cost(s)))(problems, states)
    np.testing.assert_allclose(costs[1], cost_of(one_problem, one), rtol=1e-9)


def test_a_state_alone_cannot_be_rescaled(built):
    with pytest.raises(ValueError, match=r"expected `rescaled\(problem, state, fac"):
        bs.rescaled(built[1], 2.0)
    for factor in (0.0, -1.0, np.nan, np.inf, np.array([1.0, 0.0])):
        with pytest.raises(ValueError, match="factor: found .*, expected a number ab"):
            bs.rescaled(*built, factor)


def test_factors_of_ones_own_are_rescaled_if_they_say_how(built):
    problem, state = built
    path = state.cameras[:, :3, 3]
    silent = problem.with_factors(PathInMap(path))
    with pytest.raises(ValueError, match="PathInMap changes with .* declare the power"):
        bs.rescaled(silent, state, 2.0)
    with pytest.raises(ValueError, match="PathInMap is traced.*map_units"):
        jax.jit(lambda p: bs.rescaled(p, state, 2.0)[1].scale)(silent)
    for more in ([DeclaredPath(path + 0.1)], [positions(state), BodySize(jnp.ones(1))]):
        own = problem.with_factors(*more)
        other, start = in_another_unit(own, state, 5.0)
        cost = lambda p, s: sum(f.cost(s) for f in p.factors[-len(more) :])
        np.testing.assert_allclose(cost(other, start), cost(own, state), rtol=1e-9)
        assert cost(own, state) > 0.1


def test_the_scale_is_the_same_from_maps_of_all_sizes(built, solution):
    """Section 4.2 of the paper, with the ground and the landmarks in the cost."""
    for factor in (FACTORS[0], FACTORS[2], FACTORS[-1]):
        found = bs.solve(*bs.rescaled(*built, factor))
        assert found.status == "converged"
        answer = found.state.scale * factor
        np.testing.assert_allclose(answer, solution.state.scale, rtol=1e-6)


@pytest.mark.slow
def test_the_scale_is_the_same_with_cameras_and_map_free():
    """And in the other family; `benchmarks/bench_rescaled.py` has other lengths."""
    built = bs.build(bs.simulate_case("M2", family="room", frames=60))
    factors = (0.1, 5.0)
    found = [bs.solve(*bs.rescaled(*built, factor)) for factor in factors]
    assert {x.status for x in found} == {"converged"}
    answers = [float(x.state.scale) * f for x, f in zip(found, factors, strict=True)]
    np.testing.assert_allclose(answers[0], answers[1], rtol=1e-6)


def test_of_several_scales_the_best_is_taken_from_all_starts():
    state = scenes.truth(np.random.default_rng(0), frames=20, people=1, landmarks=0)
    said = SaidScale(jnp.where(jnp.arange(20) < 8, 1.0, 2.0))
    free = dataclasses.replace(state.zero_step(), scale=jnp.ones(()))
    problem = graph.make_problem([said], state, free=free)
    answers = []
    for factor in FACTORS:
        found = bs.solve(*bs.rescaled(problem, state, factor))
        assert found.status == "converged"
        answers.append(float(found.state.scale) * factor)
    np.testing.assert_allclose(answers, answers[0], rtol=1e-6)
    # The eight others pull a little.
    np.testing.assert_allclose(answers, 2.0, rtol=2e-3)


def test_a_better_scale_that_is_known_is_said(solution):
    better = dataclasses.replace(solution, better_scale=jnp.array(1.25))
    assert better.status == "converged, but a better scale is known: 1.25"


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
def test_a_sensor_determines_the_scale_and_a_known_stature_the_shape(case, built):
    problem, state = built
    sensor = positions(state)
    assert bs.check_factor(sensor, state).residual_shape == (FRAMES, 3)

    def solved(sensor_sigma, height, height_sigma):
        """A measurement whose sigma is infinite is missing: one program for all."""
        own = positions(state, sigma=sensor_sigma)
        more = problem.with_factors(
            own, stature(case.body, state, height, sigma=height_sigma)
        )
        assert more.names[-2:] == ["camera_position", "known_stature"]
        return bs.solve(more, state)

    weights = bs.weights(problem.with_factors(sensor))
    assert weights["camera_position"] == pytest.approx(1e4)
    found = solved(0.01, 1.8, np.inf)
    assert found.status == "converged"
    assert float(found.state.scale) == pytest.approx(2.0, rel=0.01)
    scales = []
    for height in (1.65, 1.95):
        found = solved(np.inf, height, 1e-3).state
        rest = case.body.template[:, 1] + case.body.shape_dirs[:, 1] @ found.shapes[0]
        np.testing.assert_allclose(np.ptp(np.asarray(rest)), height, atol=5e-3)
        scales.append(float(found.scale))
    # Larger people in the same pixels are farther away, and the map is larger.
    assert scales[0] < scales[1]


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


@pytest.mark.parametrize("solver", ["optimistix_lm", "jaxopt_lm"])
def test_dense_solvers_refuse_large_problems_with_their_size(built, solver):
    with pytest.raises(ValueError, match=f"{solver} is for small problems.*found .*40"):
        bs.solve(*built, solver=solver)


class LateClock(bs.FrameFactor):
    """Positions of the camera by a clock that is late, m and frames."""

    position: Float[Array, "t 3"]
    sigma: Float[Array, " t"]
    keys = (("camera", 0), ("camera", 1), ("scale", 0), ("late", 0))
    map_units = {}

    def frame_residual(self, data, window, shared):
        position, sigma = data
        now, before = window[0].camera[:3, 3], window[1].camera[:3, 3]
        centre = now - shared["late"][0] * (now - before)
        return (shared.scale * centre - position) / sigma


@pytest.mark.slow
def test_run_takes_factors_and_variables(case):
    """A sensor that is right decides; one that errs makes the result doubtful."""
    T_WC = np.asarray(case.truth.T_WC)
    path = (np.linalg.inv(T_WC[0]) @ T_WC)[:, :3, 3]
    path = path - 0.5 * np.diff(path, axis=0, prepend=path[:1])
    variables = {"late": bs.Variable(0.0, sigma=1.0)}

    def found(error):
        off = error * np.random.default_rng(0).standard_normal(path.shape)
        sensor = LateClock(jnp.asarray(path + off), jnp.full(FRAMES, 0.005))
        return bs.run(
            case.sequence,
            case.config,
            factors=lambda start: [sensor] if len(start.cameras) == FRAMES else [],
            variables=variables,
        )

    result = found(0.0)
    own = result.summary["own"]
    late = own["variables"]["late"]
    assert abs(result.scale / case.map_scale - 1) < 0.01
    assert result.summary["scale"]["sigma"] < 0.01 * result.scale
    assert abs(late["value"][0] - 0.5) < 3 * late["sigma"][0] + 0.1
    assert late["given_sigma"] == [1.0]
    assert own["factors"]["late_clock"]["rms"] < 2
    assert "own_factor" not in [reason["name"] for reason in result.summary["reasons"]]
    wrong = found(0.3).summary
    assert wrong["own"]["factors"]["late_clock"]["rms"] > 3
    assert wrong["status"] == "doubtful"
    assert "own_factor" in [reason["name"] for reason in wrong["reasons"]]


@pytest.mark.slow
def test_run_names_a_variable_that_is_missing(case):
    sensor = LateClock(jnp.zeros((FRAMES, 3)), jnp.full(FRAMES, 0.01))
    with pytest.raises(ValueError, match="factors: .*'late'"):
        bs.run(case.sequence, case.config, factors=[sensor])
