"""Whitening of residuals by a covariance, and of AR(1) errors."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


def innovation(
    error: Float[Array, "*n"],
    previous: Float[Array, "*n"],
    correlation: Float[Array, "*#n"],
) -> Float[Array, "*n"]:
    """Returns the innovation of an AR(1) error, `(e_k - ρ e_{k-1}) / sqrt(1 - ρ²)`.

    It has the stationary variance of the error and is independent of earlier
    innovations. With ρ = 0, at the start of a run, it is the error itself.
    """
    return (error - correlation * previous) / jnp.sqrt(1 - correlation**2)


@jax.jit
def ar1_correlation(
    present: Bool[Array, "h t"], correlation: float | Float[Array, ""]
) -> Float[Array, "h t"]:
    """Returns ρ where this frame and the one before are measured, else 0."""
    before = jnp.concatenate([jnp.zeros_like(present[:, :1]), present[:, :-1]], axis=1)
    return jnp.where(present & before, correlation, 0.0)


def whitening_of(
    covariance: Float[Array, "*b 3 3"], valid: Bool[Array, "*b"]
) -> Float[Array, "*b 3 3"]:
    """Returns `W` with `W^T W` the inverse of the covariance; 0 where not valid."""
    eye = jnp.eye(3, dtype=covariance.dtype)
    safe = jnp.where(valid[..., None, None], covariance, eye)
    lower = jnp.linalg.cholesky(safe)
    inverse = jax.scipy.linalg.solve_triangular(
        lower, jnp.broadcast_to(eye, safe.shape), lower=True
    )
    return jnp.where(valid[..., None, None], inverse, 0.0)
