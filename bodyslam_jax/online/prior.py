"""Changes of a window's prior between solves: padding, process noise of s, people who
leave.

The prior is `½ |W (x ⊖ x̂) + b|²` (`graph.MarginalPrior`), or in information form
`½ δ^T Λ δ + η^T δ` of the step δ from x̂, with `Λ = W^T W` and `η = W^T b`.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from bodyslam_jax import graph
from bodyslam_jax.geometry.lengths import put
from bodyslam_jax.solver.marginalisation import square_root

POSTURE = 69
"""Number of coordinates of a posture."""


def no_prior(state: graph.State, frames: int, reach: int) -> graph.MarginalPrior:
    """Returns a prior without information on the first `frames` frames of a state."""
    estimate = _first_frames(state, frames)
    size = len(_places(estimate, reach).order)
    dtype = state.scale.dtype
    return graph.MarginalPrior(
        root=jnp.zeros((size, size), dtype),
        offset=jnp.zeros(size, dtype),
        estimate=estimate,
        anchor=jnp.zeros(frames, dtype),
        invariant=jnp.zeros(3, dtype),
        reach=reach,
    )


def with_scale(prior: graph.MarginalPrior, sigma: float) -> graph.MarginalPrior:
    """Returns the prior, which has no information on s, with s at its estimate and this
    standard deviation; unchanged if `sigma` is NaN."""
    if np.isnan(sigma):
        return prior
    root = np.array(prior.root)
    root[0, 0] = 1 / sigma
    return dataclasses.replace(prior, root=put(root))


def padded(
    prior: graph.MarginalPrior, state: graph.State, frames: int
) -> graph.MarginalPrior:
    """Returns the prior as one of the first `frames` frames of a state, so that all
    windows have priors of one shape. It has no information on the frames that are
    added.

    `state` is that at which the prior was made, from its first frame on.
    """
    more = frames - prior.frames
    if more == 0:
        return prior
    estimate = _first_frames(state, frames)
    small, large = (_places(e, prior.reach) for e in (prior.estimate, estimate))
    at = np.concatenate([large.head, large.cameras[: 6 * prior.frames], large.tail])
    order = np.concatenate([small.head, small.cameras, small.tail])
    size = len(large.order)
    root, offset = np.zeros((size, size)), np.zeros(size)
    rows = np.arange(len(order))
    root[np.ix_(rows, at)] = np.asarray(prior.root)[:, order]
    offset[rows] = np.asarray(prior.offset)
    dtype = prior.root.dtype
    return dataclasses.replace(
        prior,
        root=jnp.asarray(root, dtype),
        offset=jnp.asarray(offset, dtype),
        estimate=estimate,
        anchor=jnp.asarray(np.pad(np.asarray(prior.anchor), (0, more)), dtype),
    )


def with_walk_of_scale(
    prior: graph.MarginalPrior, variance: float
) -> graph.MarginalPrior:
    """Returns the prior after a random step of s with this variance (prediction step of
    a random walk).

    `Λ' = Λ - Λ e (1/q + e^T Λ e)^-1 e^T Λ` is `(Λ^-1 + q e e^T)^-1`, also where Λ has
    no inverse; the mean stays.
    """
    matrix, slope = information(prior)
    column, own = matrix[:, 0], matrix[0, 0]
    if own <= 0 or variance <= 0:
        return prior
    gain = column / (1 / variance + own)
    return _of_information(
        prior, matrix - np.outer(gain, column), slope - gain * slope[0]
    )


def with_drift_of_scale(
    prior: graph.MarginalPrior, ratio: float
) -> graph.MarginalPrior:
    """Returns the prior after s has been multiplied by a known ratio, as the map's unit
    became longer by it while the map stayed as it is."""
    root = np.array(prior.root)
    root[:, 0] /= ratio
    dtype = prior.estimate.scale.dtype
    scale = put(np.asarray(prior.estimate.scale, dtype) * np.asarray(ratio, dtype))
    estimate = dataclasses.replace(prior.estimate, scale=scale)
    return dataclasses.replace(prior, root=put(root), estimate=estimate)


def without_person(prior: graph.MarginalPrior, h: int) -> graph.MarginalPrior:
    """Returns the prior with the coordinates of person `h` marginalised: it has no
    information on the next person in that slot."""
    places = _places(prior.estimate, prior.reach)
    gone = places.of_person(h)
    matrix, slope = information(prior)
    known = gone[np.diag(matrix)[gone] > 0]
    if len(known):
        own = matrix[np.ix_(known, known)]
        gain = matrix[:, known] @ np.linalg.pinv(own, rcond=1e-10, hermitian=True)
        slope = slope - gain @ slope[known]
        matrix = matrix - gain @ matrix[known]
        matrix[known], matrix[:, known], slope[known] = 0.0, 0.0, 0.0
    return _of_information(prior, (matrix + matrix.T) / 2, slope)


def information(
    prior: graph.MarginalPrior,
) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, " n"]]:
    """Returns Λ and η."""
    root, offset = np.asarray(prior.root), np.asarray(prior.offset)
    return root.T @ root, root.T @ offset


def _of_information(
    prior: graph.MarginalPrior, matrix: np.ndarray, slope: np.ndarray
) -> graph.MarginalPrior:
    dtype = prior.root.dtype
    root, offset = square_root(matrix, slope, float(np.finfo(dtype).eps))
    return dataclasses.replace(
        prior, root=jnp.asarray(root, dtype), offset=jnp.asarray(offset, dtype)
    )


@dataclasses.dataclass(frozen=True)
class _Places:
    """Indices of the variables in a prior's coordinates
    (`marginal_prior.coordinates`)."""

    head: Int[np.ndarray, " a"]
    """Scale, intrinsics, named globals and shapes."""
    cameras: Int[np.ndarray, " b"]
    tail: Int[np.ndarray, " c"]
    """Roots, then postures."""
    people: int
    reach: int

    @property
    def order(self) -> Int[np.ndarray, " n"]:
        return np.concatenate([self.head, self.cameras, self.tail])

    def of_person(self, h: int) -> Int[np.ndarray, " k"]:
        """Returns the indices of shape, roots and posture of one person."""
        shapes = self.head[len(self.head) - 10 * self.people :].reshape(-1, 10)
        roots = 6 * self.reach
        split = self.people * roots
        of_roots = self.tail[:split].reshape(self.people, roots)
        postures = self.tail[split:].reshape(self.people, POSTURE)
        return np.concatenate([shapes[h], of_roots[h], postures[h]])


def _places(estimate: graph.State, reach: int) -> _Places:
    people = len(estimate.shapes)
    head = 1 + len(estimate.intrinsics) + len(estimate.globals) + 10 * people
    cameras = 6 * len(estimate.cameras)
    tail = people * (6 * reach + POSTURE)
    ends = np.cumsum([head, cameras, tail])
    return _Places(
        np.arange(ends[0]),
        np.arange(ends[0], ends[1]),
        np.arange(ends[1], ends[2]),
        people,
        reach,
    )


def _first_frames(state: graph.State, frames: int) -> graph.State:
    return dataclasses.replace(
        state,
        cameras=put(np.asarray(state.cameras)[:frames]),
        roots=put(np.asarray(state.roots)[:, :frames]),
        poses=put(np.asarray(state.poses)[:, :frames]),
        landmarks=put(np.asarray(state.landmarks)[:0]),
    )
