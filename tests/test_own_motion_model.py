"""A motion model of the user's own: function and parameters, trained and in a graph."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from test_motion_data import make_clip

from bodyslam_jax import graph, motion
from bodyslam_jax.config import GraphWeights, MotionTraining
from bodyslam_jax.initialisation import motion_factor

SETTINGS = MotionTraining(
    past=1,
    epochs=3, segments=16, steps=4, learning_rate=0.02, decay=False, averaging=0.0,
    drift_deg=0.0, white_deg=0.0, mirror=False, strides=(4,), run_weight=1.0,
)  # fmt: skip


def stride(parameters, window):
    """Constant displacement, and a share of how the ankles move back."""
    ankles = window.joints[:, jnp.array([7, 8])].mean(axis=1)
    back = window.leg * (ankles[-2] - ankles[-1])
    step = parameters["mean"] + parameters["share"] * back
    return step, jnp.exp(parameters["log_sigma"])


def own(body, **changes):
    parameters = {"mean": np.zeros(3), "share": 0.0, "log_sigma": -2.0} | changes
    return motion.make_motion_model(stride, parameters, body=body)


@pytest.mark.slow
def test_parameters_are_trained():
    body = scenes.body_model()
    clips = [make_clip(t, seed=t) for t in (40, 50)]
    held_out = [make_clip(40, seed=3, subject="b")]
    network = own(body).network
    model, history = motion.train(
        clips, body, SETTINGS, validation=held_out, network=network
    )
    assert history[-1, 0] < history[0, 0]
    assert any(np.asarray(x).any() for x in model.network.parameters["mean"])
    assert model.past == 1 and float(model.network.spread) != 1
    with pytest.raises(ValueError, match="network of class FunctionNetwork"):
        motion.save_motion_model("own.npz", model)


@pytest.mark.slow
def test_the_scale_follows_predicted_displacements():
    body = scenes.body_model()
    state = scenes.truth(np.random.default_rng(0), frames=6, landmarks=8)
    present = jnp.ones((1, 6), bool)
    model = own(body, mean=np.array([0.0, 0.0, 0.05]), share=0.5)
    predictor = graph.MotionPredictor(motion.predict, model, body, present)
    prediction = predictor(state)
    assert prediction.valid[0].tolist() == [False] + 5 * [True]
    expected = np.broadcast_to(np.exp(-4.0) * np.eye(3), (5, 3, 3))
    np.testing.assert_allclose(prediction.covariance[0, 1:], expected, rtol=1e-6)
    weights = GraphWeights(motion_in_legs=False)
    factor = motion_factor(prediction, state.shapes, body, weights)
    problem = graph.make_problem([factor], state, motion=predictor)
    before = problem.refresh(state).factors[0].translation

    def steps(gain):
        """Predictions with all parameters multiplied."""
        network = jax.tree.map(lambda x: gain * x, model.network.parameters)
        parts = dataclasses.replace(model.network, parameters=network)
        changed = dataclasses.replace(model, network=parts)
        other = dataclasses.replace(predictor, model=changed)
        moved = dataclasses.replace(problem, motion=other).refresh(state)
        return moved.factors[0].translation

    np.testing.assert_allclose(steps(2.0), 2 * before, atol=1e-6)
    slope = jax.jacfwd(steps)(1.0)
    np.testing.assert_allclose(slope, before, atol=1e-6)


@pytest.mark.parametrize(
    "step, parameters, message",
    [
        (stride, {"mean": "a"}, r"parameters\['mean'\]: found 'a', expected a float"),
        (lambda p, w: (p, 0.1), np.zeros(2), r"shape \(2,\), expected \(3,\)"),
        (lambda p, w: p, np.zeros(3), "shape None, expected"),
    ],
)
def test_a_function_that_does_not_fit_is_refused(step, parameters, message):
    with pytest.raises(ValueError, match=message) as refused:
        motion.make_motion_model(step, parameters, body=scenes.body_model())
    assert "\n" not in str(refused.value)
