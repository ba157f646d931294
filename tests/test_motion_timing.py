"""A model's clock over videos of other rates."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bodyslam_jax import motion
from bodyslam_jax.body import load_body_model


@pytest.mark.slow
def test_padding_at_the_end_changes_no_prediction():
    """As the solver pads: 23 frames at 24 a second, then 7 without the person."""
    model, body = motion.load_motion_model(), load_body_model(dtype=jnp.float64)
    clock = motion.make_clock(np.arange(23) / 24.0, model.fps)
    rng = np.random.default_rng(0)
    pose = jnp.asarray(0.2 * np.cumsum(rng.normal(size=(23, 23, 3)) / 5, axis=0))
    eye = jnp.tile(jnp.eye(3), (23, 1, 1))
    longer = lambda x: jnp.concatenate([x, jnp.repeat(x[-1:], 7, axis=0)])
    there = jnp.ones(23, bool)
    predict = jax.jit(
        lambda C, p, present: motion.predict_between(
            (model, clock), body, C, p, jnp.zeros(10), present
        )
    )
    wanted = predict(eye, pose, there)
    padded = jnp.concatenate([there, jnp.zeros(7, bool)])
    found = predict(longer(eye), longer(pose), padded)
    assert wanted.valid.sum() > 5
    np.testing.assert_array_equal(found.valid, np.append(wanted.valid, 7 * [False]))
    for name in ("translation", "covariance", "body_pose", "rotation"):
        a, b = getattr(wanted, name), getattr(found, name)
        np.testing.assert_allclose(b[:23][wanted.valid], a[wanted.valid], atol=1e-9)
        assert np.isfinite(b).all()


@pytest.mark.slow
@pytest.mark.parametrize("rate", [24.0, 30.0])
def test_later_predictions_do_not_depend_on_frames_that_are_cut_away(rate):
    """But for those whose window reaches back to them, which are not valid."""
    model, body = motion.load_motion_model(), load_body_model(dtype=jnp.float64)
    clock = motion.make_clock(np.arange(40) / rate, model.fps)
    rng = np.random.default_rng(0)
    pose = jnp.asarray(0.2 * np.cumsum(rng.normal(size=(40, 23, 3)) / 5, axis=0))

    def predict(clock, start):
        there = jnp.ones(40 - start, bool)
        eye = jnp.tile(jnp.eye(3), (40 - start, 1, 1))
        given = eye, pose[start:], jnp.zeros(10), there
        run = jax.jit(lambda c: motion.predict_between((model, c), body, *given))
        return run(clock)

    wanted, found = predict(clock, 0), predict(clock.from_frame(13), 13)
    valid = np.asarray(found.valid)
    assert valid[model.past + 1 :].all()
    assert not valid[:10].any()
    for name in ("translation", "covariance", "body_pose", "rotation"):
        a, b = getattr(wanted, name)[13:], getattr(found, name)
        np.testing.assert_allclose(b[valid], a[valid], atol=1e-9)
