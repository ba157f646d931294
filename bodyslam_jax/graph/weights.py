"""Reads the weights λ of a problem's terms, and replaces them without recompilation.

The paper writes its cost as `Σ λ ρ(e²)` (section 3.6). A factor holds the standard
deviation of each measurement instead, so `λ = σ⁻²`, averaged over the measurements of
the term that are not missing.
"""

import warnings
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bodyslam_jax.geometry.lengths import is_traced
from bodyslam_jax.graph.factor import Factor
from bodyslam_jax.graph.padding import Masked
from bodyslam_jax.graph.problem import Problem
from bodyslam_jax.graph.terms import name_of_term


def weights(problem: Problem) -> dict[str, Float[Array, ""]]:
    """Returns λ of each term, the mean inverse variance of its measurements.

    Terms have the names of `Problem.names`: `human_motion`, `body_pose`, `shape`,
    `stature`, ...; `landmarks` and `keypoints` are the two reprojection terms. Units
    are those of σ⁻²: px⁻², rad⁻², m⁻² or leg lengths⁻². A term whose measurements are
    all missing has 0; factors without a field `sigma` or `whitening` have no λ here.
    """
    found = {}
    for name, factor in zip(problem.names, problem.factors, strict=True):
        inner = factor.factor if isinstance(factor, Masked) else factor
        value = _mean_inverse_variance(inner)
        if value is not None:
            found[name] = value
    return found


def with_weights(
    problem: Problem, **weights: float | Float[Array, ""] | np.ndarray
) -> Problem:
    """Returns the problem with other λ: the cost of a term is λ times its robust loss.

    Standard deviations of a term are multiplied by one factor, and the scale of its
    robust loss with them, so that the same pixels or metres are an outlier. Shapes and
    compiled programs stay the same for all values. The result can be differentiated by,
    and mapped over, λ; λ = 0 is not allowed (`graph.disable` leaves a term out).

    **Raises:** `ValueError` for a term that the problem does not have, or a λ that is
    not positive and finite.
    """
    names = problem.names
    factors = list(problem.factors)
    for given, value in weights.items():
        name = given
        if given not in names and (name := name_of_term(given)) in names:
            text = f"with_weights({given}=...): the term is called {name!r}."
            warnings.warn(text, DeprecationWarning, stacklevel=2)
        if name not in names:
            raise ValueError(f"weights: no term {name!r}, expected among {names}.")
        _check(name, value)
        i = names.index(name)
        factors[i] = _weighted(name, factors[i], value)
    return eqx.tree_at(lambda p: p.factors, problem, tuple(factors))


def _mean_inverse_variance(factor: Factor) -> Float[Array, ""] | None:
    """Returns λ, 0 if all is missing; `None` without a standard deviation."""
    sigma, whitening = _field(factor, "sigma"), _field(factor, "whitening")
    if whitening is not None:
        variances = jnp.sum(whitening**2, axis=(-1, -2)) / whitening.shape[-1]
        present = variances > 0
    elif sigma is not None:
        present = jnp.isfinite(sigma)
        # An infinite sigma is missing, and its derivative would be NaN.
        variances = jnp.where(present, 1 / jnp.where(present, sigma, 1.0) ** 2, 0.0)
    else:
        return None
    count = jnp.maximum(present.sum(dtype=variances.dtype), 1)
    return jnp.sum(variances) / count


def _weighted(name: str, factor: Factor, value: Any) -> Factor:
    if isinstance(factor, Masked):
        inner = _weighted(name, factor.factor, value)
        return eqx.tree_at(lambda f: f.factor, factor, inner)
    before = _mean_inverse_variance(factor)
    if before is None:
        raise ValueError(
            f"weights.{name}: {type(factor).__name__} has no field `sigma` or "
            "`whitening`, expected one of them."
        )
    # A term without measurements stays as it is.
    empty = before == 0
    ratio = jnp.asarray(value, before.dtype) / jnp.where(empty, 1.0, before)
    root = jnp.sqrt(jnp.where(empty, 1.0, ratio))
    if (whitening := _field(factor, "whitening")) is not None:
        factor = eqx.tree_at(lambda f: f.whitening, factor, whitening * root)
    else:
        sigma = _field(factor, "sigma")
        missing = jnp.isinf(sigma)
        sigma = jnp.where(missing, jnp.inf, jnp.where(missing, 1.0, sigma) / root)
        factor = eqx.tree_at(lambda f: f.sigma, factor, sigma)
    scale = getattr(factor.loss, "scale", None)
    if scale is None:
        return factor
    return eqx.tree_at(
        lambda f: f.loss.scale, factor, jnp.asarray(scale, before.dtype) * root
    )


def _field(factor: Factor, name: str) -> Any:
    """Returns an array of a factor, `None` if it has none of this name."""
    value = getattr(factor, name, None)
    return value if eqx.is_array(value) else None


def _check(name: str, value: Any) -> None:
    if is_traced(value):
        return
    if np.ndim(value):
        raise ValueError(
            f"weights.{name}: shape {np.shape(value)}, expected one number; map over "
            "several with `jax.vmap`."
        )
    if not 0 < float(value) < np.inf:
        raise ValueError(f"weights.{name}: found {value}, expected above 0 and finite.")
