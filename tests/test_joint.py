"""What the joint problem is made of, without solving it."""

import dataclasses
import functools

import jax.numpy as jnp
import numpy as np
import pytest

from bodyslam_jax import graph, initialisation, joint, people
from bodyslam_jax.body import load_body_model
from bodyslam_jax.config import Config, GraphWeights
from bodyslam_jax.initialisation import ScaleStart
from bodyslam_jax.outcome import Cameras
from bodyslam_jax.sequence import Bodies, Intrinsics, Keypoints, Sequence, Tracks

T = 4


def _bodies() -> Bodies:
    trans = np.tile([0.0, 0.0, 4.0], (1, T, 1))
    shapes = np.zeros((1, T, 10))
    return Bodies(np.ones((1, T), bool), np.zeros((1, T, 72)), shapes, trans)


def _sequence(bodies: Bodies | None) -> Sequence:
    lens = Intrinsics(np.array([500.0, 500.0, 320.0, 240.0]), 640, 480)
    return Sequence("walk", None, np.arange(T) / 30, lens, bodies=bodies)


def _cameras() -> Cameras:
    none = np.zeros(0, np.int64)
    return Cameras(
        kind="moving",
        T_WC=np.tile(np.eye(4), (T, 1, 1)),
        registered=np.ones(T, bool),
        landmarks=np.zeros((0, 3)),
        tracks=Tracks(none, none, np.zeros((0, 2))),
        keep=none.astype(bool),
        elsewhere=np.zeros((0, 3, 3)),
        places=np.zeros((0, 3)),
        pixel_sigma=1.0,
        intrinsics=np.array([500.0, 500.0, 320.0, 240.0]),
        focal_sigma=float("nan"),
        costs=(0.0, 0.0),
        warnings=(),
    )


@pytest.mark.parametrize(("fitted", "share"), [(False, 0.07), (True, 0.31)])
def test_steps_share_the_error_of_where_their_bodies_came_from(
    monkeypatch, fitted, share
):
    told = []

    def motion_factor(*_, shared_error):
        told.append(shared_error)

    def scale_start(*_, shared_error):
        told.append(shared_error)
        return ScaleStart(motion=2.0, motion_error=0.1)

    # All that compiles is left out: what the steps are trusted to is settled before.
    monkeypatch.setattr(initialisation, "motion_factor", motion_factor)
    monkeypatch.setattr(initialisation, "scale_start", scale_start)
    monkeypatch.setattr(initialisation, "ground_contact", lambda *_: None)
    monkeypatch.setattr(initialisation, "optional_factors", lambda *_: [])
    empty = functools.partial(graph.make_problem, ())
    monkeypatch.setattr(graph, "make_problem", lambda _, state, **__: empty(state))
    monkeypatch.setattr(joint, "predict", lambda *_: None)
    monkeypatch.setattr(joint, "_settle_people", lambda _, state, __: (state, {}))
    weights = GraphWeights(step_error=0.07, fitted_step_error=0.31)
    prepared = joint.prepare(
        _sequence(None if fitted else _bodies()),
        _cameras(),
        _bodies(),
        load_body_model(dtype=jnp.float64),
        dataclasses.replace(Config(), weights=weights),
    )
    assert told == [share] * 3  # of people alone, of the first scale, of everything
    assert float(prepared.state.scale) == pytest.approx(2)


def test_only_keypoints_tell_the_place_better_than_a_regressor_does():
    body = load_body_model(dtype=jnp.float64)
    given = _bodies()
    given.present[0, 1] = False
    roots = people.roots_from_bodies(given, body)
    weights = GraphWeights(root_direction=0.02, root_depth=0.1, root_correlation=0.0)
    factors = initialisation.people_factors(_sequence(given), roots, weights, body)
    (place,) = (f for f in factors if isinstance(f, graph.RootPlace))
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
    assert not any(isinstance(f, graph.RootPlace) for f in factors)


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
        (one,) = (f for f in found if isinstance(f, graph.JointReprojection))
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
