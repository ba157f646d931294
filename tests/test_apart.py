"""Joints that no measurement ties to the rest: which they are, and their own chains."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from jax.flatten_util import ravel_pytree
from own_factors import StillFeet
from problems import make, structured_step

import bodyslam_jax.graph as g
from bodyslam_jax.body import KEYPOINT_NAMES
from bodyslam_jax.graph.keypoint_jacobian import keypoint_jacobian, turning_joints
from bodyslam_jax.solver import solve
from bodyslam_jax.solver.apart import solve_apart
from bodyslam_jax.solver.blocks import Linearisation
from bodyslam_jax.solver.padding import pad


@pytest.mark.slow
@pytest.mark.parametrize("layout", ["body25", "coco17", "halpe26"])
def test_joints_that_turn_keypoints_are_those_with_a_derivative(layout):
    rng = np.random.default_rng(0)
    body = scenes.body_model()
    pose = jnp.asarray(0.4 * rng.standard_normal((23, 3)))
    found = jax.jit(lambda w: keypoint_jacobian(body, w, jnp.zeros(10), layout, 0.7))
    by_joint = abs(np.asarray(found(pose)[1])).reshape(3, -1, 23, 3).max(axis=(0, 3))
    moved = lambda rows: tuple(np.flatnonzero(by_joint[rows].max(axis=0) > 0))
    assert turning_joints(body, layout) == moved(slice(None))
    assert len(moved(slice(None))) == {"coco17": 15}.get(layout, 19)
    for point in range(len(by_joint)):
        assert turning_joints(body, layout, (point,)) == moved([point])


def test_every_joint_turns_keypoints_where_blend_shapes_do_or_the_body_is_traced():
    body = scenes.body_model()
    blended = jnp.zeros((*body.pose_dirs.shape[:2], 207))
    bent = eqx.tree_at(lambda b: b.pose_dirs, body, blended)
    assert turning_joints(bent, "body25") == g.JOINTS
    told = []
    jax.jit(lambda body: told.append(turning_joints(body, "body25")))(body)
    assert told == [g.JOINTS]


@pytest.mark.slow
@pytest.mark.parametrize(
    "layout, without", [("coco17", ()), ("body25", g.KeypointReprojection)]
)
def test_steps_do_not_depend_on_which_joints_are_solved_apart(layout, without):
    """With fewer keypoints, and with none at all."""
    problem, state, _ = make(9, frames=12, people=2, landmarks=30)
    factors = [f for f in problem.factors if not isinstance(f, without)]
    for i, factor in enumerate(factors):
        if isinstance(factor, g.KeypointReprojection):
            count = len(KEYPOINT_NAMES[layout])
            pixel, sigma = factor.pixel[:, :, :count], factor.sigma[:, :, :count]
            parts = {"pixel": pixel, "sigma": sigma, "layout": layout}
            factors[i] = dataclasses.replace(factor, **parts)
    problem = g.make_problem(factors, state)
    assert len(problem.layout.joints) == (0 if without else 15)
    whole = dataclasses.replace(problem.layout, limbs=(g.JOINTS,))
    together = dataclasses.replace(problem, layout=whole)
    step, same = (
        structured_step(*pad(p, state), jnp.asarray(1e-3)) for p in (problem, together)
    )
    assert float(abs(step.poses).max()) > 1e-4
    one, other = ravel_pytree(step)[0], ravel_pytree(same)[0]
    assert (abs(one - other) < 1e-9 * abs(other).max()).all()


def test_chains_of_single_joints_are_solved_exactly():
    rng = np.random.default_rng(3)
    frames, joints = 37, 4
    near = lambda k: (
        rng.standard_normal((joints, frames, 3, 3, 1))
        * np.eye(frames, k=k)[None, :, None, None]
    )
    J = np.moveaxis(near(0) + near(-1), 4, 3).reshape(joints, 3 * frames, 3 * frames)
    hessian = J.swapaxes(1, 2) @ J
    tiles = hessian.reshape(joints, frames, 3, frames, 3)
    index = np.arange(frames)
    own = tiles[:, index, :, index]
    link = np.concatenate([0 * own[:1], tiles[:, index[1:], :, index[:-1]]])
    gradient, damping = rng.standard_normal((2, 1, frames, 3 * joints))
    blocks = {
        ("apart", "apart", d): jnp.asarray(x[None]) for d, x in enumerate((own, link))
    }
    none = jnp.zeros((0, 0)), jnp.zeros(0), (), jnp.zeros(0)
    lin = Linearisation(blocks, {}, {"apart": jnp.asarray(gradient)}, *none)
    step = jax.jit(lambda damping: solve_apart(lin, damping))(damping**2)
    by_joint = lambda x: x.reshape(frames, joints, 3).swapaxes(0, 1).reshape(joints, -1)
    extra = by_joint(damping**2)[:, None] * np.eye(3 * frames)
    expected = np.linalg.solve(hessian + extra, -by_joint(gradient)[..., None])
    np.testing.assert_allclose(by_joint(step), expected[..., 0], rtol=1e-9)


@pytest.mark.slow
def test_limbs_are_what_factors_see_together():
    rng = np.random.default_rng(0)
    state = scenes.truth(rng, frames=4, people=1, landmarks=8)
    factors = scenes.person_factors(rng, state)
    legs = (0, 3, 6, 9), (1, 4, 7, 10)
    *found, trunk = g.limbs_of(factors)
    assert tuple(found) == legs
    assert trunk == (2, 5, 8, *range(11, 19))
    extras = scenes.extra_factors(rng, state)
    still = [f for f in extras if isinstance(f, StillFeet)]
    assert g.limbs_of(still) == legs
    # The lower foot stands on the ground: a measurement of both.
    ground = [f for f in extras if isinstance(f, g.GroundContact)]
    assert g.limbs_of([*factors, *ground]) == (tuple(sorted(sum(legs, ()))), trunk)
    assert g.limbs_of([f for f in factors if f.per_joint]) == ()


@pytest.mark.slow
def test_factors_put_in_later_that_see_more_joints_are_refused():
    problem, _, start = make(frames=12, people=1)
    bare = [f for f in problem.factors if not isinstance(f, g.KeypointReprojection)]
    other = dataclasses.replace(g.make_problem(bare, start), factors=problem.factors)
    with pytest.raises(
        ValueError, match=r"see joints \[0, 3, 6, 9\] together.* make it anew with"
    ):
        solve(other, start)
    more = [*problem.factors, *scenes.extra_factors(np.random.default_rng(0), start)]
    other = dataclasses.replace(problem, factors=tuple(more))
    with pytest.raises(ValueError, match=r"see joints \[0, 1, 3, .* together"):
        solve(other, start)
