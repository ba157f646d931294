"""Groups of variables that one chunk of a person touches, and blocks between them.

    before       last posture of the chunk before
    old_roots    its last roots, as many as terms reach back
    old_cameras  its last cameras, as many
    sep          last posture of this chunk
    inner        its roots but the last ones
    roots        its last roots
    cameras      all its cameras
    common       scale, intrinsics and shape of the person; and the right-hand side

`inner` is eliminated with the chunk; its Schur complement couples two chunks.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.graph import CHUNK
from bodyslam_jax.solver.blocks import Linearisation, Sizes

KEPT_GROUPS = (
    "before",
    "old_roots",
    "old_cameras",
    "sep",
    "roots",
    "cameras",
    "common",
)
"""The groups that are not eliminated with the chunk, in this order."""

Pairs = dict[tuple[str, str], Array]
"""Blocks between groups, rows by columns; each pair once, absent where 0."""


class Window(eqx.Module):
    """Static sizes of the groups."""

    pose: int = eqx.field(static=True)
    """Number of coordinates of a posture; 0 where postures are not variables."""
    cross: bool = eqx.field(static=True)
    """Whether postures couple with cameras, or with roots of other frames."""
    reach: int = eqx.field(static=True)
    """Number of frames that factors of roots and cameras reach back."""
    own_globals: int = eqx.field(static=True)

    @property
    def widths(self) -> dict[str, int]:
        last = 6 * self.reach
        return {
            "before": self.pose,
            "old_roots": last,
            "old_cameras": last,
            "sep": self.pose,
            "inner": 6 * CHUNK - last,
            "roots": last,
            "cameras": 6 * CHUNK,
            "common": self.own_globals + 1,
        }

    @property
    def person(self) -> int:
        """Number of coordinates of a person's last posture and last roots."""
        return self.pose + 6 * self.reach

    def slices(self, names: tuple[str, ...]) -> dict[str, slice]:
        """Returns the slices of groups that stand one after another."""
        found, start = {}, 0
        for name in names:
            found[name] = slice(start, start + self.widths[name])
            start += self.widths[name]
        return found


def window_of(lin: Linearisation, sizes: Sizes) -> Window:
    """Returns the window that holds every block of a linearisation.

    **Raises:** `ValueError` if a factor couples frames that lie too far apart.
    """
    cross, reach = False, 0
    for first, other, lag in lin.blocks:
        limit = 1 if first == "pose" else CHUNK - 1
        if abs(lag) > limit:
            raise ValueError(
                f"a factor couples {first} and {other} {abs(lag)} frames apart; the "
                f"structured solver knows {limit} at most: solve with a baseline, or "
                "as several factors."
            )
        if first == "pose" and other in ("root", "camera"):
            cross |= other == "camera" or lag != 0
        if first in ("pose", "root") and other in ("root", "camera"):
            reach = max(reach, abs(lag))
    if lin.prior is not None:
        reach = max(reach, lin.prior.reach)
    pose = sizes.posture if "pose" in lin.gradient else 0
    return Window(pose, cross, reach, sizes.own_globals)


def _block(pairs: Pairs, row: str, column: str) -> Array | None:
    """Returns the block between two groups, either way round; `None` where it is 0."""
    if (row, column) in pairs:
        return pairs[row, column]
    other = pairs.get((column, row))
    return None if other is None else other.swapaxes(-1, -2)


def matrix_of(
    window: Window, pairs: Pairs, rows: tuple[str, ...], columns: tuple[str, ...]
) -> Float[Array, "*b _ _"]:
    """Returns the matrix of blocks between groups of rows and groups of columns."""
    like = next(iter(pairs.values()))
    zeros = lambda p, q: jnp.zeros((*like.shape[:-2], p, q), like.dtype)
    widths = window.widths
    lines = []
    for row in rows:
        line = [_block(pairs, row, column) for column in columns]
        line = [
            zeros(widths[row], widths[column]) if block is None else block
            for block, column in zip(line, columns, strict=True)
        ]
        lines.append(jnp.concatenate(line, axis=-1))
    return jnp.concatenate(lines, axis=-2)


def add_pairs(first: Pairs, second: Pairs) -> Pairs:
    """Returns the sum of both, whichever way round their blocks are held."""
    total = dict(first)
    for (row, column), block in second.items():
        if (row, column) in total:
            total[row, column] = total[row, column] + block
        elif (column, row) in total:
            total[column, row] = total[column, row] + block.swapaxes(-1, -2)
        else:
            total[row, column] = block
    return total


def spread(
    block: Float[Array, "*n B p q"], row: int, column: int, reach: int
) -> Float[Array, "*n _ _"]:
    """Places the block of each frame k of a chunk at frames k - `row` and k - `column`
    of the matrix over the chunk's frames and the `reach` before it.

    It multiplies with shifted identities, as scatters of small blocks are slow.
    """
    n = block.ndim - 3
    length = CHUNK + reach
    before = reach - row
    pad = [(0, 0)] * n + [(before, length - CHUNK - before), (0, 0), (0, 0)]
    tall = jnp.pad(block, pad)[..., None, :]
    where = jnp.eye(length, k=row - column, dtype=block.dtype)
    wide = tall * where[:, None, :, None]
    return wide.reshape(
        *block.shape[:n], length * block.shape[-2], length * block.shape[-1]
    )
