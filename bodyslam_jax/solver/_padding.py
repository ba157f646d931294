"""Rounds a problem's sizes up, so that videos of about the same length compile once.

What is added has no weight: measurements with `sigma = inf`, variables that may not
move.
"""

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from bodyslam_jax.graph import (
    CHUNK,
    LandmarkPrior,
    Problem,
    Reprojection,
    State,
    Step,
    round_up,
)

_FILL = {"sigma": "inf", "whitening": 0.0, "correlation": 0.0, "present": False}


def pad(problem: Problem, state: State) -> tuple[Problem, State]:
    """The same problem with `num_chunks * CHUNK` frames and more landmark slots."""
    frames = problem.layout.num_chunks * CHUNK - len(state.cameras)
    landmarks = round_up(len(state.landmarks) + 1) - len(state.landmarks)
    factors = tuple(
        _pad_factor(factor, frames, landmarks) for factor in problem.factors
    )
    motion = problem.motion
    if motion is not None:
        present = _extend(motion.present, 1, frames, False)
        motion = eqx.tree_at(lambda m: m.present, motion, present)
    free = problem.free
    free = Step(
        scale=free.scale,
        cameras=_extend(free.cameras, 0, frames, 0.0),
        roots=_extend(free.roots, 1, frames, 0.0),
        poses=_extend(free.poses, 1, frames, 0.0),
        shapes=free.shapes,
        landmarks=_extend(free.landmarks, 0, landmarks, 0.0),
        intrinsics=free.intrinsics,
    )
    padded = State(
        scale=state.scale,
        cameras=_extend(state.cameras, 0, frames, "edge"),
        roots=_extend(state.roots, 1, frames, "edge"),
        poses=_extend(state.poses, 1, frames, "edge"),
        shapes=state.shapes,
        landmarks=_extend(state.landmarks, 0, landmarks, 0.0),
        intrinsics=state.intrinsics,
    )
    padded_problem = Problem(factors, free, motion, problem.layout, problem.variables)
    return _typed((padded_problem, padded))


def _typed(tree):
    """The same numbers, none of them weakly typed: that alone would compile anew."""
    strong = lambda x: jnp.asarray(x, x.dtype) if eqx.is_array(x) else x
    return jax.tree.map(strong, tree)


def unpad(state: State, num_frames: int, num_landmarks: int) -> State:
    """Drops what `pad` added."""
    cut = lambda x: x if isinstance(x, jax.core.Tracer) else np.asarray(x)
    return State(
        scale=state.scale,
        cameras=jnp.asarray(cut(state.cameras)[:num_frames]),
        roots=jnp.asarray(cut(state.roots)[:, :num_frames]),
        poses=jnp.asarray(cut(state.poses)[:, :num_frames]),
        shapes=state.shapes,
        landmarks=jnp.asarray(cut(state.landmarks)[:num_landmarks]),
        intrinsics=state.intrinsics,
    )


def _pad_factor(factor, frames, landmarks):
    if isinstance(factor, LandmarkPrior):
        return LandmarkPrior(
            place=_extend(factor.place, 0, landmarks, 0.0),
            whitening=_extend(factor.whitening, 0, landmarks, 0.0),
            loss=factor.loss,
        )
    if isinstance(factor, Reprojection):
        rows = round_up(len(factor.frame) + 1) - len(factor.frame)
        return Reprojection(
            frame=_extend(factor.frame, 0, rows, 0),
            landmark=_extend(factor.landmark, 0, rows, 0),
            pixel=_extend(factor.pixel, 0, rows, 0.0),
            sigma=_extend(factor.sigma, 0, rows, jnp.inf),
            loss=factor.loss,
        )
    axis = 1 if factor.of_people else 0
    for name in factor.frame_fields:
        fill = _FILL.get(name, "edge")
        fill = jnp.inf if fill == "inf" else fill
        values = _extend(getattr(factor, name), axis, frames, fill)
        factor = eqx.tree_at(lambda f: getattr(f, name), factor, values)
    return factor


def _extend(x: jax.Array, axis: int, count: int, fill) -> jax.Array:
    """Outside jit by NumPy: JAX would compile one small program per shape."""
    widths = [(0, count) if a == axis else (0, 0) for a in range(x.ndim)]
    traced = isinstance(x, jax.core.Tracer)
    grow = jnp.pad if traced else lambda a, *w, **k: np.pad(np.asarray(a), *w, **k)
    if fill == "edge":
        return jnp.asarray(grow(x, widths, mode="edge"))
    return jnp.asarray(grow(x, widths, constant_values=np.asarray(fill, x.dtype)))
