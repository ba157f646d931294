"""Restricts a problem to some of its frames and landmarks.

`marginalisation` splits the measurements in two: those of the first frames and of all
landmarks that these observe (`marginalised_part`), and the others (`remaining_part`).
Arrays are cut by NumPy, as JAX would compile a program for each shape.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from bodyslam_jax.geometry.lengths import put
from bodyslam_jax.graph import (
    CHUNK,
    Factor,
    FrameFactor,
    LandmarkPrior,
    MarginalPrior,
    Problem,
    Reprojection,
    State,
    make_layout,
)
from bodyslam_jax.graph.padding import Masked


def observed_landmarks(
    problem: Problem, frames: int
) -> tuple[Bool[np.ndarray, " l"], int]:
    """Returns which landmarks are observed in the first frames, and the number of
    frames up to the last that the marginalised measurements depend on."""
    observed = np.zeros(len(problem.free.landmarks), bool)
    last = frames
    for factor in problem.factors:
        if isinstance(factor, Reprojection):
            frame, landmark = np.asarray(factor.frame), np.asarray(factor.landmark)
            counts = np.isfinite(np.asarray(factor.sigma))
            observed[landmark[(frame < frames) & counts]] = True
            here = observed[landmark] & counts
            last = max(last, 1 + frame.max(initial=0, where=here))
        if isinstance(factor, MarginalPrior):
            last = max(last, factor.frames)
    return observed, int(last)


def reach_of(problem: Problem) -> int:
    """Returns the number of frames that factors reach back.

    **Raises:** `ValueError` if that is a chunk or more.
    """
    lags = [f.num_lags - 1 for f in problem.factors if isinstance(f, FrameFactor)]
    reach = max(lags, default=0)
    if reach >= CHUNK:
        raise ValueError(
            f"problem.factors: one reaches back {reach} frames, expected at most "
            f"{CHUNK - 1}."
        )
    return reach


def marginalised_part(
    problem: Problem,
    state: State,
    frames: int,
    observed: Bool[np.ndarray, " l"],
    last: int,
) -> tuple[Problem, State]:
    """Returns the problem and state of the marginalised measurements, with the frames
    and landmarks that they depend on."""
    present = np.arange(last) < frames
    chosen = [f for f in problem.factors if not _is_once(f)]
    factors = tuple(_part(f, 0, last, present, observed) for f in chosen)
    tracks = next((f for f in factors if isinstance(f, Reprojection)), None)
    none = np.zeros(0, int)
    before = [f.frames for f in factors if isinstance(f, MarginalPrior)]
    layout = make_layout(
        last,
        int(observed.sum()),
        none if tracks is None else np.asarray(tracks.frame),
        none if tracks is None else np.asarray(tracks.landmark),
        len(state.roots),
        front=-(-max(before, default=1) // CHUNK),
    )
    old = dataclasses.replace(
        problem,
        factors=factors,
        free=restricted(problem.free, 0, last, observed),
        motion=None,
        layout=layout,
    )
    return old, restricted(state, 0, last, observed)


def remaining_part(
    problem: Problem,
    state: State,
    frames: int,
    observed: Bool[np.ndarray, " l"],
    roots: int,
) -> tuple[Problem, State, Int[np.ndarray, " m"]]:
    """Returns the problem and state of the other measurements, still without the prior
    and the layout for it, and the indices of its landmarks. `roots` is the number of
    frames whose roots the prior has."""
    start, stop = frames - CHUNK, len(state.cameras)
    present = np.arange(start, stop) >= frames
    factors = tuple(
        _part(f, start, stop, present, ~observed)
        for f in problem.factors
        if not isinstance(f, MarginalPrior)
    )
    free = restricted(problem.free, start, stop, ~observed)
    cameras = reach_of(problem)
    until = lambda x, axis, count: jnp.asarray(
        np.asarray(x) * _from(count, np.shape(x), axis), x.dtype
    )
    free = dataclasses.replace(
        free,
        cameras=until(free.cameras, 0, CHUNK - cameras),
        roots=until(free.roots, 1, CHUNK - roots),
        poses=until(free.poses, 1, CHUNK - 1),
    )
    motion = None if problem.motion is None else problem.motion.from_frame(start)
    left = dataclasses.replace(problem, factors=factors, free=free, motion=motion)
    there = restricted(state, start, stop, ~observed)
    return left, there, np.flatnonzero(~observed)


def _from(start: int, shape: tuple[int, ...], axis: int) -> np.ndarray:
    """Returns 1 from an index of an axis on, else 0; broadcasts to this shape."""
    along = [n if a == axis else 1 for a, n in enumerate(shape)]
    return (np.arange(shape[axis]) >= start).astype(float).reshape(along)


def _is_once(factor: Factor) -> bool:
    return isinstance(factor, FrameFactor) and factor.once


def restricted(x: Any, start: int, stop: int, landmarks: Bool[np.ndarray, " l"]) -> Any:
    """Restricts a state, or a mask, to some frames and landmarks."""
    return dataclasses.replace(
        x,
        cameras=_rows(x.cameras, slice(start, stop)),
        roots=_rows(x.roots, (slice(None), slice(start, stop))),
        poses=_rows(x.poses, (slice(None), slice(start, stop))),
        landmarks=_rows(x.landmarks, np.flatnonzero(landmarks)),
    )


def _rows(x: Array, at: Any) -> Array:
    """Returns `x[at]` by NumPy: JAX would compile a program for each shape."""
    return put(np.asarray(x)[at])


def _part(
    factor: Factor,
    start: int,
    stop: int,
    present: Bool[np.ndarray, " t"],
    landmarks: Bool[np.ndarray, " l"],
) -> Factor:
    """Restricts a factor to some landmarks, or to the frames that are `present` among
    those from `start` to `stop`."""
    if isinstance(factor, Reprojection):
        frame, landmark = np.asarray(factor.frame), np.asarray(factor.landmark)
        rows = np.flatnonzero(landmarks[landmark] & (frame >= start) & (frame < stop))
        number = np.cumsum(landmarks) - 1
        return Reprojection(
            frame=put(frame[rows] - start, factor.frame.dtype),
            landmark=put(number[landmark[rows]], factor.landmark.dtype),
            pixel=_rows(factor.pixel, rows),
            sigma=_rows(factor.sigma, rows),
            loss=factor.loss,
        )
    if isinstance(factor, LandmarkPrior):
        kept = np.flatnonzero(landmarks)
        of_kept = (_rows(x, kept) for x in (factor.position, factor.whitening))
        return LandmarkPrior(*of_kept, loss=factor.loss)
    if not isinstance(factor, FrameFactor) or factor.once:
        return factor
    return in_frames(_frames(factor, start, stop), present)


def _frames(factor: FrameFactor, start: int, stop: int) -> FrameFactor:
    """Returns the factor of the sequence from `start` to `stop`."""
    axis = 1 if factor.of_people else 0
    if isinstance(factor, Masked):
        inner = _frames(factor.factor, start, stop)
        present = _rows(factor.present, (..., slice(start, stop)))
        return Masked(factor=inner, present=present)
    lead = None
    cut = lambda x: _rows(x, (slice(None),) * axis + (slice(start, stop),))
    for name in factor.time_fields:
        value = getattr(factor, name)
        lead = value.shape[: axis + 1]
        factor = eqx.tree_at(lambda f, n=name: getattr(f, n), factor, cut(value))
    if lead and any(jnp.ndim(x) for x in jax.tree.leaves(factor.loss)):
        of_frames = lambda x: cut(x) if jnp.shape(x)[: axis + 1] == lead else x
        loss = jax.tree.map(of_frames, factor.loss)
        factor = eqx.tree_at(lambda f: f.loss, factor, loss)
    return factor


def in_frames(factor: FrameFactor, present: Bool[np.ndarray, " t"]) -> FrameFactor:
    """Returns the factor with the residuals of the `present` frames only."""
    kept = np.asarray(present)
    if isinstance(factor, Masked):
        both = np.asarray(factor.present) & kept
        return Masked(factor=factor.factor, present=jnp.asarray(both))
    if not factor.padding or factor.num_lags > 1:
        # A row may use the measurement of the row before it, which must therefore stay.
        values = getattr(factor, factor.time_fields[0])
        lead = values.shape[: 2 if factor.of_people else 1]
        return Masked(factor=factor, present=jnp.asarray(np.broadcast_to(kept, lead)))
    axis = 1 if factor.of_people else 0
    for name, fill in factor.padding.items():
        array = np.asarray(getattr(factor, name))
        shape = [len(kept) if a == axis else 1 for a in range(array.ndim)]
        empty = np.asarray(fill, array.dtype)
        filled = jnp.asarray(np.where(kept.reshape(shape), array, empty))
        factor = eqx.tree_at(lambda f, n=name: getattr(f, n), factor, filled)
    return factor
