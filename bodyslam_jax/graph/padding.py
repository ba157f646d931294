"""Padding of factors with frames that contribute nothing to the cost.

The solver rounds the number of frames up, so that videos of about the same length share
a compiled program. A factor's `padding` holds the values of its fields with which a
frame contributes nothing (such as an infinite sigma). A factor without `padding` is
masked instead (`Masked`).
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from bodyslam_jax.geometry.lengths import is_traced, put
from bodyslam_jax.graph.factor import FrameFactor, array_annotations
from bodyslam_jax.graph.losses import Loss
from bodyslam_jax.graph.state import State, moved_at_random

_COST_RTOL = {"float64": 1e-8, "float32": 1e-3}
"""Allowed relative difference of costs, by precision."""


class Masked(FrameFactor):
    """A factor that is active only in some frames: the residual of the others is 0.

    Inactive frames are evaluated with the measurements and variables of the first or
    last active frame. So the factor is never evaluated where it may not be defined,
    such as at two equal poses, and derivatives are finite wherever those of the factor
    are.
    """

    factor: FrameFactor
    present: Bool[Array, "*h t"]
    """The active frames, of each person if the factor is of people: one run of them,
    before and after which all are inactive."""
    padding = {"present": False}

    @property
    def time_fields(self) -> tuple[str, ...]:
        return ("present",)

    @property
    def of_people(self) -> bool:
        return self.factor.of_people

    @property
    def per_joint(self) -> bool:
        return self.factor.per_joint

    @property
    def loss(self) -> Loss:
        return self.factor.loss

    @property
    def keys(self):
        return self.factor.keys

    def rescaled(self, factor):
        return dataclasses.replace(self, factor=self.factor.rescaled(factor))

    def frame_of_row(self, num_frames):
        active = self.present.reshape(-1, num_frames).any(axis=0)
        first = jnp.argmax(active)
        last = jnp.maximum(first + active.sum(dtype=int) - 1, 0)
        return jnp.clip(jnp.arange(num_frames), first, last)

    def data(self):
        row = self.frame_of_row(self.present.shape[-1])
        axis = self.present.ndim - 1
        measured = jax.tree.map(lambda x: jnp.take(x, row, axis), self.factor.data())
        return self.present, measured

    def frame_residual(self, data, window, shared):
        present, measured = data
        shared = dataclasses.replace(shared, names=self.factor.globals_at)
        residual = self.factor.frame_residual(measured, window, shared)
        return _zero_unless(present, residual)

    def jacobian(self, data, window, shared):
        present, measured = data
        shared = dataclasses.replace(shared, names=self.factor.globals_at)
        found = self.factor.jacobian(measured, window, shared)
        if found is None:
            return None
        return jax.tree.map(lambda x: _zero_unless(present, x), found)


def _zero_unless(present: Array, x: Array) -> Array:
    return jnp.where(present, x, jnp.zeros_like(x))


def pad_factor(factor: FrameFactor, state: State, frames: int) -> FrameFactor:
    """Returns the factor with `frames` frames of weight 0 after those of `state`.

    A loss with a scale for each measurement is extended, too.
    """
    lead = state.roots.shape[:2] if factor.of_people else state.cameras.shape[:1]
    axis = len(lead) - 1
    if isinstance(factor, Masked):
        inner = pad_factor(factor.factor, state, frames)
        inner = inner.factor if isinstance(inner, Masked) else inner
        present = extend(factor.present, axis, frames, False)
        return Masked(factor=inner, present=present)
    fill = factor.padding or {}
    padded = factor
    for name in factor.time_fields:
        values = extend(getattr(factor, name), axis, frames, fill.get(name, "edge"))
        padded = eqx.tree_at(lambda f, n=name: getattr(f, n), padded, values)
    longer = lambda x: (
        extend(x, axis, frames, "edge") if jnp.shape(x)[: len(lead)] == lead else x
    )
    if any(jnp.ndim(x) for x in jax.tree.leaves(factor.loss)):
        loss = jax.tree.map(longer, factor.loss)
        padded = eqx.tree_at(lambda f: f.loss, padded, loss)
    if factor.padding is not None or not _is_over_frames(factor):
        return padded
    present = np.ones((*lead[:-1], lead[-1] + frames), bool)
    present[..., lead[-1] :] = False
    return Masked(factor=padded, present=put(present))


def _is_over_frames(factor: FrameFactor) -> bool:
    """Returns True if each residual belongs to a frame: not if it is counted once, or
    if the class overrides `map_frames`."""
    return not factor.once and type(factor).map_frames is FrameFactor.map_frames


def extend_state(state: State, frames: int) -> State:
    """Returns the state with its last frame repeated `frames` times."""
    return dataclasses.replace(
        state,
        cameras=extend(state.cameras, 0, frames, "edge"),
        roots=extend(state.roots, 1, frames, "edge"),
        poses=extend(state.poses, 1, frames, "edge"),
    )


def extend(x: Array, axis: int, count: int, fill: Any) -> Array:
    """Returns the array with `count` entries appended along an axis: `fill`, or copies
    of the last entry if `fill` is `"edge"`.

    Uses NumPy outside of `jit`: JAX would compile one small program per shape.
    """
    widths = [(0, count) if a == axis else (0, 0) for a in range(x.ndim)]
    how: dict[str, Any] = (
        {"mode": fill}
        if isinstance(fill, str)
        else {"constant_values": np.asarray(fill, x.dtype)}
    )
    if isinstance(x, jax.core.Tracer):
        return jnp.pad(x, widths, **how)
    return put(np.pad(np.asarray(x), widths, **how))


def check_padding(factor: FrameFactor, state: State) -> None:
    """Refuses a custom factor whose cost changes when it is padded with frames.

    All its arrays over frames must be in `time_fields`. Costs with and without padding
    are compared unless the factor or the state is traced (`jit`, `vmap`).

    **Raises:** `ValueError` that says where, what was found and what was expected.
    """
    name = type(factor).__name__
    if type(factor).__module__.partition(".")[0] == __name__.partition(".")[0]:
        return
    fields = factor.time_fields
    for field in factor.padding or {}:
        if field not in fields:
            raise ValueError(
                f"{name}.padding: found {field!r}, expected fields among "
                f"`time_fields`, {list(fields)}."
            )
    axes = "h t" if factor.of_people else "t"
    for field, array in array_annotations(type(factor)).items():
        dims = array.dim_str.split()
        if "t" in dims and field not in fields:
            leads = dims[: len(axes.split())] == axes.split()
            where = f"{name}.time_fields" if leads else f"{name}.{field}"
            found = list(fields) if leads else f"axes `{array.dim_str}`"
            raise ValueError(
                f"{where}: found {found}, expected "
                + (
                    f"{field!r}, an array over frames, among them."
                    if leads
                    else f"`{axes}` to be the first."
                )
            )
    if is_traced((factor, state)):
        return
    frames = factor.num_lags + 1
    found, expected = (
        float(x)
        for x in _costs(
            factor,
            pad_factor(factor, state, frames),
            extend_state(state, frames),
            len(state.cameras),
        )
    )
    tolerance = _COST_RTOL[state.scale.dtype.name]
    if not np.isclose(found, expected, tolerance, tolerance, equal_nan=True):
        raise ValueError(
            f"{name}.padding: with {frames} frames more, which are to measure nothing, "
            f"the cost is {found:.6g}, expected {expected:.6g} as without them; name "
            "the values with which a frame weighs nothing, or leave `padding` out."
        )


@eqx.filter_jit
def _costs(factor, padded, state, num_frames):
    """Returns the costs with and without padding, at a perturbed state."""
    moved = moved_at_random(state)
    cut = dataclasses.replace(
        moved,
        cameras=moved.cameras[:num_frames],
        roots=moved.roots[:, :num_frames],
        poses=moved.poses[:, :num_frames],
    )
    return padded.cost(moved), factor.cost(cut)
