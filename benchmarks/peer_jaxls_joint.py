"""The joint problem by jaxls: a peer of the solver.

    python peer_jaxls_joint.py FRAMES STEPS RTOL result.npz

Run by `bench_solver.py baselines --baselines jaxls --peer-python PYTHON`, where PYTHON
has `jaxls` and this package. The problem is that of `solver_scene.make`, each factor a
cost over its own variables; derivatives are by jaxls, the solver as in `peer_jaxls.py`.
"""

import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxls
import numpy as np
from peer_jaxls import Point, solve
from solver_scene import make

import bodyslam_jax.graph as g
from bodyslam_jax.graph import Frame, Shared, retract_pose, retract_rotation, robustify

eye, zeros = lambda: jnp.eye(4), lambda *shape: lambda: jnp.zeros(shape)


class Camera(
    jaxls.Var[jax.Array], default_factory=eye, retract_fn=retract_pose, tangent_dim=6
):
    """T'_WC"""


class Root(
    jaxls.Var[jax.Array], default_factory=eye, retract_fn=retract_pose, tangent_dim=6
):
    """T_CH of a person in a frame, numbered person by person."""


class Pose(
    jaxls.Var[jax.Array],
    default_factory=zeros(23, 3),
    retract_fn=lambda pose, step: retract_rotation(pose, step.reshape(23, 3)),
    tangent_dim=69,
):
    """θ, numbered like roots."""


class Shape(jaxls.Var[jax.Array], default_factory=zeros(10)):
    """β of a person."""


class Scale(jaxls.Var[jax.Array], default_factory=zeros()):
    """s"""


VARIABLES = {"camera": Camera, "root": Root, "pose": Pose, "shape": Shape}
LOCAL = ("camera", "root", "pose")


def lifted(factor, residual):
    """Whose squared norm is the robust cost; jaxls has squares only."""
    plain = isinstance(factor.loss, g.Squared)
    return (residual if plain else robustify(factor.loss, residual)).ravel()


def of_landmarks(factor, state):
    """The cost of all observations."""

    @jaxls.Cost.factory
    def reprojection(values, camera, point, pixel, sigma):
        alone = eqx.tree_at(
            lambda s: (s.cameras, s.landmarks),
            state,
            (values[camera][None], values[point][None]),
        )
        first = jnp.zeros(1, int)
        one = g.Reprojection(first, first, pixel[None], sigma[None], factor.loss)
        return lifted(factor, one.residual(alone))

    camera, point = Camera(factor.frame), Point(factor.landmark)
    return reprojection(camera, point, factor.pixel, factor.sigma)


def of_frames(factor, state):
    """The cost of a factor in all frames of all people."""
    people, frames = state.roots.shape[:2]
    person, frame = (x.ravel() for x in jnp.indices((people, frames)))

    def variable(name, lag):
        if name == "scale":
            return Scale(jnp.zeros_like(person))
        if name == "shape":
            return Shape(person)
        # Frames before the first carry no weight; the last ones stand for them, as one
        # cost may not have a variable twice.
        there = (frame - lag) % frames
        return VARIABLES[name](there if name == "camera" else person * frames + there)

    keys = [touch for touch in factor.keys if touch[0] != "intrinsics"]

    @jaxls.Cost.factory
    def cost(values, variables, data):
        known = {t: values[v] for t, v in zip(keys, variables, strict=True)}
        window = tuple(
            Frame(*(known.get((name, lag)) for name in LOCAL))
            for lag in range(factor.num_lags)
        )
        shared = Shared(
            known.get(("scale", 0)), known.get(("shape", 0)), state.intrinsics
        )
        return lifted(factor, factor.frame_residual(data, window, shared))

    data = jax.tree.map(lambda x: x[person, frame], factor.data())
    return cost(tuple(variable(*touch) for touch in keys), data)


def main(frames, steps, rtol, target):
    problem, _, start = make(int(frames), 1)
    people, count = start.roots.shape[:2]
    flat = lambda x: x.reshape(people * count, *x.shape[2:])
    first = [
        Camera(jnp.arange(count)).with_value(start.cameras),
        Root(jnp.arange(people * count)).with_value(flat(start.roots)),
        Pose(jnp.arange(people * count)).with_value(flat(start.poses)),
        Shape(jnp.arange(people)).with_value(start.shapes),
        Scale(jnp.arange(1)).with_value(start.scale[None]),
        Point(jnp.arange(len(start.landmarks))).with_value(start.landmarks),
    ]
    costs = [
        (of_landmarks if isinstance(factor, g.Reprojection) else of_frames)(
            factor, start
        )
        for factor in problem.factors
    ]
    found, measured = solve(costs, first, int(steps), float(rtol))
    cameras, roots, poses, shapes, scale, points = (found[v.variable] for v in first)
    np.savez(
        target,
        cameras=cameras,
        roots=roots.reshape(start.roots.shape),
        poses=poses.reshape(start.poses.shape),
        shapes=shapes,
        scale=scale[0],
        landmarks=points,
        **measured,
    )


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_enable_compilation_cache", False)
    main(*sys.argv[1:])
