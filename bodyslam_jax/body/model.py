"""The parameters of SMPL as arrays."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int


class BodyModel(eqx.Module):
    """SMPL (Loper et al., 2015) with `v` vertices and `p` pose blend shapes.

    The rest pose is a T pose in frame H: x to the subject's left, y up, z forward.
    """

    template: Float[Array, "v 3"]
    """Rest vertices of the mean shape, m."""
    shape_dirs: Float[Array, "v 3 10"]
    """Shape blend shapes: displacement of vertices per unit of β, m."""
    pose_dirs: Float[Array, "v 3 p"]
    """Pose blend shapes: displacement of vertices per entry of `R - I` of joints 1, 2,
    ..., m; p may be 0."""
    joint_template: Float[Array, "24 3"]
    """Joints of the mean shape at rest, m; the first is `J_0(β=0)`."""
    joint_shape_dirs: Float[Array, "24 3 10"]
    """Displacement of joints at rest per unit of β, m."""
    joint_regressor: Float[Array, "24 v"]
    """Weights of the rest vertices in each joint; used only to write files."""
    skin_joint: Int[Array, "v k"]
    """The joints that each vertex follows; padded with joint 0."""
    skin_weight: Float[Array, "v k"]
    """Skinning weight of each of these joints; rows sum to 1, 0 is padding."""
    faces: Int[Array, "f 3"]
    """Vertices of the triangles."""
    picks: Int[Array, " 12"]
    """The vertices of `SURFACE_POINTS`."""
    blocks: tuple[tuple[int, int, tuple[int, ...]], ...] = eqx.field(static=True)
    """Runs of vertices (first, one past the last), each with the joints that its
    vertices follow."""
    name: str = eqx.field(static=True)
    """Name of the file without suffix."""
    kind: str = eqx.field(static=True)
    """Kind of the file: `default`, `smpl`, `smplh` or `smplx`."""
    sized: bool = eqx.field(static=True, default=False)
    """True if the last component of β is the size of the whole body, in place of the
    file's (`people.with_size_axis`)."""

    @property
    def num_vertices(self) -> int:
        """Number of vertices `v`."""
        return self.template.shape[0]

    @property
    def dtype(self) -> jnp.dtype:
        """Floating-point type of the arrays."""
        return self.template.dtype


def sparse_rows(
    weights: Float[np.ndarray, "v 24"],
) -> tuple[Int[np.ndarray, "v k"], Float[np.ndarray, "v k"]]:
    """Returns joint and weight of the non-zero entries of each row, largest first,
    padded with weight 0."""
    width = max(1, int((weights != 0).sum(1).max()))
    joint = np.argsort(-np.abs(weights), axis=1, kind="stable")[:, :width]
    weight = np.take_along_axis(weights, joint, axis=1)
    return np.where(weight != 0, joint, 0).astype(np.int32), weight


def runs_of_vertices(
    weights: Float[np.ndarray, "v 24"],
) -> tuple[tuple[int, int, tuple[int, ...]], ...]:
    """Splits the vertices, in the mesh's order, into runs that follow few joints each.

    Meshes list the parts of the body successively. The cuts minimise the sum of
    (vertices x joints), plus a constant per run for its compilation, by dynamic
    programming over cells of vertices; a body has about four runs.
    """
    v = len(weights)
    cell, price = max(1, -(-v // 400)), float(v + 1000)
    starts = [*range(0, v, cell), v]
    follows = [(weights[a:b] != 0).any(0) for a, b in zip(starts, starts[1:])]
    best, back = [0.0], [0]
    for end in range(1, len(starts)):
        used, costs = np.zeros(weights.shape[1], bool), []
        for start in range(end - 1, -1, -1):
            used = used | follows[start]
            size = starts[end] - starts[start]
            costs.append((best[start] + size * int(used.sum()) + price, start))
        cost, start = min(costs)
        best.append(cost)
        back.append(start)
    runs, end = [], len(starts) - 1
    while end > 0:
        used = np.any(follows[back[end] : end], axis=0)
        joints = tuple(int(j) for j in np.flatnonzero(used))
        runs.append((starts[back[end]], starts[end], joints))
        end = back[end]
    return tuple(reversed(runs))
