"""Cameras of a long video from their relative poses, with the drift of the map's unit.

A node is a camera: rotation and centre in the corrected map, and the logarithm ℓ of
the length there of one local unit. An edge (a, b) measures b relative to a, in the
geometric mean of their units, and the ratio of the units:

    r = (log(Rₑᵀ Rₐᵀ R_b),  exp(-(ℓₐ + ℓ_b)/2) Rₐᵀ (t_b - tₐ) - tₑ,  ℓ_b - ℓₐ - ℓₑ)

Relative poses and scales of a similarity (Strasdat, Montiel, Davison, Scale
drift-aware large scale monocular SLAM, 2010) in a chart of our own.
"""

import dataclasses

import numpy as np
from jaxtyping import Float
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu

from bodyslam_jax.geometry import so3_numpy as so3

_MAX_STEPS = 20
_DOF = 7
"""Degrees of freedom of a similarity, Sim(3): rotation, translation, scale."""
_MIN_STEP = 1e-7
"""Largest component of a step at which the solve has converged."""
_WIDTH = 7.0
"""Squared normalised error at which the weight of a loop's edge is a half (Cauchy):
its expectation."""


@dataclasses.dataclass(frozen=True)
class Edge:
    """A measured relative pose."""

    a: int
    b: int
    T: Float[np.ndarray, "4 4"]
    """Pose of camera b in the frame of camera a, in the mean of their units."""
    log_ratio: float
    """Logarithm of the unit at b in units at a."""
    covariance: Float[np.ndarray, "7 7"]
    """Of rotation (in the frame of b, rad), translation and `log_ratio`."""
    loop: bool = False
    """True if it is not between successive cameras, and may be wrong."""


@dataclasses.dataclass(frozen=True)
class Nodes:
    """Cameras with their units: those of the map, or the corrected ones."""

    R: Float[np.ndarray, "n 3 3"]
    """Camera to map."""
    t: Float[np.ndarray, "n 3"]
    log_unit: Float[np.ndarray, " n"]

    def move(self, step: Float[np.ndarray, "n 7"]) -> "Nodes":
        return dataclasses.replace(
            self,
            R=so3.nearest(self.R @ so3.exp(step[:, :3])),
            t=self.t + step[:, 3:6],
            log_unit=self.log_unit + step[:, 6],
        )


def residuals(
    nodes: Nodes, edges: list[Edge]
) -> tuple[Float[np.ndarray, "k 7"], Float[np.ndarray, "k 7 14"]]:
    """Returns the errors of edges, and their derivatives by the steps of both cameras
    (of the rotation, for small errors)."""
    a, b = np.array([e.a for e in edges]), np.array([e.b for e in edges])
    T = np.array([e.T for e in edges])
    into = np.swapaxes(nodes.R[a], 1, 2)
    turn = into @ nodes.R[b]
    ratio = nodes.log_unit[b] - nodes.log_unit[a]
    into = into * np.exp(-nodes.log_unit[a] - ratio / 2)[:, None, None]
    p = (into @ (nodes.t[b] - nodes.t[a])[..., None])[..., 0]
    r = np.zeros((len(edges), 7))
    r[:, :3] = so3.log(np.swapaxes(T[:, :3, :3], 1, 2) @ turn)
    r[:, 3:6] = p - T[:, :3, 3]
    r[:, 6] = ratio - np.array([e.log_ratio for e in edges])
    J = np.zeros((len(edges), 7, 14))
    J[:, :3, :3], J[:, :3, 7:10] = -np.swapaxes(turn, 1, 2), np.eye(3)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        J[:, 3 + i, j], J[:, 3 + i, k] = -p[:, k], p[:, j]
    J[:, 3:6, 3:6], J[:, 3:6, 10:13] = -into, into
    J[:, 3:6, 6] = J[:, 3:6, 13] = -p / 2
    J[:, 6, 6], J[:, 6, 13] = -1.0, 1.0
    return r, J


class PoseGraph:
    """The normal equations of all edges; the first camera is held."""

    def __init__(self, nodes: Nodes, edges: list[Edge]) -> None:
        self.nodes, self.edges = nodes, edges
        self.information = np.linalg.inv(np.array([e.covariance for e in edges]))
        self.loop = np.array([e.loop for e in edges])
        own = np.array([[e.a, e.b] for e in edges])
        self.rows = (_DOF * own[..., None] + np.arange(_DOF)).reshape(-1, 14)
        """Index of each component of the two cameras of an edge."""

    def solve(self) -> Nodes:
        """Returns the most probable cameras (Gauss--Newton; weights of loops are those
        of a Cauchy loss)."""
        for _ in range(_MAX_STEPS):
            factor, slope = self._factorised()
            step = np.concatenate([np.zeros(7), -factor.solve(slope)]).reshape(-1, 7)
            self.nodes = self.nodes.move(step)
            if np.abs(step).max() < _MIN_STEP:
                break
        return self.nodes

    def squared_error(self, edges: list[Edge]) -> Float[np.ndarray, " k"]:
        """Returns the squared normalised error of edges that are not in the graph: by
        their own covariance and that of their prediction from the graph."""
        factor, _ = self._factorised()
        found = np.zeros(len(edges))
        for k, (r, J) in enumerate(zip(*residuals(self.nodes, edges), strict=True)):
            columns = np.zeros((_DOF * len(self.nodes.t), _DOF))
            a, b = _DOF * edges[k].a, _DOF * edges[k].b
            columns[a : a + 7], columns[b : b + 7] = J[:, :7].T, J[:, 7:].T
            spread = columns[7:].T @ factor.solve(columns[7:])
            found[k] = r @ np.linalg.solve(spread + edges[k].covariance, r)
        return found

    def _factorised(self) -> tuple[SuperLU, Float[np.ndarray, " m"]]:
        """Returns the factorised information matrix of all cameras but the first, and
        the gradient."""
        r, J = residuals(self.nodes, self.edges)
        squared = np.einsum("ki,kij,kj->k", r, self.information, r)
        weight = np.where(self.loop, 1 / (1 + squared / _WIDTH), 1.0)
        pulled = np.swapaxes(J, 1, 2) @ (self.information * weight[:, None, None])
        size = _DOF * len(self.nodes.t)
        slope = np.zeros(size)
        np.add.at(slope, self.rows, (pulled @ r[..., None])[..., 0])
        blocks = pulled @ J
        i, j = np.broadcast_arrays(self.rows[:, :, None], self.rows[:, None, :])
        entries = blocks.ravel(), (i.ravel(), j.ravel())
        matrix = sparse.coo_matrix(entries, (size, size))
        # The matrix is symmetric and positive definite: no pivots, ordered as such.
        given = {"permc_spec": "MMD_AT_PLUS_A", "diag_pivot_thresh": 0.0}
        options = {"SymmetricMode": True}
        return splu(matrix.tocsc()[7:, 7:], **given, options=options), slope[7:]
