"""Named variables that all frames have in common, with their priors.

A clock's offset, a lever arm, the direction of gravity, the height of a plane: whatever
is one number or a few for the whole video stands in `State.globals`, one after another,
and `Problem.globals` has the names. The solver eliminates them last, with the scale, in
the dense corner of the arrowhead matrix. A factor reads one as `shared["name"]` and has
`("name", 0)` among its `keys`.

    r = (x - x̃) / σ

is the prior of each (`GlobalPrior`). Steps are added; a direction is written in two
coordinates of a chart around its first estimate.
"""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bodyslam_jax.geometry.lengths import is_traced
from bodyslam_jax.graph.factor import BUILT_IN_VARIABLES, Factor, FrameFactor, Key
from bodyslam_jax.graph.losses import Loss, Squared

Named = tuple[tuple[str, int], ...]
"""Names and sizes of globals, in the order of `State.globals`."""


@dataclasses.dataclass(frozen=True)
class Variable:
    """The first value of a named global, and its prior."""

    value: float | Sequence[float] | np.ndarray | Array
    """One number or a vector, in the variable's own unit."""
    sigma: float | Sequence[float] | np.ndarray | Array = np.inf
    """Standard deviation of the prior about `value`, of each coordinate or one for all;
    `inf` for no prior."""


class GlobalPrior(FrameFactor):
    """`r = (x - x̃) / σ` of one named global; one row for the whole video."""

    mean: Float[Array, " n"]
    """x̃"""
    sigma: Float[Array, " n"]
    """`inf` for coordinates without a prior."""
    name: str = eqx.field(static=True)
    loss: Loss = Squared()

    @property
    def keys(self) -> tuple[Key, ...]:
        return ((self.name, 0),)

    def data(self):
        return self.mean[None], self.sigma[None]

    def frame_residual(self, data, window, shared):
        mean, sigma = data
        return (shared[self.name] - mean) / sigma


def bound(factor: Factor, named: Named) -> Factor:
    """Returns the factor with the slices of the named globals that it depends on.

    **Raises:** `ValueError` if one of them is not among `named`.
    """
    names = named_keys(factor)
    if not names:
        return factor
    ends = list(itertools.accumulate(size for _, size in named))
    places = {n: (n, e - size, e) for (n, size), e in zip(named, ends, strict=True)}
    unknown = [name for name in names if name not in places]
    if unknown:
        raise ValueError(
            f"{type(factor).__name__}.keys: no variable {unknown[0]!r}, expected among "
            f"{[*BUILT_IN_VARIABLES, *places]}; add it first: `problem, state = "
            f"problem.with_variables(state, {unknown[0]}=Variable(value, sigma))`."
        )
    at = tuple(places[name] for name in names)
    return dataclasses.replace(factor, globals_at=at)


def named_keys(factor: Factor) -> tuple[str, ...]:
    """Returns the names of the named globals among a factor's `keys`."""
    if not isinstance(factor, FrameFactor):
        return ()
    return tuple(
        dict.fromkeys(n for n, _ in factor.keys if n not in BUILT_IN_VARIABLES)
    )


def vector_of(
    name: str, variable: Variable, dtype: Any
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Returns the first value and standard deviation of a variable, as vectors.

    **Raises:** `ValueError` for a name that is taken or no identifier, a value that is
    not finite, or a sigma that is not above 0.
    """
    if name in BUILT_IN_VARIABLES or not name.isidentifier():
        raise ValueError(
            f"variables: {name!r}, expected an identifier other than "
            f"{list(BUILT_IN_VARIABLES)}."
        )
    value = jnp.atleast_1d(jnp.asarray(variable.value, dtype))
    if value.ndim != 1 or not value.size:
        raise ValueError(
            f"variables.{name}: shape {value.shape}, expected one number or a vector."
        )
    sigma = jnp.broadcast_to(jnp.asarray(variable.sigma, dtype), value.shape)
    if not is_traced(value) and not np.isfinite(np.asarray(value)).all():
        raise ValueError(f"variables.{name}: {value}, expected finite numbers.")
    if not is_traced(sigma) and not (np.asarray(sigma) > 0).all():
        raise ValueError(f"variables.{name}: sigma {sigma}, expected above 0.")
    return value, sigma


def split(
    named: Named, values: Float[Array, "*b g"]
) -> Mapping[str, Float[Array, "*b _"]]:
    """Returns each named global of a vector of all, by its name."""
    ends = list(itertools.accumulate(size for _, size in named))
    return {
        name: values[..., end - size : end]
        for (name, size), end in zip(named, ends, strict=True)
    }
