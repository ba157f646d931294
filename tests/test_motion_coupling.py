"""The motion model's prediction in the graph: held within a step, then made anew."""

import dataclasses
import importlib
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import optax
import pytest
import scenes
from jax.flatten_util import ravel_pytree

import bodyslam_jax.graph as g
from bodyslam_jax import motion, simulation
from bodyslam_jax.config import Simulation
from bodyslam_jax.solver import Stage, solve
from bodyslam_jax.solver.blocks import mask_of

FRAMES = 7


class Prediction(eqx.Module):
    translation: jax.Array
    rotation: jax.Array
    body_pose: jax.Array


def stride(model, body, orientation, body_pose, shape, present):
    """A motion model in one line, of three frames: who swings legs makes steps."""
    swing = body_pose[:, 0, 0] - body_pose[:, 1, 0]
    swing = swing + 0.5 * jnp.roll(swing, 2)
    step = model * jnp.stack([0 * swing, 0.01 * swing, 0.05 + 0.02 * swing], -1)
    step = step * (1 + 0.05 * shape[0])
    return Prediction(step, jnp.zeros_like(step), 0.9 * body_pose)


def make(factors=lambda found: found):
    rng = np.random.default_rng(2)
    state = scenes.truth(rng, FRAMES, 1, 25)
    found = [scenes.reprojection(rng, state), *scenes.person_factors(rng, state)]
    body, present = scenes.body_model(), jnp.ones((1, FRAMES), bool)
    predictor = g.MotionPredictor(stride, jnp.asarray(1.0), body, present)
    problem = g.make_problem(factors(found), state, motion=predictor)
    return problem, scenes.perturb(rng, problem, state)


def held_to_prediction(factors):
    """Postures against the motion model's, as in the paper."""
    change = lambda f: (
        dataclasses.replace(f, predicted=True) if isinstance(f, g.BodyPosePrior) else f
    )
    return [change(f) for f in factors]


@pytest.mark.slow
def test_no_derivative_flows_through_a_prediction():
    problem, state = make()

    def predicted(step):
        factor = problem.refresh(state.retract(step)).factors[2]
        assert isinstance(factor, g.HumanMotion)
        return jnp.sum(factor.translation)

    push = jax.grad(predicted)(state.zero_step())
    assert not ravel_pytree(push)[0].any()


@pytest.mark.slow
def test_first_order_steps_follow_what_is_predicted_anew():
    """Each by the gradient of the cost with the prediction at its place, held."""
    problem, start = make(held_to_prediction)
    count, rate = 6, 1e-2
    schedule = (Stage(max_steps=count),)
    found = solve(problem, start, solver="adam", schedule=schedule)
    mask = mask_of(problem)
    zero = start.zero_step()

    @eqx.filter_jit
    def slope(step):
        place = lambda step: start.retract(jax.tree.map(jnp.multiply, mask, step))
        now = problem.refresh(place(step))
        cost = lambda step: now.cost(place(step), held=True)
        return jax.value_and_grad(cost)(step)

    method = optax.adam(rate)
    step, memory = zero, method.init(zero)
    costs = []
    with jax.numpy_dtype_promotion("standard"):
        for _ in range(count):
            cost, gradient = slope(step)
            change, memory = method.update(gradient, memory)
            step = optax.apply_updates(step, change)
            costs.append(float(cost))
    expected = float(slope(step)[0])
    assert float(found.first_cost) == pytest.approx(costs[0], rel=1e-9)
    assert float(found.cost) == pytest.approx(expected, rel=1e-6)
    moved = start.retract(jax.tree.map(jnp.multiply, mask, step))
    np.testing.assert_allclose(found.state.poses, moved.poses, atol=1e-6)


def walk(scale):
    """A simulated walk of two seconds, measured exactly, of which only the person's
    places and postures may move; predicted by the network that ships."""
    body = scenes.body_model()
    settings = Simulation(sequence="E2", family="follow", length=60, noise="none")
    truth = simulation.as_truth(simulation.simulate(settings, body))
    poses = jnp.asarray(truth.poses).reshape(1, 60, 24, 3)
    C_WC = jnp.asarray(truth.T_WC[:, :3, :3])
    T_WH = jnp.broadcast_to(jnp.eye(4), (1, 60, 4, 4))
    T_WH = T_WH.at[..., :3, :3].set(jaxlie.SO3.exp(poses[:, :, 0]).as_matrix())
    T_WH = T_WH.at[..., :3, 3].set(jnp.asarray(truth.joints[:, :, 0]))
    away = T_WH[..., :3, 3] - jnp.asarray(truth.T_WC[:, :3, 3])
    roots = T_WH.at[..., :3, :3].set(C_WC.swapaxes(-1, -2) @ T_WH[..., :3, :3])
    roots = roots.at[..., :3, 3].set(jnp.einsum("tji,htj->hti", C_WC, away))
    state = g.State(
        scale=jnp.asarray(1.0),
        cameras=jnp.asarray(truth.T_WC),
        roots=roots,
        poses=poses[:, :, 1:],
        shapes=jnp.asarray(truth.betas),
        landmarks=jnp.zeros((0, 3)),
        intrinsics=jnp.asarray(truth.intrinsics),
    )
    factors = scenes.person_factors(np.random.default_rng(0), state, noise=0.0)
    model = motion.load_motion_model(None)
    clock = motion.make_clock(np.asarray(truth.timestamps), model.fps)
    predictor = g.MotionPredictor(
        motion.predict_between, (model, clock), body, jnp.ones((1, 60), bool)
    )
    problem = g.make_problem(factors, state, motion=predictor)
    held = g.set_constant(problem.free, "scale", "cameras", "shapes")
    wrong = eqx.tree_at(lambda s: s.scale, state, jnp.asarray(scale))
    return dataclasses.replace(problem, free=held), wrong


def bent(problem, right, wrong, monkeypatch):
    """How much longer predicted steps are by posture alone, and what the error of a
    regressor is worth, as shares."""
    folder = Path(__file__).resolve().parents[1] / "benchmarks"
    monkeypatch.syspath_prepend(str(folder))
    bench = importlib.import_module("bench_motion_coupling")
    reference = bench.predicted(problem.motion, right)
    weight = jnp.ones((1, 60, 1)).at[:, : problem.motion.model[0].past + 1].set(0.0)
    there = eqx.tree_at(lambda s: s.poses, right, wrong.poses)
    found = bench.stretch_and_error(problem.motion, there, reference, weight)
    return [float(x) for x in found]


@pytest.mark.slow
def test_postures_do_not_follow_a_wrong_scale(monkeypatch):
    """A scale that is 20 % too large asks for steps that are as much longer; postures
    must not be bent to predict them: by far less, and by less than their own error."""
    schedule = (Stage(rtol=1e-8, max_steps=300),)
    ends = []
    for scale in (1.0, 1.2):
        problem, start = walk(scale)
        ends.append(solve(problem, start, schedule=schedule).state)
    longer, error = bent(problem, *ends, monkeypatch)
    assert abs(longer) < min(error, 0.01)
