"""Checks of a problem's inputs: shapes, dtypes and values of states and factors.

Shapes must match the fields' annotations, where `t` frames, `h` people, `l` landmarks
and `i` intrinsics are those of the state. Shapes and dtypes are checked under `jit` and
`vmap` too; values only where they are not traced.

Problems that do not fit into memory are refused before the solver is started.
"""

import os
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from bodyslam_jax.body import KEYPOINT_NAMES
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.geometry.lengths import LENGTHS, is_traced
from bodyslam_jax.graph.factor import Factor, FrameFactor, array_annotations
from bodyslam_jax.graph.factors.camera_prior import CameraPrior
from bodyslam_jax.graph.factors.ground_contact import GroundContact
from bodyslam_jax.graph.factors.keypoint_reprojection import KeypointReprojection
from bodyslam_jax.graph.factors.marginal_prior import MarginalPrior
from bodyslam_jax.graph.factors.reprojection import LandmarkPrior, Reprojection
from bodyslam_jax.graph.factors.root_orientation import RootOrientation
from bodyslam_jax.graph.factors.root_position_prior import RootPositionPrior
from bodyslam_jax.graph.layout import Layout
from bodyslam_jax.graph.ordering import CHUNK
from bodyslam_jax.graph.state import TURNS, State, Step
from bodyslam_jax.graph.validation_weights import (
    check_correlation,
    check_first_frames,
    check_loss,
)

Sizes = dict[str, int]
"""Lengths of the axes that annotations name."""
_MAX_ROTATION_ERROR = 1e-3
"""Largest allowed entry of `|C^T C - I|`: files have few digits, and rotations drift in
single precision."""
_DTYPE_KINDS: dict[Any, tuple[Any, str]] = {
    Float: (jnp.floating, "floating point"),
    Int: (jnp.integer, "integers"),
    Bool: (jnp.bool_, "bool"),
}
_CGROUP_LIMIT_FILES = (
    "/sys/fs/cgroup/memory.max",
    "/sys/fs/cgroup/memory/memory.limit_in_bytes",
)
"""Memory limit of a container (cgroup v2, v1); `max`, or a huge number, without."""


def check_state(state: State, free: Step | None = None) -> Sizes:
    """Checks a state, and returns the lengths of its axes.

    With `free`, the mask of a problem, the state must also have the problem's sizes and
    floating-point precision.

    **Raises:** `ValueError` that says where, what was found and what was expected.
    """
    sizes: Sizes = {}
    if free is not None:
        check_shapes(free, "problem.free", sizes)
    check_shapes(state, "state", sizes)
    _check_precision(state, free)
    if not sizes["t"]:
        raise ValueError("state.cameras: 0 frames, expected 1 or more.")
    # fx fy cx cy, or with the four distortion coefficients of OPENCV.
    if sizes["i"] not in (4, 8):
        raise ValueError(f"state.intrinsics: {sizes['i']} numbers, expected 4 or 8.")
    _check_values(state, "state")
    _check_rotations(state.cameras, "state.cameras")
    _check_rotations(state.roots, "state.roots")
    return sizes


def check_measurements(factor: Factor, sizes: Sizes) -> None:
    """Refuses measurements that do not fit a state with axes of these `sizes`.

    **Raises:** `ValueError` that says where, what was found and what was expected.
    """
    name = type(factor).__name__
    known = FrameFactor | Reprojection | LandmarkPrior | MarginalPrior
    if not isinstance(factor, known):
        raise ValueError(f"factors: {name} is neither of landmarks nor over frames.")
    sizes = dict(sizes)
    check_loss(factor.loss, f"{name}.loss")
    scale = np.shape(getattr(factor.loss, "scale", 0.0))
    each = isinstance(factor, KeypointReprojection)
    if scale and not (each and scale == factor.sigma.shape):
        expected = f"one number, or {factor.sigma.shape}" if each else "one number"
        raise ValueError(f"{name}.loss.scale: shape {scale}, expected {expected}.")
    if isinstance(factor, KeypointReprojection):
        if factor.layout not in KEYPOINT_NAMES:
            raise ValueError(
                f"{name}.layout: found {factor.layout!r}, expected one of "
                f"{sorted(KEYPOINT_NAMES)}."
            )
        sizes["j"] = len(KEYPOINT_NAMES[factor.layout])
    check_shapes(factor, name, sizes)
    if isinstance(factor, FrameFactor):
        _check_frames(factor, name, sizes)
    _check_values(factor, name)
    check_first_frames(factor, name)
    check_correlation(factor, name)
    if isinstance(factor, Reprojection):
        _check_tracks(factor, sizes)
    if isinstance(factor, MarginalPrior):
        _check_marginal(factor, sizes)
    if isinstance(factor, RootOrientation):
        measured = _measured(factor.sigma[..., None])
        _check_rotations(factor.orientation, f"{name}.orientation", measured)
    if isinstance(factor, CameraPrior):
        measured = _measured(factor.sigma[:, :3])
        _check_rotations(factor.cameras, f"{name}.cameras", measured)
    if isinstance(factor, GroundContact):
        _check_unit(factor.normal, f"{name}.normal")
    if isinstance(factor, RootPositionPrior) and not is_traced(factor.position):
        depth = np.asarray(factor.position)[..., 2][_measured(factor.sigma)]
        if not (depth > 0).all():
            raise ValueError(
                f"{name}.position: found a depth of {depth.min()} m, expected above 0."
            )


def check_shapes(module: eqx.Module, name: str, sizes: Sizes) -> None:
    """Checks the dtype and shape of each array field against its annotation.

    The length of an axis that is not yet in `sizes` is taken from the first array that
    has this axis, and added to `sizes`.

    **Raises:** `ValueError` that says where, what was found and what was expected.
    """
    for field, kind in array_annotations(type(module)).items():
        found = getattr(module, field)
        where = f"{name}.{field}"
        if not isinstance(found, jax.Array | np.ndarray):
            raise ValueError(f"{where}: found {found!r:.40}, expected an array.")
        numbers, word = _DTYPE_KINDS.get(kind.dtype, (jnp.generic, "numbers"))
        if not jnp.issubdtype(found.dtype, numbers):
            raise ValueError(f"{where}: found {found.dtype}, expected {word}.")
        axes = kind.dim_str.split()
        if not all(axis.isidentifier() or axis.isdecimal() for axis in axes):
            continue
        if len(axes) == found.ndim:
            for axis, size in zip(axes, found.shape):
                if axis.isidentifier():
                    sizes.setdefault(axis, size)
        length = lambda axis: int(axis) if axis.isdecimal() else sizes.get(axis, axis)
        expected = [length(axis) for axis in axes]
        if list(found.shape) != expected:
            shape = str(tuple(expected)).replace("'", "")
            raise ValueError(
                f"{where}: shape {found.shape}, expected {shape} for `{kind.dim_str}`."
            )


def check_prior(factor: LandmarkPrior, landmark: np.ndarray) -> None:
    """Refuses priors on landmarks that have no observation.

    `landmark` are the landmark indices of all observations.

    **Raises:** `ValueError` that says how many such priors there are.
    """
    if is_traced(factor.whitening):
        return
    has_prior = np.any(np.asarray(factor.whitening), axis=(1, 2))
    unobserved = has_prior & ~np.isin(np.arange(has_prior.size), landmark)
    if unobserved.any():
        raise ValueError(
            f"LandmarkPrior: {int(unobserved.sum())} landmarks have a prior and no "
            "observation; expected both, or a `whitening` of 0."
        )


def _check_frames(factor, name, sizes):
    """Checks that the leading axes of a factor's `time_fields` are `h t`, or `t` for a
    camera's factor, even if their annotations do not state it."""
    axes = "ht" if factor.of_people else "t"
    lead = tuple(sizes[axis] for axis in axes)
    for field in factor.time_fields:
        shape = getattr(factor, field).shape
        if shape[: len(lead)] != lead:
            raise ValueError(
                f"{name}.{field}: shape {shape}, expected to begin with {lead}."
            )


def _check_values(module, name):
    padding = getattr(module, "padding", None) or {}
    missing = [f".{field}" for field, value in padding.items() if np.isinf(value)]
    for path, leaf in jax.tree_util.tree_leaves_with_path(module):
        where = name + jax.tree_util.keystr(path)
        if is_traced(leaf) or not eqx.is_inexact_array_like(leaf):
            continue
        values = np.asarray(leaf)
        if "sigma" in where or jax.tree_util.keystr(path) in missing:
            if not (values > 0).all():
                raise ValueError(f"{where}: found {values.min()}, expected above 0.")
            continue
        if not np.isfinite(values).all():
            bad = int(np.sum(~np.isfinite(values)))
            text = f"{where}: {bad} of {values.size} values are not finite."
            if np.isposinf(values[~np.isfinite(values)]).all() and path[0].name in (
                getattr(module, "time_fields", ())
            ):
                text += f" If inf is a missing one, say so: `padding` of {name}."
            raise ValueError(text)
        if where.endswith(".correlation") and not (abs(values) < 1).all():
            far = values.flat[abs(values).argmax()]
            raise ValueError(f"{where}: found {far}, expected between -1 and 1.")


def _check_precision(state, free):
    """Refuses a state whose arrays are not all of one dtype, that of the problem.

    Otherwise a `lax` loop over states would change the dtype of its carry.
    """
    expected, like = state.scale.dtype, "state.scale"
    if free is not None:
        expected, like = free.scale.dtype, "the problem"
    if expected not in (np.float32, np.float64):
        raise ValueError(f"{like}: found {expected}, expected float32 or float64.")
    for name, value in vars(state).items():
        if value.dtype != expected:
            raise ValueError(
                f"state.{name}: found {value.dtype}, expected {expected} as in {like}."
            )


def _measured(sigma):
    """Returns which measurements have at least one finite `sigma` on the last axis.

    All false if `sigma` is traced: its values are not available then.
    """
    if is_traced(sigma):
        return np.zeros(sigma.shape[:-1], bool)
    return np.isfinite(np.asarray(sigma)).any(axis=-1)


def _check_rotations(poses, where, mask=None):
    """Refuses matrices that are not rotations (3 x 3) or rigid poses (4 x 4, whose last
    row is checked too); with a `mask`, only where it is true."""
    if is_traced(poses):
        return
    poses = np.asarray(poses, float)
    C = poses[..., :3, :3]
    error = abs(np.swapaxes(C, -1, -2) @ C - np.eye(3)).max(axis=(-2, -1), initial=0)
    error = np.where(np.linalg.det(C) > 0, error, np.inf)
    if poses.shape[-1] == 4:
        error = np.maximum(error, abs(poses[..., 3, :] - np.eye(4)[3]).max(axis=-1))
    if mask is not None:
        error = np.where(mask, error, 0)
    wrong = error > _MAX_ROTATION_ERROR
    if wrong.any():
        at = tuple(int(i) for i in np.argwhere(wrong)[0])
        what = "poses" if poses.shape[-1] == 4 else "rotations"
        raise ValueError(
            f"{where}: {int(wrong.sum())} of {wrong.size} are no rigid {what}, the "
            f"first at {at}; expected all to be."
        )


def _check_unit(direction, where):
    if is_traced(direction):
        return
    length = np.linalg.norm(np.asarray(direction, float))
    if abs(length - 1) > _MAX_ROTATION_ERROR:
        raise ValueError(f"{where}: a direction of length {length:.4g}, expected 1.")


def _check_range(where, index, limit):
    if len(index) and not (index.min() >= 0 and index.max() < limit):
        raise ValueError(
            f"{where}: indices {index.min()} to {index.max()}, expected 0 to "
            f"{limit - 1}."
        )


def _check_marginal(factor, sizes):
    found = check_state(factor.estimate)
    for axis in "hig":
        if found[axis] != sizes[axis]:
            raise ValueError(
                f"MarginalPrior.estimate: {found[axis]} along `{axis}`, expected "
                f"{sizes[axis]} as in the state."
            )
    if found["t"] > sizes["t"]:
        raise ValueError(
            f"MarginalPrior: couples {found['t']} frames, expected at most the "
            f"{sizes['t']} of the state."
        )


def _check_tracks(factor, sizes):
    if is_traced(factor.frame) or is_traced(factor.landmark):
        return
    frame, landmark = np.asarray(factor.frame), np.asarray(factor.landmark)
    _check_range("Reprojection.frame", frame, sizes["t"])
    _check_range("Reprojection.landmark", landmark, sizes["l"])
    pair = np.sort(frame.astype(np.int64) * sizes["l"] + landmark)
    twice = pair[1:][pair[1:] == pair[:-1]]
    if len(twice):
        f, l = divmod(int(twice[0]), sizes["l"])
        raise ValueError(
            f"Reprojection: landmark {l} is observed twice in frame {f} "
            f"({len(twice)} such observations), expected once at most."
        )


def check_basis(basis: Array | np.ndarray, dtype: np.dtype) -> Array:
    """Returns the basis of postures in the precision of a state.

    **Raises:** `ValueError` unless it has 69 rows and orthonormal columns.
    """
    if is_traced(basis):
        return jnp.asarray(basis, dtype)
    found = np.asarray(basis, float)
    if found.ndim != 2 or found.shape[0] != TURNS or not found.shape[1]:
        raise ValueError(
            f"basis: found shape {found.shape}, expected ({TURNS}, k) with k from 1."
        )
    off = np.max(np.abs(found.T @ found - np.eye(found.shape[1])))
    if not off < 1e-4:
        raise ValueError(
            f"basis: its columns are not orthonormal (off by {off:.2g}); `numpy.linalg."
            "qr` makes them so."
        )
    return jnp.asarray(found, dtype)


def memory() -> int:
    """Returns the bytes of memory of this machine, or of its container's limit."""
    found = [os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")]
    for name in _CGROUP_LIMIT_FILES:
        try:
            found.append(int(Path(name).read_text()))
        except (OSError, ValueError):
            continue
    return min(found)


def memory_needed(layout: Layout, state: State, pose: int) -> int:
    """Estimates the bytes of the solver's tables for postures of `pose` coordinates."""
    item = state.scale.dtype.itemsize
    people = len(state.roots)
    person = pose + 12  # what remains of a chunk: a posture and two roots
    front = CHUNK * 6 * layout.bandwidth + people * (layout.reach * person + 10) + 16
    front += 3 * layout.lasting
    pivot = 6 * CHUNK + people * person
    window = 2 * person + 6 * CHUNK + 24
    postures = CHUNK * 4 * pose * (2 * pose + 6 * CHUNK + 12)
    chunk = 3 * pivot * front + people * (window**2 + postures)
    tables = sum(40 * bucket.row.size for bucket in layout.buckets)
    return item * (chunk * layout.num_chunks + tables)


def check_memory(layout: Layout, state: State, pose: int) -> None:
    """Refuses a problem that does not fit; memory grows linearly with frames.

    **Raises:** `InputError` with the number of frames that fit.
    """
    need, have = memory_needed(layout, state, pose), memory()
    if need > have:
        most = int(layout.num_chunks * CHUNK * have / need)
        fit = max((x for x in LENGTHS if x <= most), default=most)
        raise InputError(
            f"{len(state.cameras)} frames need about {need / 2**30:.1f} GiB, found "
            f"{have / 2**30:.1f} GiB: about {fit} frames fit. The memory of bodyslam "
            "live VIDEO --every-frame does not grow with frames."
        )
