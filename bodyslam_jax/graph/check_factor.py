"""`check_factor` tests whether the solver can rely on a custom factor."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from bodyslam_jax.graph.factor import Factor, FrameFactor
from bodyslam_jax.graph.globals import Named, bound
from bodyslam_jax.graph.padding import check_padding
from bodyslam_jax.graph.state import State, Step, moved_at_random
from bodyslam_jax.graph.validation import check_measurements, check_state
from bodyslam_jax.graph.validation_weights import check_precision

_COST_RTOL = {"float64": 1e-9, "float32": 1e-4}
"""Largest relative difference, by precision, of a cost computed in two ways."""
_KEY_OF_FIELD = {
    "scale": "scale",
    "cameras": "camera",
    "roots": "root",
    "poses": "pose",
    "shapes": "shape",
    "intrinsics": "intrinsics",
    "globals": "globals",
}
"""Names in `keys` of the fields of a state."""


@dataclasses.dataclass(frozen=True)
class FactorReport:
    """Properties of a factor that passed `check_factor`."""

    name: str
    keys: tuple[tuple[str, int], ...]
    """Variables and lags that the residual depends on."""
    residual_shape: tuple[int, ...]
    cost: float
    """Negative log-likelihood at the given state, up to a constant."""
    gradient: dict[str, float]
    """Largest derivative of the cost by each group of variables in `keys`, close to the
    given state."""


def check_factor(factor: Factor, state: State, named: Named = ()) -> FactorReport:
    """Refuses a factor that does not fit a state, or that the solver cannot use.

    Shapes, kinds and values must fit; a residual may depend on the variables in `keys`
    only; values and derivatives must be finite, close to `state` and with respect to
    the measurements; appended frames must not change the cost; `jit` and `vmap` must
    give the same cost. `named` is `Problem.globals`, for a factor of named globals.

    **Raises:** `ValueError` in one line: where, what was found, what was expected.
    """
    sizes = check_state(state)
    factor = bound(factor, named)
    check_measurements(factor, sizes)
    check_precision(factor, state)
    name = type(factor).__name__
    residual = _residual(factor, state, name)
    moved = moved_at_random(state)
    cost = _finite_cost(factor, state, name)
    gradient = _gradient_by_state(factor, moved, name)
    _check_gradient_by_measurements(factor, moved, name)
    if isinstance(factor, FrameFactor):
        check_padding(factor, state)
    _check_transformed(factor, moved, name)
    keys = tuple(factor.keys) if isinstance(factor, FrameFactor) else ()
    return FactorReport(name, keys, residual.shape, cost, gradient)


def _residual(factor: Factor, state: State, name: str) -> Array:
    # Frames are mapped, so that code that cannot be traced fails here already.
    residual = _traced(name, "jax.vmap", lambda: factor.residual(state))
    if not isinstance(residual, jax.Array) or residual.ndim < 1:
        raise ValueError(
            f"{name}.frame_residual: found {type(residual).__name__} of shape "
            f"{np.shape(residual)}, expected an array with one axis or more."
        )
    if not isinstance(factor, FrameFactor):
        return residual
    lead = (state.roots.shape[0],) if factor.of_people else ()
    lead += (1,) if factor.once else (len(state.cameras),)
    if type(factor).map_frames is not FrameFactor.map_frames:
        return residual
    if residual.shape[: len(lead)] != lead or residual.ndim == len(lead):
        raise ValueError(
            f"{name}.frame_residual: shape {residual.shape[len(lead) :]} for each "
            "frame, expected one axis or more, such as (3,) or (1,)."
        )
    return residual


def _finite_cost(factor: Factor, state: State, name: str) -> float:
    cost = float(factor.cost(state))
    if not np.isfinite(cost):
        raise ValueError(
            f"{name}.frame_residual: the cost at the given state is {cost}, expected a "
            "finite number; missing measurements have sigma = inf and a finite value."
        )
    return cost


def _gradient_by_state(factor: Factor, state: State, name: str) -> dict[str, float]:
    """Returns the largest derivative by group; refuses groups missing in `keys`."""
    slope = _slope(factor, state)
    largest = {}
    for field, values in vars(slope).items():
        values = np.asarray(values)
        variable = _KEY_OF_FIELD.get(field)
        if not np.isfinite(values).all():
            bad = int(np.sum(~np.isfinite(values)))
            raise ValueError(
                f"{name}.frame_residual: {bad} of {values.size} derivatives by "
                f"{field} are not finite, expected all to be; guard roots, norms and "
                "angles where they are not differentiable (`jnp.where` on the input)."
            )
        size = float(abs(values).max(initial=0.0))
        if not isinstance(factor, FrameFactor):
            largest[field] = size
        elif variable in {key for key, _ in factor.touched}:
            largest[field] = size
        elif size > 0:
            expected = f"({variable!r}, 0)" if variable else "no landmarks"
            raise ValueError(
                f"{name}.keys: found {list(factor.keys)}, but the residual depends on "
                f"{field}; expected {expected} among them."
            )
    return largest


def _check_gradient_by_measurements(factor: Factor, state: State, name: str) -> None:
    slope = eqx.filter_grad(lambda f: f.cost(state))(factor)
    for path, leaf in jax.tree_util.tree_leaves_with_path(slope):
        if not np.isfinite(np.asarray(leaf)).all():
            bad = int(np.sum(~np.isfinite(np.asarray(leaf))))
            raise ValueError(
                f"{name}{jax.tree_util.keystr(path)}: {bad} of {np.size(leaf)} "
                "derivatives of the cost by it are not finite, expected all to be."
            )


def _check_transformed(factor: Factor, state: State, name: str) -> None:
    """Refuses a factor whose cost changes under `jit` or `vmap` over two states."""
    plain = lambda f, s: f.cost(s)
    with jax.disable_jit():
        expected = np.asarray(plain(factor, state))
    both = jax.tree.map(lambda x: jnp.stack([x, x]), state)
    ways: dict[str, Any] = {
        "jax.jit": lambda: eqx.filter_jit(plain)(factor, state),
        "jax.vmap": lambda: eqx.filter_vmap(plain, in_axes=(None, 0))(factor, both),
    }
    for way, cost in ways.items():
        found = np.asarray(_traced(name, way, cost))
        if not np.allclose(found, expected, rtol=_COST_RTOL[str(state.scale.dtype)]):
            raise ValueError(
                f"{name}.frame_residual: the cost is {found.ravel()[0]:.9g} under "
                f"{way}, expected {expected:.9g} as without it."
            )


def _traced(name: str, way: str, call: Callable[[], Any]) -> Any:
    """Returns `call()`; raises a `ValueError` of one line if it cannot be traced."""
    try:
        return call()
    except jax.errors.JAXTypeError as error:
        line = str(error).splitlines()[0]
        raise ValueError(
            f"{name}.frame_residual: cannot be traced by {way} ({line:.120}); expected "
            "jax.numpy, and no `if` on values."
        ) from error


@eqx.filter_jit
def _slope(factor: Factor, state: State) -> Step:
    cost = lambda step: factor.cost(state.retract(step))
    return jax.grad(cost)(state.zero_step())
