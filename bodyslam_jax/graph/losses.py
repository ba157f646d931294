"""Whitening of residuals, and robust losses on whitened residuals.

A loss takes `s`, the squared norm of one measurement's whitened residual
(dimensionless), and gives the cost in the same unit: `rho(s) = s` near 0. Scales are
therefore in standard deviations; a scale `c` in pixels is `c / sigma`.

Least-squares solvers see a loss through `robustify`: `[sqrt(w) r, sqrt(rho - w s)]`
with `w = rho'(s)` held constant. Its squared norm is exactly `rho`, its gradient
exactly `rho' J^T r`, and its Gauss-Newton Hessian `rho' J^T J` is positive. The more
usual `r sqrt(rho / s)` has a bad Hessian.
"""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


class Loss(eqx.Module):
    """A function of the squared norm of a whitened residual."""

    @abc.abstractmethod
    def rho(self, s: Float[Array, "*m"]) -> Float[Array, "*m"]: ...

    @abc.abstractmethod
    def weight(self, s: Float[Array, "*m"]) -> Float[Array, "*m"]:
        """Returns the derivative of `rho`: (nearly) 1 at 0, and never negative."""


class Squared(Loss):
    """`rho(s) = s`"""

    def rho(self, s: Float[Array, "*m"]) -> Float[Array, "*m"]:
        return s

    def weight(self, s: Float[Array, "*m"]) -> Float[Array, "*m"]:
        return jnp.ones_like(s)


class Cauchy(Loss):
    """`rho(s) = c^2 log(1 + s / c^2)`, as in Ceres."""

    scale: float | Float[Array, ""]
    """c, standard deviations"""

    def rho(self, s: Float[Array, "*m"]) -> Float[Array, "*m"]:
        c2 = self.scale**2
        return c2 * jnp.log1p(s / c2)

    def weight(self, s: Float[Array, "*m"]) -> Float[Array, "*m"]:
        return 1 / (1 + s / self.scale**2)


class GemanMcClure(Loss):
    """`rho(s) = c^2 s / (c^2 + s)`: saturates at `c^2`.

    Bogo et al. (2016) apply it to x and y apart, with c = 100 px; here it takes the
    length of the pixel error, which is invariant to rotation of the image.
    """

    scale: float | Float[Array, "..."]
    """c, standard deviations; of `KeypointReprojection` one for each measurement, too:
    `c / sigma` of a c in px that is the same for all."""

    def rho(self, s: Float[Array, "*m"]) -> Float[Array, "..."]:
        c2 = self.scale**2
        return s * (c2 / (c2 + s))

    def weight(self, s: Float[Array, "*m"]) -> Float[Array, "..."]:
        c2 = self.scale**2
        return (c2 / (c2 + s)) ** 2


class BlakeZisserman(Loss):
    """`rho(s) = 2 log((1 + ε) / (exp(-s / 2) + ε))`, `ε = exp(-c^2 / 2)`: saturates
    near `c^2`.

    Minus twice the log-likelihood of Gaussian errors with uniform outliers
    (Blake and Zisserman 1987; Hartley and Zisserman 2004, A6.8). Inliers
    keep their weight, where `Cauchy(1.5)` takes a third of it at one standard
    deviation: estimates are more accurate, and covariances consistent. Measurements
    farther away than c have no influence, so start where another loss has converged:

        solution = solve(problem, state)
        where = lambda p: p.factors[0].loss
        problem = eqx.tree_at(where, problem, BlakeZisserman(4.5))
        solution = solve(problem, solution.state)
    """

    scale: float | Float[Array, ""]
    """c, standard deviations: where a measurement is as likely to be an outlier as not.
    If a share `p` are outliers, anywhere in `A` px^2, and the others have a standard
    deviation of `b` px, `c^2 = 2 log((1 - p) A / (2 π b^2 p))`."""

    def rho(self, s: Float[Array, "*m"]) -> Float[Array, "*m"]:
        never = -(self.scale**2) / 2
        far = jax.nn.softplus(never) - jnp.logaddexp(-s / 2, never)
        # An equal expression without cancellation, where the logarithms are close.
        less = jnp.expm1(-jnp.minimum(s, 1) / 2)
        near = -jnp.log1p(less * jax.nn.sigmoid(-never))
        return 2 * jnp.where(s < 1, near, far)

    def weight(self, s: Float[Array, "*m"]) -> Float[Array, "*m"]:
        return jax.nn.sigmoid((self.scale**2 - s) / 2)


def squared_norm(residual: Float[Array, "*m d"]) -> Float[Array, "*m"]:
    """Returns the squared norm of each measurement, unrolled for up to three
    coordinates, which is faster."""
    if residual.shape[-1] > 3:
        return jnp.sum(residual**2, axis=-1)
    return sum(
        (residual[..., i] ** 2 for i in range(1, residual.shape[-1])),
        residual[..., 0] ** 2,
    )


def robustify(loss: Loss, residual: Float[Array, "*m d"]) -> Float[Array, "*m d+1"]:
    """Returns residuals whose squared norm is the robust cost (see the module)."""
    s = squared_norm(residual)
    fixed = jax.lax.stop_gradient(s)
    weight = jax.lax.stop_gradient(loss.weight(fixed))
    rest = jnp.sqrt(jnp.maximum(loss.rho(fixed) - weight * fixed, 0))
    return jnp.concatenate(
        [
            jnp.sqrt(weight)[..., None] * residual,
            jax.lax.stop_gradient(rest)[..., None],
        ],
        axis=-1,
    )


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
