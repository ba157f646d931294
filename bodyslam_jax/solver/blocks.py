"""The blocks of the normal equations, and their sizes.

Names of blocks: `("pose", "root", d)` couples the pose of frame k with the root of
frame k - d; `alone` is a camera without a person.

A step turns joint j by `Exp((B z)_j)` on its right, with `p` coordinates z for each
person and frame, and B the columns of `Problem.basis`, or the identity (every turn).
Turns that are held have rows of zeros in B.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from bodyslam_jax.graph import CHUNK, TURNS, Problem, State, Step

CAMERAS = 6 * CHUNK
"""Coordinates of a chunk's cameras."""


class Sizes(eqx.Module):
    """Static sizes of a linearised problem."""

    people: int = eqx.field(static=True)
    chunks: int = eqx.field(static=True)
    bandwidth: int = eqx.field(static=True)
    reach: int = eqx.field(static=True)
    """Largest distance, in the order of elimination, of chunks adjacent in time."""
    intrinsics: int = eqx.field(static=True)
    """Number of intrinsics; 0 where they are held."""
    named: int = eqx.field(static=True)
    """Number of coordinates of named globals; 0 where they are held."""
    variables: tuple[str, ...] = eqx.field(static=True)
    lasting: int = eqx.field(static=True)
    """Number of landmarks that are eliminated last."""
    posture: int = eqx.field(static=True)
    """Number of coordinates of a posture."""
    dtype: np.dtype = eqx.field(static=True)
    """Precision of blocks and factors: the state's, or a lower one (see `solve`);
    landmarks' own blocks have the state's."""

    @property
    def common(self) -> int:
        """Width of scale, intrinsics and named globals, which no single person owns."""
        return 1 + self.intrinsics + self.named

    @property
    def own_globals(self) -> int:
        """Width of scale, intrinsics, named globals and the shape of one person."""
        return self.common + 10

    @property
    def globals(self) -> int:
        """Width of scale, intrinsics, named globals and all shapes."""
        return self.common + 10 * self.people

    @property
    def arrow(self) -> int:
        """Width of what is eliminated last: globals, then lasting landmarks."""
        return self.globals + 3 * self.lasting


class LandmarkBlocks(eqx.Module):
    """Blocks of one bucket: `n` groups of `g` landmarks over `f` frames."""

    cross: Float[Array, "n f 6 3 g"]
    """Camera against landmark."""
    cross_intrinsics: Float[Array, "n i 3 g"]
    own: Float[Array, "n 3 3 g"]
    """Landmark against itself, always in the precision of the state."""
    gradient: Float[Array, "n 3 g"]


class PriorBlocks(eqx.Module):
    """`J^T J` of a `MarginalPrior` over people in the first chunk, cameras of the first
    chunks, and globals."""

    matrix: Float[Array, "d d"]
    person: int = eqx.field(static=True)
    """Number of coordinates of a person: the last posture, then the last roots."""
    reach: int = eqx.field(static=True)
    """Number of these roots."""


class Linearisation(eqx.Module):
    """Blocks of `J^T J` and of the gradient `J^T r` at a state, and its cost."""

    blocks: dict[tuple[str, str, int], Array]
    """Blocks by person (except for cameras alone) and frame."""
    gradient: dict[str, Array]
    globals: Float[Array, "g g"]
    globals_gradient: Float[Array, " g"]
    landmarks: tuple[LandmarkBlocks, ...]
    costs: Float[Array, " k"]
    """Cost of each factor."""
    prior: PriorBlocks | None = None
    """Blocks of the marginal prior, whose globals' own block is in `globals`, too."""


def cast(tree, dtype: np.dtype):
    """Converts all floating-point arrays of a tree to another precision."""
    change = lambda x: x.astype(dtype) if eqx.is_inexact_array(x) else x
    return jax.tree.map(change, tree)


class Observations(eqx.Module):
    """Measurements of landmarks, gathered once per solve.

    The tables of all buckets, one after another, cut into `u` pieces of a chunk's `b`
    frames by `g` landmarks.
    """

    pixel: Float[Array, "u b 2 g"]
    weight: Float[Array, "u b g"]
    """1 / sigma; 0 where there is no observation."""
    chunk: Int[Array, " u"]
    landmark: Int[Array, "u g"]


class Sums:
    """Accumulates blocks by name, while tracing."""

    def __init__(self, sizes: Sizes, state: State):
        self.sizes = sizes
        self.blocks: dict[tuple[str, str, int], Array] = {}
        self.gradient: dict[str, Array] = {}
        self.costs: list[Array] = []
        self._of_globals: dict[int | None, tuple[Array, Array]] = {}
        dtype = state.scale.dtype
        none = jnp.zeros((sizes.globals, sizes.globals), dtype)
        self._all_globals = none, jnp.zeros(sizes.globals, dtype)

    def add(self, key: tuple[str, str, int], value: Array) -> None:
        value = value.astype(self.sizes.dtype)
        known = self.blocks.get(key)
        self.blocks[key] = value if known is None else known + value

    def add_gradient(self, name: str, value: Array) -> None:
        known = self.gradient.get(name)
        self.gradient[name] = value if known is None else known + value

    def add_globals(self, person: int | None, hessian: Array, gradient: Array) -> None:
        """Adds blocks over the globals of one person, or, with None, of no person."""
        known = self._of_globals.get(person)
        if known is not None:
            hessian, gradient = known[0] + hessian, known[1] + gradient
        self._of_globals[person] = hessian, gradient

    def add_all_globals(self, hessian: Array, gradient: Array) -> None:
        """Adds blocks over the globals of all people."""
        known = self._all_globals
        self._all_globals = known[0] + hessian, known[1] + gradient

    def globals(self) -> tuple[Float[Array, "g g"], Float[Array, " g"]]:
        """Returns the blocks over all globals, and their gradient."""
        hessian, gradient = self._all_globals
        for person, (own, slope) in self._of_globals.items():
            if len(slope) == len(gradient):
                hessian, gradient = hessian + own, gradient + slope
                continue
            index = own_to_global(self.sizes, person)
            hessian = hessian.at[index[:, None], index[None, :]].add(own)
            gradient = gradient.at[index].add(slope)
        return hessian, gradient


def shifted(x: Array, by: int, axis: int) -> Array:
    """Moves row k of an axis to row k + by, either way; zeros come in."""
    size = x.shape[axis]
    kept = jax.lax.slice_in_dim(x, max(-by, 0), size - max(by, 0), axis=axis)
    come_in = jnp.zeros_like(jax.lax.slice_in_dim(x, 0, abs(by), axis=axis))
    return jnp.concatenate([come_in, kept] if by > 0 else [kept, come_in], axis=axis)


def sizes_of(problem: Problem, state: State, dtype: np.dtype | None = None) -> Sizes:
    """Returns the sizes of a problem; `dtype` defaults to the state's precision."""
    size = lambda name, x: x.shape[0] if name in problem.variables else 0
    return Sizes(
        people=state.roots.shape[0],
        chunks=problem.layout.num_chunks,
        bandwidth=problem.layout.bandwidth,
        reach=problem.layout.reach,
        intrinsics=size("intrinsics", state.intrinsics),
        named=size("globals", state.globals),
        variables=problem.variables,
        lasting=problem.layout.lasting,
        posture=posture_width(problem),
        dtype=state.scale.dtype if dtype is None else dtype,
    )


def mask_of(problem: Problem) -> Step:
    """Returns the problem's mask, 0 for groups that are not among its variables."""
    parts = {
        name: value if name in problem.variables else jnp.zeros_like(value)
        for name, value in vars(problem.free).items()
    }
    return Step(**parts)


def globals_of(step: Step, sizes: Sizes) -> Float[Array, " g"]:
    """Returns all globals of a step in one vector, in the order of the corner."""
    return jnp.concatenate(
        [
            step.scale[None],
            step.intrinsics[: sizes.intrinsics],
            step.globals[: sizes.named],
            step.shapes.reshape(-1),
        ]
    )


def own_to_global(sizes: Sizes, person: int | None) -> Array:
    """Returns the indices of scale, intrinsics, named globals and the person's shape
    (none for `None`) among all globals."""
    common = jnp.arange(sizes.common)
    if person is None:
        return common
    return jnp.concatenate([common, len(common) + 10 * person + jnp.arange(10)])


def posture_width(problem: Problem) -> int:
    """Returns the number p of coordinates of one posture in a step."""
    return TURNS if problem.basis is None else problem.basis.shape[1]


def basis_of(problem: Problem, dtype) -> Float[Array, "69 p"]:
    """Returns the matrix B from coordinates to turns (rad), with no turn held."""
    if problem.basis is None:
        return jnp.eye(TURNS, dtype=dtype)
    return problem.basis.astype(dtype)


def to_coordinates(
    problem: Problem, columns: Float[Array, "*b 69"]
) -> Float[Array, "*b p"]:
    """Converts derivatives by turns, of which none is held, into derivatives by
    coordinates: columns `J B`."""
    return columns if problem.basis is None else columns @ problem.basis


def from_turns(
    problem: Problem, slope: Float[Array, "h t 23 3"]
) -> Float[Array, "h t p"]:
    """Converts a gradient by turns, 0 where they are held, into one by coordinates:
    `B^T slope`."""
    held = problem.free.poses * slope
    return to_coordinates(problem, held.reshape(*slope.shape[:2], TURNS))


def to_turns(
    problem: Problem, moved: Float[Array, "h t p"]
) -> Float[Array, "h t 23 3"]:
    """Returns the turns `B z` (rad) of a step, 0 where they are held."""
    free = problem.free.poses
    if problem.basis is not None:
        moved = moved @ problem.basis.T.astype(moved.dtype)
    return free.astype(moved.dtype) * moved.reshape(free.shape)
