"""GMRES that traces its operator once, and reports failure to converge.

JAX's own does neither: it traces the operator seven times, which takes as much longer
to compile, and returns no residual. Saad and Schultz, GMRES (1986).
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy as jsp
from jaxtyping import Array, Bool, Float, Int

MAX_DIRECTIONS = 100
"""Maximum number of directions in a cycle. Every outlier changes the curvature in
another direction, and each has to be among them: with 20 at a time a path of 120 frames
did not converge."""
MAX_CYCLES = 2
"""Maximum number of cycles of `MAX_DIRECTIONS`."""
MAX_RELATIVE_ERROR = 1e-3
"""Share of the first residual below which a solution counts as found; in most cases it
is far smaller."""


class _Search(eqx.Module):
    """State between two passes: one for the residual, then one for each direction."""

    x: Float[Array, " n"]
    basis: Float[Array, "k n"]
    table: Float[Array, "k j"]
    """Hessenberg matrix: the operator's image of each direction, in terms of all."""
    length: Float[Array, ""]
    """Length of the residual when the cycle began."""
    whole: Float[Array, ""]
    """Length of the residual when the first cycle began."""
    known: Int[Array, ""]
    """Number of directions in this cycle."""
    cycle: Int[Array, ""]
    ended: Bool[Array, ""]


def gmres(
    left_of: Callable[[Array, Array], Array], like: Float[Array, " n"], rtol: float
) -> Float[Array, " n"]:
    """Returns the `x` of `A x = b`, or NaN if it was not found.

    `left_of(x, share)` is `M (share b - A x)`, where the preconditioner `M` is about
    the inverse of `A`: the residual is then about the error of `x`, whose coordinates
    should be of one unit. The iteration ends where the residual is `rtol` of the first
    one, or does not halve in a cycle, as at the level of rounding; `x` counts as found
    below `MAX_RELATIVE_ERROR` of the first one.
    """
    zero = jnp.zeros_like(like, shape=())
    # Columns of unknown directions are unit vectors, so that their coefficients are 0.
    none = jnp.eye(MAX_DIRECTIONS + 1, MAX_DIRECTIONS, -1, dtype=like.dtype)
    start = _Search(
        x=jnp.zeros_like(like),
        basis=jnp.zeros_like(like, shape=(MAX_DIRECTIONS + 1, like.size)),
        table=none,
        length=zero,
        whole=zero,
        known=jnp.array(0),
        cycle=jnp.array(0),
        ended=jnp.array(False),
    )

    def one(s: _Search) -> _Search:
        first = s.known == 0
        at = s.known - 1
        share = first.astype(like.dtype)
        given = jnp.where(first, s.x, s.basis[at])
        image = left_of(given, share) * (2 * share - 1)
        basis = jnp.where(first, 0.0, s.basis)
        # Orthogonalised twice: once leaves too much of the other directions.
        parts = basis @ image
        image = image - parts @ basis
        more = basis @ image
        image, parts = image - more @ basis, parts + more
        size = jnp.linalg.norm(image)
        unit = image / jnp.where(size > 0, size, 1.0)
        column = parts.at[s.known].set(size)
        table = jnp.where(first, none, s.table.at[:, at].set(column))
        length = jnp.where(first, size, s.length)
        whole = jnp.where(first & (s.cycle == 0), size, s.whole)
        target = jnp.zeros_like(column).at[0].set(length)
        q, r = jnp.linalg.qr(table)
        shares = jsp.linalg.solve_triangular(r, target @ q)
        left = jnp.linalg.norm(table @ shares - target)
        full = ~first & ((s.known == MAX_DIRECTIONS) | ~(left > rtol * whole))
        stalls = (s.cycle > 0) & ~(size < 0.5 * s.length)
        over = ~(size > rtol * whole) | stalls | (s.cycle == MAX_CYCLES)
        return _Search(
            x=jnp.where(full, s.x + shares @ basis[:-1], s.x),
            basis=basis.at[s.known].set(unit),
            table=table,
            length=length,
            whole=whole,
            known=jnp.where(full, 0, s.known + 1),
            cycle=jnp.where(full, s.cycle + 1, s.cycle),
            ended=first & over,
        )

    found = jax.lax.while_loop(lambda s: ~s.ended, one, start)
    return jnp.where(found.length <= MAX_RELATIVE_ERROR * found.whole, found.x, jnp.nan)
