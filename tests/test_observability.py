"""What the measurements do not determine is named, and nothing else."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from jax.flatten_util import ravel_pytree
from problems import dense, make

import bodyslam_jax.graph as g
from bodyslam_jax.solver import Marginals, marginals, observability, solve


def known(state, **parts):
    """Everything known to a millimetre, but for `parts`."""
    place = lambda x: 1e-6 * jnp.broadcast_to(jnp.eye(3), (*x.shape[:-1], 3, 3))
    h = len(state.roots)
    exact = Marginals(
        scale=jnp.asarray(1e-6),
        cameras=place(state.cameras[:, 0]),
        people=place(state.roots[:, :, 0]),
        intrinsics=1e-6 * jnp.eye(len(state.intrinsics)),
        globals=1e-6 * jnp.eye(len(state.globals)),
        shapes=jnp.zeros((h, 10, 10)),
        landmarks=place(state.landmarks),
    )
    return Marginals(**{**vars(exact), **parts})


def seen_exactly(problem, state):
    """The same pairs of frame and landmark, where this state would see them."""
    factor = problem.factors[0]
    pixel = factor.pixel + factor.residual(state) * factor.sigma[:, None]
    return eqx.tree_at(lambda f: f.pixel, factor, pixel)


@pytest.mark.slow
@pytest.mark.parametrize("size", [True, False])
def test_a_moving_camera_leaves_nothing_unknown_but_its_unit(size):
    problem, truth, _ = make(noise=0.0, known=size)
    report = observability(problem, truth, marginals(problem, truth))
    assert report[0] == "landmarks: 3 are not observed."
    unit = ("size of the map: nothing tells it, and one camera shows none.",)
    once = ("depth of 1 landmarks: seen from one place.",)
    assert report[1:] == (once if size else unit)


def test_turning_on_the_spot_is_reported():
    problem, truth, _ = make(noise=0.0)
    still = truth.cameras.at[:, :3, 3].multiply(1e-9)
    state = eqx.tree_at(lambda s: s.cameras, truth, still)
    problem = g.make_problem([seen_exactly(problem, state)], state)
    found = solve(problem, state)
    assert all(jnp.isfinite(x).all() for x in jax.tree.leaves(found.state))
    report = observability(problem, state, marginals(problem, state))
    depth = [line for line in report if line.startswith("depth of")]
    assert depth and depth[0].endswith("the camera turns but does not move."), report


def test_parts_without_a_landmark_in_common_are_reported():
    problem, truth, _ = make(noise=0.0)
    factor = problem.factors[0]
    apart = (factor.landmark < 12) == (factor.frame < 4)
    sigma = jnp.where(apart, factor.sigma, jnp.inf)
    problem = eqx.tree_at(lambda p: p.factors[0].sigma, problem, sigma)
    report = observability(problem, truth, known(truth))
    assert report[0] == (
        "one map: 2 parts of the video share no landmark, from frames 4 on."
    )


@pytest.mark.parametrize("turns", [False, True])
def test_focal_length_of_fronto_parallel_motion_is_reported(turns):
    """All nearer and a shorter focal length look the same, unless the camera turns."""
    rng = np.random.default_rng(0)
    truth = scenes.truth(rng, 7, 0, 25)
    cameras = np.array(truth.cameras)
    cameras[:, :2, 3] = 0.1 * rng.standard_normal((7, 2))
    cameras[:, 2, 3] = 0.0
    for i in range(7):
        cameras[i, :3, :3] = scenes.look(0.1 * i - 0.3 if turns else 0.0, 0.0)
    truth = eqx.tree_at(lambda s: s.cameras, truth, jnp.asarray(cameras))
    prior = g.IntrinsicsPrior(
        intrinsics=truth.intrinsics[None],
        sigma=jnp.array([[60.0, 60.0, 1e-3, 1e-3]]),
    )
    factors = [scenes.reprojection(rng, truth, 0.0), prior]
    factors += [g.AspectRatioPrior(sigma=jnp.array([1e-3]))]
    problem = g.make_problem(factors, truth, free_intrinsics=True)
    jacobian, _ = dense(problem, truth)
    normal = jacobian.T @ jacobian + 1e-9 * np.eye(jacobian.shape[1])
    index, _ = ravel_pytree(
        eqx.tree_at(
            lambda s: s.intrinsics, truth.zero_step(), jnp.array([1.0, 2, 3, 4])
        )
    )
    at = np.argsort(np.asarray(index))[-4:]
    block = jnp.asarray(np.linalg.inv(normal)[np.ix_(at, at)])
    report = observability(problem, truth, known(truth, intrinsics=block))
    lines = [line for line in report if line.startswith("focal length")]
    if turns:
        assert not lines, report
    else:
        # A tenth for rows and columns each, which are one.
        why = "the camera moves parallel to its image and does not turn"
        assert lines == [f"focal length: known to 7% only; {why}."], report


@pytest.mark.slow
def test_why_the_scale_is_not_known_is_said():
    _, truth, _ = make()
    rng = np.random.default_rng(0)
    walking = scenes.truth(rng, 7, 1, 25)
    world = g.world_from_root(walking)
    there = walking.cameras.at[..., :3, 3].multiply(walking.scale)
    stay = jnp.broadcast_to(world[:, :1], world.shape)
    roots = jnp.linalg.inv(there) @ stay
    standing = eqx.tree_at(lambda s: s.roots, walking, roots)
    tripod = walking.cameras.at[:, :3, 3].set(0.0)
    watched = eqx.tree_at(lambda s: s.cameras, walking, tripod)
    for state, why in (
        (truth, "nobody is there to tell it."),
        (standing, "the person stands still."),
        (watched, "the camera hardly moves."),
        (walking, "nothing links people's motion to the map"),
    ):
        factors = [scenes.reprojection(rng, state, 0.0)]
        people = len(state.roots)
        if people:
            factors += scenes.person_factors(rng, state)
        problem = g.make_problem(factors, state)
        if "scale" not in problem.variables:
            variables = (*problem.variables, "scale")
            problem = dataclasses.replace(problem, variables=variables)
        variance = (0.5 * state.scale) ** 2
        report = observability(problem, state, known(state, scale=variance))
        line = next(line for line in report if line.startswith("scale"))
        assert line.startswith("scale: known to 50% only") and why in line, line
        sure = observability(problem, state, known(state))
        assert not any(line.startswith("scale") for line in sure)


def test_a_size_no_better_known_than_before_is_reported():
    rng = np.random.default_rng(0)
    state = scenes.truth(rng, 7, 1, 25)
    factors = [scenes.reprojection(rng, state, 0.0)]
    problem = g.make_problem(factors + scenes.person_factors(rng, state), state)
    unsure = known(state, shapes=0.8 * jnp.eye(10)[None])
    assert any("size of person 0" in x for x in observability(problem, state, unsure))
    sure = observability(problem, state, known(state))
    assert not any("person" in line for line in sure)


@pytest.mark.slow
@pytest.mark.parametrize("unit", [1.0, 1e-3])
def test_a_scale_that_nothing_sees_is_unknown_in_any_unit_of_the_map(unit):
    problem, state, _ = make(people=1)
    (motion,) = [f for f in problem.factors if isinstance(f, g.HumanMotion)]
    others = [f for f in problem.factors if f is not motion]
    silent = dataclasses.replace(motion, whitening=jnp.zeros_like(motion.whitening))
    state = dataclasses.replace(
        state,
        scale=state.scale / unit,
        cameras=state.cameras.at[:, :3, 3].multiply(unit),
        landmarks=unit * state.landmarks,
    )
    problem = g.make_problem([*others, silent], state)
    spread = marginals(problem, state)
    assert all(jnp.isfinite(x).all() for x in jax.tree.leaves(spread))
    report = observability(problem, state, spread)
    assert [line for line in report if line.startswith("scale: not known")]


@pytest.mark.slow
def test_cameras_that_see_nothing_are_reported():
    problem, state, _ = make()
    factor = problem.factors[0]
    nothing = jax.tree.map(lambda x: x, factor)
    nothing = eqx.tree_at(
        lambda f: f.sigma, nothing, jnp.where(factor.frame == 3, jnp.inf, factor.sigma)
    )
    problem = g.make_problem([nothing], state)
    report = observability(problem, state, marginals(problem, state))
    assert "cameras of 1 frames: no landmark is seen in them." in report
