"""What the joint problem is made of, without solving it."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bodyslam_jax import graph, initialisation, motion, people
from bodyslam_jax.body import load_body_model
from bodyslam_jax.config import Config, GraphWeights
from bodyslam_jax.diagnostics import scale_uncertainty
from bodyslam_jax.pipeline import joint_problem
from bodyslam_jax.types import (
    Bodies,
    Intrinsics,
    Keypoints,
    ScaleStart,
    Sequence,
    SfmResult,
    Tracks,
)

T = 4


def _bodies() -> Bodies:
    trans = np.tile([0.0, 0.0, 4.0], (1, T, 1))
    shapes = np.zeros((1, T, 10))
    return Bodies(np.ones((1, T), bool), np.zeros((1, T, 72)), shapes, trans)


def _sequence(bodies: Bodies | None) -> Sequence:
    lens = Intrinsics(np.array([500.0, 500.0, 320.0, 240.0]), 640, 480)
    return Sequence("walk", None, np.arange(T) / 30, lens, bodies=bodies)


def _cameras() -> SfmResult:
    none = np.zeros(0, np.int64)
    return SfmResult(
        kind="moving",
        T_WC=np.tile(np.eye(4), (T, 1, 1)),
        registered=np.ones(T, bool),
        landmarks=np.zeros((0, 3)),
        tracks=Tracks(none, none, np.zeros((0, 2))),
        keep=none.astype(bool),
        prior_information=np.zeros((0, 3, 3)),
        prior_mean=np.zeros((0, 3)),
        pixel_sigma=1.0,
        intrinsics=np.array([500.0, 500.0, 320.0, 240.0]),
        focal_sigma=float("nan"),
        costs=(0.0, 0.0),
        warnings=(),
    )


@pytest.fixture
def unsolved(monkeypatch):
    """`prepare` with no valid prediction."""
    invalid = _prediction(jnp.zeros(3), jnp.zeros(T, bool))
    monkeypatch.setattr(joint_problem, "predict", lambda *_: invalid)


@pytest.mark.slow
@pytest.mark.parametrize(("fitted", "share"), [(False, 0.07), (True, 0.31)])
def test_steps_share_the_error_of_where_their_bodies_came_from(
    monkeypatch, unsolved, fitted, share
):
    errors = []

    def motion_factor(*_, shared_error, **__):
        errors.append(float(shared_error[0]))
        return _no_factor()

    def scale_start(*_, shared_error, **__):
        errors.append(shared_error)
        return ScaleStart(motion=2.0, motion_error=0.1)

    # Nothing is compiled: the error that steps share is decided before.
    monkeypatch.setattr(initialisation, "motion_factor", motion_factor)
    monkeypatch.setattr(initialisation, "scale_start", scale_start)
    monkeypatch.setattr(initialisation, "ground_contact", lambda *_: None)
    empty = functools.partial(graph.make_problem, ())
    monkeypatch.setattr(graph, "make_problem", lambda _, state, **__: empty(state))
    seen = Keypoints(np.zeros((1, T, 25, 2)), np.ones((1, T, 25)))
    sequence = dataclasses.replace(
        _sequence(None if fitted else _bodies()), keypoints=seen if fitted else None
    )
    weights = GraphWeights(step_error=0.07, fitted_step_error=0.31)
    prepared = joint_problem.prepare(
        sequence,
        _cameras(),
        _bodies(),
        load_body_model(dtype=jnp.float64),
        dataclasses.replace(Config(), weights=weights),
    )
    assert errors == [share] * 2  # first scale, joint problem
    assert float(prepared.state.scale) == pytest.approx(2)


def test_steps_of_who_is_carried_are_left_out_where_another_cue_has_the_scale(
    monkeypatch,
    unsolved,
):
    calls = []

    def motion_factor(*_, without, **__):
        calls.append(("term", list(without)))
        return _no_factor()

    def scale_start(*_, without, **__):
        calls.append(("scale", list(without)))
        return ScaleStart(motion=2.0, motion_error=0.1, **cue)

    monkeypatch.setattr(initialisation, "motion_factor", motion_factor)
    monkeypatch.setattr(initialisation, "scale_start", scale_start)
    monkeypatch.setattr(initialisation, "carried", lambda *_: {0: (1.2, 0.1)})
    monkeypatch.setattr(initialisation, "ground_contact", lambda *_: None)
    empty = functools.partial(graph.make_problem, ())
    monkeypatch.setattr(graph, "make_problem", lambda _, state, **__: empty(state))
    body = load_body_model(dtype=jnp.float64)
    prepare = lambda: joint_problem.prepare(
        _sequence(_bodies()), _cameras(), _bodies(), body, Config()
    )
    cue = {}
    assert prepare().warnings == ()
    assert calls == [("scale", []), ("term", [])]
    calls.clear()
    cue = {"ground": 3.0, "ground_error": 0.1}
    (line,) = prepare().warnings
    assert "person 0 moves at 1.2 m/s" in line
    assert calls == [("scale", []), ("scale", [0]), ("term", [0])]


def test_only_keypoints_tell_the_place_better_than_a_regressor_does():
    body = load_body_model(dtype=jnp.float64)
    given = _bodies()
    given.present[0, 1] = False
    roots = people.roots_from_bodies(given, body)
    weights = GraphWeights(root_direction=0.02, root_depth=0.1, root_correlation=0.0)
    factors = initialisation.people_factors(_sequence(given), roots, weights, body)
    (place,) = (f for f in factors if isinstance(f, graph.RootPositionPrior))
    state = initialisation.first_state(
        _cameras().T_WC, np.zeros((0, 3)), roots, _cameras().intrinsics
    )
    np.testing.assert_allclose(place.residual(state), 0, atol=1e-12)
    # 2 % of the distance to the right, 10 % farther away: one deviation each.
    x, y, z = (np.asarray(roots.T_CH[0, :, i, 3]) for i in range(3))
    moved = state.roots.at[0, :, 0, 3].add(0.02 * z + 0.1 * x)
    moved = moved.at[0, :, 1, 3].add(0.1 * y).at[0, :, 2, 3].multiply(1.1)
    state = dataclasses.replace(state, roots=moved)
    found = np.asarray(place.residual(state))[0]
    np.testing.assert_allclose(found[[0, 2, 3]], [[1.0, 0.0, 1.0]] * 3, atol=1e-9)
    np.testing.assert_allclose(found[1], 0)
    seen = Keypoints(np.zeros((1, T, 25, 2)), np.ones((1, T, 25)))
    both = dataclasses.replace(_sequence(given), keypoints=seen)
    factors = initialisation.people_factors(both, roots, weights, body)
    assert not any(isinstance(f, graph.RootPositionPrior) for f in factors)


def test_people_whom_no_keypoint_shows_stay_where_a_regressor_has_them():
    body, frames = load_body_model(dtype=jnp.float64), 50
    rows = lambda x: np.tile(x, (2, frames, 1)).astype(float)
    given = Bodies(
        np.ones((2, frames), bool),
        rows(np.zeros(72)),
        rows(np.zeros(10)),
        rows([0.0, 0.0, 4.0]),
    )
    confidence = np.zeros((2, frames, 25))
    confidence[0] = 1.0
    confidence[1, :10] = 1.0
    seen = Keypoints(np.zeros((2, frames, 25, 2)), confidence)
    sequence = dataclasses.replace(
        _sequence(given), keypoints=seen, timestamps=np.arange(frames) / 20
    )
    roots = people.roots_from_bodies(given, body)
    factors = initialisation.people_factors(sequence, roots, GraphWeights(), body)
    (place,) = (f for f in factors if isinstance(f, graph.RootPositionPrior))
    placed = np.asarray(np.isfinite(np.asarray(place.sigma)).all(axis=-1))
    # Only person 1, from a second after the last keypoint on.
    assert not placed[0].any() and not placed[1, :30].any() and placed[1, 30:].all()
    assert not np.asarray(place.correlation)[1, :31].any()


@pytest.mark.parametrize("shot", [slice(0, 3), slice(1, 4)])
def test_nothing_moves_beyond_a_cut(monkeypatch, unsolved, shot):
    located = np.zeros(T, bool)
    located[shot] = True
    T_WC = np.tile(np.eye(4), (T, 1, 1))
    T_WC[:, 0, 3] = np.clip(np.arange(T), shot.start, shot.stop - 1)
    cameras = dataclasses.replace(_cameras(), registered=located, T_WC=T_WC)
    seen = Keypoints(np.full((1, T, 25, 2), 200.0), np.ones((1, T, 25)))
    sequence = dataclasses.replace(_sequence(_bodies()), keypoints=seen)
    monkeypatch.setattr(initialisation, "motion_factor", lambda *_, **__: _no_factor())
    monkeypatch.setattr(
        initialisation, "scale_start", lambda *_, **__: ScaleStart(2.0, 0.1)
    )
    body = load_body_model(dtype=jnp.float64)
    prepared = joint_problem.prepare(sequence, cameras, _bodies(), body, Config())
    free = np.asarray(prepared.problem.free.cameras)
    assert not free[~located].any()
    # The first and one coordinate of the farthest of those that are left.
    kept = graph.gauge(prepared.state.cameras[shot])
    np.testing.assert_array_equal(free[shot], kept)
    assert free[shot].sum() == 11
    np.testing.assert_array_equal(prepared.roots.present[0], located)
    for factor in prepared.problem.factors:
        if isinstance(factor, graph.KeypointReprojection):
            assert np.isinf(np.asarray(factor.sigma)[0, ~located]).all()


def _no_factor() -> graph.CameraPrior:
    """One that says nothing."""
    return graph.CameraPrior(jnp.tile(jnp.eye(4), (T, 1, 1)), jnp.full((T, 6), jnp.inf))


def test_frames_that_are_used_are_those_of_the_shot():
    located = np.arange(T) < 2
    moving = dataclasses.replace(_cameras(), registered=located)
    assert moving.within.tolist() == [True, True, False, False]
    gap = np.array([False, True, False, True])
    between = dataclasses.replace(moving, registered=gap)
    assert between.within.tolist() == [False, True, True, True]
    for kind in ("static", "rotation"):
        turning = dataclasses.replace(moving, kind=kind)
        assert turning.within.tolist() == [True, True, False, False]
    assert dataclasses.replace(moving, kind="failed").within.all()
    lost = dataclasses.replace(moving, registered=np.zeros(T, bool))
    assert lost.within.all()


@pytest.mark.slow
def test_variances_of_fitted_shapes_are_those_of_the_untightened_prior():
    body = load_body_model(dtype=jnp.float64)
    tight, scale = 0.16 * jnp.eye(10)[None], jnp.asarray(2.0)
    inflate = lambda shapes, sigma, present: scale_uncertainty.inflate_fitted_shapes(
        jnp.asarray(0.01),
        shapes,
        scale,
        jnp.zeros((len(shapes), 10)),
        body,
        np.array(sigma),
        np.array(present),
    )
    variance, shapes = inflate(tight, [0.4], [True])
    np.testing.assert_allclose(shapes[0], np.eye(10), rtol=1e-12)
    # The leg's slope by differences.
    leg = lambda shape: float(motion.leg_length(body, jnp.asarray(shape)))
    slope = [(leg(h) - leg(-h)) / 2e-5 / leg(0 * h) for h in 1e-5 * np.eye(10)]
    more = 4 * (1 - 0.16) * np.square(slope).sum()
    np.testing.assert_allclose(variance, 0.01 + more, rtol=1e-6)
    two = jnp.concatenate([tight, tight])
    one_absent, _ = inflate(two, [0.4, 0.4], [True, False])
    np.testing.assert_allclose(one_absent, variance)
    unchanged, measured = inflate(tight, [1.0], [True])
    np.testing.assert_array_equal(measured, tight)
    np.testing.assert_array_equal(unchanged, 0.01)


@pytest.mark.slow
@pytest.mark.parametrize("pixels", [None, 5.0])
def test_keypoints_that_err_alike_count_less_but_outliers_are_as_far(pixels):
    """What a keypoint counts falls with the inflation, at which distance from the
    others it is taken for one of something else does not."""
    body = load_body_model(dtype=jnp.float64)
    roots = people.roots_from_bodies(_bodies(), body)
    seen = Keypoints(np.zeros((1, T, 25, 2)), np.ones((1, T, 25)))

    def factor(fps, inflation):
        weights = GraphWeights(keypoint_sigma=pixels, keypoint_inflation=inflation)
        sequence = dataclasses.replace(
            _sequence(_bodies()), keypoints=seen, timestamps=np.arange(T) / fps
        )
        found = initialisation.people_factors(sequence, roots, weights, body)
        (one,) = (f for f in found if isinstance(f, graph.KeypointReprojection))
        return np.asarray(one.sigma[0, 0, 10]), one.loss

    plain, loss = factor(30, 1.0)
    far = 3 * plain
    for fps, inflation in ((30, 2.5), (60, 1.0), (120, 3.0)):
        sigma, other = factor(fps, inflation)
        ratio = 1.0 if pixels else inflation * np.sqrt(fps / 30)
        np.testing.assert_allclose(sigma, ratio * plain)
        given = other.weight(jnp.asarray((far / sigma) ** 2))
        expected = loss.weight(jnp.asarray(9.0))
        np.testing.assert_allclose(given, expected, rtol=1e-9)


def test_scale_sigma_is_infinite_where_nothing_determines_metres():
    sigma = scale_uncertainty.covariance_sigma
    assert sigma(0.04, moving=True, metric=True) == pytest.approx(0.2)
    # Held at 1, the scale has no variance; that is not to know it.
    assert sigma(0.0, moving=True, metric=False) == np.inf
    assert np.isnan(sigma(0.0, moving=False, metric=False))
    assert np.isnan(sigma(np.nan, moving=True, metric=False))


def _tracked() -> SfmResult:
    """The same cameras, of which two landmarks are known, to 0.6 px."""
    frame = np.repeat(np.arange(T), 2)
    landmark = np.tile(np.arange(2), T)
    points = np.array([[0.0, 0.0, 4.0], [1.0, 0.0, 5.0]])
    uv = (500 * points[:, :2] / points[:, 2:] + [320, 240])[landmark]
    return dataclasses.replace(
        _cameras(),
        landmarks=points,
        tracks=Tracks(frame, landmark, uv),
        keep=np.arange(2 * T) > 0,
        prior_information=np.tile(np.eye(3), (2, 1, 1)),
        prior_mean=points,
        pixel_sigma=0.6,
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("weights", "expected"),
    [
        (GraphWeights(), 0.6),
        (GraphWeights(pixel_sigma=5.0), 5.0),
        (GraphWeights.paper(), 2.25 / 8),
    ],
)
def test_the_weight_of_landmarks_is_what_was_asked_for(weights, expected):
    """λ_lm of the paper is 64/b² = 12.64 px^-2; unless asked, what was measured."""
    cameras = _tracked()
    rows = lambda *shape: np.zeros((0, T, *shape))
    nobody = Bodies(np.zeros((0, T), bool), rows(72), rows(10), rows(3))
    config = dataclasses.replace(Config(), weights=weights)
    body = load_body_model(dtype=jnp.float64)
    prepared = joint_problem.prepare(_sequence(None), cameras, nobody, body, config)
    track, prior = prepared.problem.factors
    assert isinstance(track, graph.Reprojection)
    assert isinstance(prior, graph.LandmarkPrior)
    sigma = np.asarray(track.sigma)
    assert np.isinf(sigma[0])
    np.testing.assert_allclose(sigma[1:], expected)
    # What is known of places is of the same errors.
    np.testing.assert_allclose(prior.whitening[0], np.eye(3) / expected, atol=1e-12)


def test_keypoints_of_the_papers_preset_saturate_at_the_same_distance():
    """λ_joint is confidence squared, outside a loss with 100 px for every keypoint."""
    body = load_body_model(dtype=jnp.float64)
    roots = people.roots_from_bodies(_bodies(), body)
    confidence = np.linspace(0.0, 1.0, 25)
    seen = Keypoints(np.zeros((1, T, 25, 2)), np.tile(confidence, (1, T, 1)))
    sequence = dataclasses.replace(_sequence(_bodies()), keypoints=seen)
    weights = GraphWeights.paper()
    found = initialisation.people_factors(sequence, roots, weights, body)
    (factor,) = (f for f in found if isinstance(f, graph.KeypointReprojection))
    for pixels in (3.0, 100.0, 1000.0):
        cost = factor.loss.rho((pixels / factor.sigma) ** 2)
        expected = confidence**2 * 1e4 * pixels**2 / (1e4 + pixels**2)
        np.testing.assert_allclose(cost[0, 0], expected, rtol=1e-9)


def _prediction(step, valid):
    """What a motion model says that has everybody's joints turned by 0.2 rad."""
    of_one = motion.Prediction(
        translation=jnp.tile(step, (T, 1)),
        covariance=jnp.tile(1e-4 * jnp.eye(3), (T, 1, 1)),
        body_pose=jnp.full((T, 23, 3), 0.2),
        rotation=jnp.zeros((T, 3)),
        valid=valid,
    )
    return jax.tree.map(lambda x: x[None], of_one)


@pytest.mark.slow
def test_displacements_of_the_papers_preset_are_in_metres():
    body = load_body_model(dtype=jnp.float64)
    step = jnp.array([0.1, 0.0, 0.05])
    seen = _prediction(step, jnp.arange(T) > 0)
    state = initialisation.first_state(
        _cameras().T_WC,
        np.zeros((0, 3)),
        people.roots_from_bodies(_bodies(), body),
        _cameras().intrinsics,
    )
    make = lambda weights, shape: initialisation.motion_factor(
        seen, shape, body, weights
    )
    for shape in (state.shapes, state.shapes + 1.0):
        other = dataclasses.replace(state, shapes=shape)
        factor = make(GraphWeights.paper(), shape)
        # λ_mm = 100 of an error that is the whole step, as nobody moves.
        found = factor.residual(other)
        np.testing.assert_allclose(found[0, 1:], [-10 * step] * (T - 1), rtol=1e-9)
        assert ("shape", 0) not in factor.keys
    assert ("shape", 0) in make(GraphWeights(), state.shapes).keys


@pytest.mark.slow
@pytest.mark.parametrize("coupling", ["frozen", "refreshed"])
def test_postures_are_held_to_predictions_only_where_there_are_any(
    monkeypatch, unsolved, coupling
):
    """Not in the frames after a gap, in which what stands there means nothing."""
    valid = np.array([[False, False, True, False]])
    predicted = _prediction(jnp.zeros(3), jnp.asarray(valid[0]))
    monkeypatch.setattr(joint_problem, "predict", lambda *_: predicted)
    seen = Keypoints(np.full((1, T, 25, 2), 200.0), np.ones((1, T, 25)))
    sequence = dataclasses.replace(_sequence(_bodies()), keypoints=seen)
    config = dataclasses.replace(Config.paper(), motion_coupling=coupling)
    body = load_body_model(dtype=jnp.float64)
    prepared = joint_problem.prepare(sequence, _cameras(), _bodies(), body, config)
    (factor,) = (
        f for f in prepared.problem.factors if isinstance(f, graph.BodyPosePrior)
    )
    known = np.isfinite(np.asarray(factor.sigma)).all(axis=-1)
    np.testing.assert_array_equal(known, valid)
    held = prepared.problem.motion is None
    assert held == (coupling == "frozen")
    if held:  # to the prediction, which is not repeated
        np.testing.assert_allclose(factor.rotation[0, 2], 0.2)


def test_a_posture_that_may_not_be_predicted_is_not_held():
    """Where predictions are not at hand: for as long after a gap as any model needs."""
    body, frames = load_body_model(dtype=jnp.float64), 50
    rows = lambda x: np.tile(x, (1, frames, 1)).astype(float)
    given = Bodies(
        np.ones((1, frames), bool),
        rows(np.zeros(72)),
        rows(np.zeros(10)),
        rows([0.0, 0.0, 4.0]),
    )
    given.present[0, 20:24] = False
    sequence = dataclasses.replace(
        _sequence(given), timestamps=np.arange(frames) / 30.0
    )
    roots = people.roots_from_bodies(given, body)
    weights = GraphWeights.paper()
    make = lambda **known: next(
        factor
        for factor in initialisation.people_factors(
            sequence, roots, weights, body, **known
        )
        if isinstance(factor, graph.BodyPosePrior)
    )
    held = lambda factor: jnp.isfinite(factor.sigma).all(axis=-1)[0]
    known = held(make())
    assert known[16:20].all() and known[40:].all()
    assert not known[:16].any() and not known[20:40].any()
    there = jnp.arange(frames)[None] > 2
    known = held(make(predicted=there))
    np.testing.assert_array_equal(known, np.asarray(there)[0] & given.present[0])
