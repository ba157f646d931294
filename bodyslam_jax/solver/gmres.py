"""GMRES that applies its operator in one place, and knows whether it converged.

JAX' own does neither: an operator as large as ours stands in its program seven times,
which then takes as much longer to compile, and nobody learns what is left. Saad and
Schultz, GMRES (1986).
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy as jsp
from jaxtyping import Array, Bool, Float, Int

RESTART = 100
"""Directions at most: outliers bend the cost in as many as there are, and each must
have been seen. With 20 at a time a path of 120 frames did not converge."""
CYCLES = 2
CLOSE = 1e-3
"""Share of the solution by which it may be wrong; in most cases it is far less."""


class _Search(eqx.Module):
    """Between two passes: one for what is left of `b`, then one for each direction."""

    x: Float[Array, " n"]
    basis: Float[Array, "k n"]
    table: Float[Array, "k j"]
    """What the operator makes of one direction, in terms of all."""
    length: Float[Array, ""]
    """Of what was left when the cycle began."""
    whole: Float[Array, ""]
    """The same at the very first."""
    known: Int[Array, ""]
    """Directions in this cycle."""
    cycle: Int[Array, ""]
    ended: Bool[Array, ""]


def gmres(
    left_of: Callable[[Array, Array], Array], like: Float[Array, " n"], rtol: float
) -> Float[Array, " n"]:
    """The `x` of `A x = b`, or NaN if it was not found.

    `left_of(x, share)` is `M (share b - A x)`, where `M` is about the inverse of `A`:
    what is left is then about the error of `x`, of which all numbers should be of one
    unit. It ends where that is `rtol` of the whole, or does not halve in a cycle any
    more, as where rounding shows; within `CLOSE` of the whole counts as found.
    """
    zero = jnp.zeros_like(like, shape=())
    # Of a direction that is not known yet: a row of its own, so that it has no share.
    none = jnp.eye(RESTART + 1, RESTART, -1, dtype=like.dtype)
    start = _Search(
        x=jnp.zeros_like(like),
        basis=jnp.zeros_like(like, shape=(RESTART + 1, like.size)),
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
        # Once leaves too much of the other directions, twice does not.
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
        full = ~first & ((s.known == RESTART) | ~(left > rtol * whole))
        stalls = (s.cycle > 0) & ~(size < 0.5 * s.length)
        over = ~(size > rtol * whole) | stalls | (s.cycle == CYCLES)
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
    return jnp.where(found.length <= CLOSE * found.whole, found.x, jnp.nan)
