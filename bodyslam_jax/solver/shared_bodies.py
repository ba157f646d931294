"""Body models that several factors share are given to a program once.

Each factor has the body model among its fields. Were it an argument of a compiled
program for each of them, XLA could not know that they are equal, and would compute the
same kinematics for each factor.
"""

from typing import TypeVar

import equinox as eqx
import jax

from bodyslam_jax.body import BodyModel

T = TypeVar("T")


class _Place(eqx.Module):
    """Stands for the body model with this index."""

    index: int = eqx.field(static=True)


def without_bodies(tree: T) -> tuple[T, tuple[BodyModel, ...]]:
    """Returns the tree with places in place of its body models, and each of these
    once. Models are the same if their arrays are the same objects."""
    known: dict[tuple, int] = {}
    bodies: list[BodyModel] = []

    def placed(x):
        if not _is_body(x):
            return x
        leaves, structure = jax.tree.flatten(x)
        key = (structure, *map(id, leaves))
        if key not in known:
            known[key] = len(bodies)
            bodies.append(x)
        return _Place(known[key])

    return jax.tree.map(placed, tree, is_leaf=_is_body), tuple(bodies)


def with_bodies(tree: T, bodies: tuple[BodyModel, ...]) -> T:
    """Returns the tree of which `without_bodies` made `tree` and `bodies`."""
    is_place = lambda x: isinstance(x, _Place)
    put = lambda x: bodies[x.index] if is_place(x) else x
    return jax.tree.map(put, tree, is_leaf=is_place)


def _is_body(x) -> bool:
    return isinstance(x, BodyModel)
