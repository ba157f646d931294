"""Second derivatives of keypoints by turns of the joints, in closed form.

A limb across the view hardly changes its image as it turns towards the camera, to
first order. A turn of joint i about an axis `a` (in H) carries what hangs below it, and
so the derivatives `d` by the joints below: `∂²p/∂δ_i∂δ_j = a x d_j`, and for one joint
its symmetric part. With `d_j = b x m_j`, of what hangs below j at `m_j` from it, pulls
`f` add up to `Σ f·(a x (b x m_j)) = a·(M_j b - b tr M_j)`, `M_j = Σ m_j f^T`: nine
numbers a joint.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bodyslam_jax.body import BodyModel
from bodyslam_jax.body.skeleton import ancestors
from bodyslam_jax.geometry import so3
from bodyslam_jax.graph.keypoint_jacobian import (
    carried_by_joints,
    times,
)

_UPPER = np.kron(ancestors() - 0.5 * np.eye(24), np.ones((3, 3)))
"""1 where the joint of a coordinate (row) is above that of the other, a half where they
are of one joint."""


def keypoint_curvature(
    body: BodyModel,
    pose: Float[Array, "23 3"],
    shape: Float[Array, " 10"],
    layout: str,
    bias: float | Float[Array, ""],
    pull: Float[Array, "k 3"],
) -> tuple[Float[Array, "72 72"], Float[Array, "72 10"]]:
    """Second derivatives of `Σ_k pull_k · p_k`, by turns and turns, by turns and shape.

    Places (m) and pulls are in H. Turns (rad) are `Exp` on the right: of the whole body
    about the pelvis, then of each joint. Places are linear in shape. What pose blend
    shapes add is left out.
    """
    R = so3.exp(pose)
    found = carried_by_joints(body, R, shape, layout, bias)
    G, x = found.G, found.x
    path = jnp.asarray(ancestors(), pose.dtype)
    below = lambda y: (path @ y.reshape(24, -1)).reshape(y.shape)
    own = found.share @ pull
    all_own = below(own)
    arm = found.lever.swapaxes(1, 2).reshape(72, -1) @ pull
    outer = lambda f: x[:, :, None] * f[:, None]
    M = below(outer(own) + times(G, arm.reshape(24, 3, 3))) - outer(all_own)
    trace = M[:, 0, 0] + M[:, 1, 1] + M[:, 2, 2]
    crossed = times(M, G) - trace[:, None, None] * G
    axes, crossed = (y.swapaxes(1, 2).reshape(72, 3) for y in (G, crossed))
    product = jnp.asarray(_UPPER, M.dtype) * (axes @ crossed.T)
    turns = product + product.T

    arms = found.lever_by_shape.transpose(0, 1, 3, 2).reshape(720, -1) @ pull
    arms = times(G, arms.reshape(24, 3, 30)).reshape(24, 3, 10, 3)
    cross = lambda y, f: jnp.cross(y, f[..., None], axis=1)
    spread = cross(found.x_by_shape, own) + _crossed(arms)
    spread = below(spread) - cross(found.x_by_shape, all_own)
    return turns, times(G.swapaxes(1, 2), spread).reshape(72, 10)


def _crossed(y: Float[Array, "i 3 s 3"]) -> Float[Array, "i 3 s"]:
    """`Σ a x b` from `Σ a b^T`."""
    return jnp.stack(
        [y[:, i - 2, :, i - 1] - y[:, i - 1, :, i - 2] for i in range(3)], 1
    )
