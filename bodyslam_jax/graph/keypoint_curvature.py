"""Second derivatives of keypoints by joint rotations, in closed form.

They matter because the image of a limb that lies across the view does not change, to
first order, as it rotates towards the camera. A rotation of joint i about an axis `a`
(in H) moves all joints below it, and so rotates the derivatives `d_j` by them:
`∂²p/∂δ_i∂δ_j = a x d_j`, and for i = j its symmetric part. With `d_j = b x m_j`, where
`m_j` is the offset of a point below j, the contraction with gradients `f` is
`Σ f·(a x (b x m_j)) = a·(M_j b - b tr M_j)`, `M_j = Σ m_j f^T`: nine numbers a joint.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bodyslam_jax.body.skeleton import ancestors
from bodyslam_jax.graph.keypoint_jacobian import Carried, times

_ANCESTOR_MASK = np.kron(ancestors() - 0.5 * np.eye(24), np.ones((3, 3)))
"""1 where the joint of a coordinate (row) is an ancestor of that of the other, 1/2
where both belong to one joint."""


def keypoint_curvature(
    found: Carried,
    pull: Float[Array, "k 3"],
) -> tuple[Float[Array, "72 72"], Float[Array, "72 10"]]:
    """Returns the second derivatives of `Σ_k pull_k · p_k` by rotations twice, and by
    rotations and shape.

    Points (`carried_by_joints`, m) and `pull`, the gradient of the cost by them, are in
    H. Rotations (rad) are `Exp` on the right: of the whole body about the pelvis, then
    of each joint. Points are linear in shape. Pose blend shapes are neglected.
    """
    G, x = found.G, found.x
    path = jnp.asarray(ancestors(), x.dtype)
    below = lambda y: (path @ y.reshape(24, -1)).reshape(y.shape)
    own = found.share @ pull
    all_own = below(own)
    arm = found.lever.swapaxes(1, 2).reshape(72, -1) @ pull
    outer = lambda f: x[:, :, None] * f[:, None]
    M = below(outer(own) + times(G, arm.reshape(24, 3, 3))) - outer(all_own)
    trace = M[:, 0, 0] + M[:, 1, 1] + M[:, 2, 2]
    crossed = times(M, G) - trace[:, None, None] * G
    axes, crossed = (y.swapaxes(1, 2).reshape(72, 3) for y in (G, crossed))
    product = jnp.asarray(_ANCESTOR_MASK, M.dtype) * (axes @ crossed.T)
    turns = product + product.T

    arms = found.lever_by_shape.transpose(0, 1, 3, 2).reshape(720, -1) @ pull
    arms = times(G, arms.reshape(24, 3, 30)).reshape(24, 3, 10, 3)
    cross = lambda y, f: jnp.cross(y, f[..., None], axis=1)
    spread = cross(found.x_by_shape, own) + _crossed(arms)
    spread = below(spread) - cross(found.x_by_shape, all_own)
    return turns, times(G.swapaxes(1, 2), spread).reshape(72, 10)


def _crossed(y: Float[Array, "i 3 s 3"]) -> Float[Array, "i 3 s"]:
    """Returns `Σ a x b` from `Σ a b^T`."""
    return jnp.stack(
        [y[:, i - 2, :, i - 1] - y[:, i - 1, :, i - 2] for i in range(3)], 1
    )
