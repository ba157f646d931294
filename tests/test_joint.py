"""What the joint problem is made of, without solving it."""

import dataclasses
import functools

import jax.numpy as jnp
import numpy as np
import pytest

from bodyslam_jax import graph, initialisation, joint
from bodyslam_jax.body import load_body_model
from bodyslam_jax.config import Config, GraphWeights
from bodyslam_jax.initialisation import ScaleStart
from bodyslam_jax.outcome import Cameras
from bodyslam_jax.sequence import Bodies, Intrinsics, Sequence, Tracks

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
