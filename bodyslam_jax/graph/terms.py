"""The name of each term of the cost, one everywhere.

`Problem.names`, `cost_by_term`, `weights`, `with_weights` and the summary of a run call
a term by the class of its factor without `Prior`, in lower case with underscores:
`human_motion`, `body_pose`, `shape`, `stature`; `landmarks` and `keypoints` are the two
reprojection terms. From the second term of a name on they are numbered: `tape_2`.
"""

import re
import warnings
from collections.abc import Sequence

import jax
from jaxtyping import Array, Float

from bodyslam_jax.graph.factor import Factor
from bodyslam_jax.graph.padding import Masked

_NAMES = {
    "Reprojection": "landmarks",
    "KeypointReprojection": "keypoints",
    "GroundContact": "ground",
    "LandmarkPrior": "landmark_prior",
}
"""Names of terms that do not follow from the name of the factor's class."""


def names_of_terms(factors: Sequence[Factor]) -> list[str]:
    """Returns the name of each factor's term."""
    names: list[str] = []
    count: dict[str, int] = {}
    for factor in factors:
        inner = factor.factor if isinstance(factor, Masked) else factor
        name = _of_class(type(inner).__name__)
        count[name] = count.get(name, 0) + 1
        names.append(name if count[name] == 1 else f"{name}_{count[name]}")
    return names


def name_of_term(name: str) -> str:
    """Returns the name of a term that is given by its factor's class, such as
    `HumanMotion_2`; any other name is returned as it is."""
    kind, _, number = name.partition("_")
    if not re.fullmatch(r"[A-Z]\w*", kind):
        return name
    return f"{_of_class(kind)}_{number}" if number else _of_class(kind)


def _of_class(kind: str) -> str:
    words = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", kind.removesuffix("Prior")).lower()
    return _NAMES.get(kind, words)


@jax.tree_util.register_pytree_with_keys_class
class TermCosts(dict[str, Float[Array, ""]]):
    """The cost of each term, by its name. The name of a factor's class, which was the
    key before, is understood with a `DeprecationWarning`."""

    def __missing__(self, name: str) -> Float[Array, ""]:
        new = name_of_term(name)
        if new not in self:
            raise KeyError(f"no term {name!r}, expected among {list(self)}")
        text = f"cost_by_term[{name!r}]: the term is called {new!r} now."
        warnings.warn(text, DeprecationWarning, stacklevel=2)
        return self[new]

    def tree_flatten_with_keys(self):
        """As JAX asks of a container: the costs with their keys, and the names."""
        names = tuple(self)
        return [(jax.tree_util.DictKey(n), self[n]) for n in names], names

    @classmethod
    def tree_unflatten(cls, names, costs):
        """The container of costs, whatever JAX puts in their place."""
        return cls(zip(names, costs, strict=True))
