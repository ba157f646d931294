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


def residual(
    nodes: Nodes, edge: Edge
) -> tuple[Float[np.ndarray, " 7"], Float[np.ndarray, "7 14"]]:
    """Returns the error of an edge, and its derivative by the steps of both cameras
    (of the rotation, for small errors)."""
    a, b = edge.a, edge.b
    turn = nodes.R[a].T @ nodes.R[b]
    unit = np.exp(-(nodes.log_unit[a] + nodes.log_unit[b]) / 2)
    into = unit * nodes.R[a].T
    p = into @ (nodes.t[b] - nodes.t[a])
    r = np.concatenate(
        [
            so3.log(edge.T[:3, :3].T @ turn),
            p - edge.T[:3, 3],
            [nodes.log_unit[b] - nodes.log_unit[a] - edge.log_ratio],
        ]
    )
    J = np.zeros((7, 14))
    J[:3, :3], J[:3, 7:10] = -turn.T, np.eye(3)
    J[3:6, :3] = np.array([[0, -p[2], p[1]], [p[2], 0, -p[0]], [-p[1], p[0], 0]])
    J[3:6, 3:6], J[3:6, 10:13] = -into, into
    J[3:6, 6] = J[3:6, 13] = -p / 2
    J[6, 6], J[6, 13] = -1.0, 1.0
    return r, J


class PoseGraph:
    """The normal equations of all edges; the first camera is held."""

    def __init__(self, nodes: Nodes, edges: list[Edge]) -> None:
        self.nodes, self.edges = nodes, edges
        self.information = [np.linalg.inv(e.covariance) for e in edges]

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
        for k, edge in enumerate(edges):
            r, J = residual(self.nodes, edge)
            columns = np.zeros((7 * len(self.nodes.t), 7))
            columns[7 * edge.a : 7 * edge.a + 7] = J[:, :7].T
            columns[7 * edge.b : 7 * edge.b + 7] += J[:, 7:].T
            spread = columns[7:].T @ factor.solve(columns[7:])
            found[k] = r @ np.linalg.solve(spread + edge.covariance, r)
        return found

    def _factorised(self) -> tuple[SuperLU, Float[np.ndarray, " m"]]:
        """Returns the factorised information matrix of all cameras but the first, and
        the gradient."""
        size = 7 * len(self.nodes.t)
        slope, rows, blocks = np.zeros(size), [], []
        for edge, weight in zip(self.edges, self.information, strict=True):
            r, J = residual(self.nodes, edge)
            if edge.loop:
                weight = weight / (1 + r @ weight @ r / _WIDTH)
            own = [np.arange(7 * k, 7 * k + 7) for k in (edge.a, edge.b)]
            at = np.concatenate(own)
            slope[at] += J.T @ weight @ r
            rows.append(at)
            blocks.append(J.T @ weight @ J)
        at = np.array(rows)
        i, j = np.broadcast_arrays(at[:, :, None], at[:, None, :])
        shape = size, size
        matrix = sparse.coo_matrix((np.ravel(blocks), (i.ravel(), j.ravel())), shape)
        return splu(matrix.tocsc()[7:, 7:]), slope[7:]
