"""Second derivatives of keypoints by turns of the joints, in closed form.

A limb across the view hardly changes its image as it turns towards the camera, to
first order. A turn of joint i about an axis `a` (in H) carries what hangs below it, and
so the derivatives `d` by the joints below: `∂²p/∂δ_i∂δ_j = a x d_j`, and for one joint
its symmetric part.
"""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float

from bodyslam_jax.body import BodyModel
from bodyslam_jax.graph._keypoint_jacobian import (
    ancestors,
    keypoint_jacobian,
    turns_of,
)

_BELOW = np.kron(ancestors() - np.eye(24), np.ones((3, 3)))
"""1 where the joint of a coordinate (row) is above that of the other."""
_SAME = np.kron(np.eye(24), np.ones((3, 3)))


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

    def moments(shape):
        """What each turn moves, along the pull and crossed with it."""
        p_H, by_pose, _ = keypoint_jacobian(body, pose, shape, layout, bias)
        whole = jnp.cross(jnp.eye(3, dtype=p_H.dtype), p_H[:, None])
        moved = jnp.concatenate([whole, jnp.moveaxis(by_pose, 0, 2)], axis=1)
        along = jnp.einsum("kca,ka->c", moved, pull)
        return along, jnp.sum(jnp.cross(moved, pull[:, None]), axis=0)

    # Linear in shape: differences are derivatives. One at a time, as all at once would
    # hold ten times a Jacobian for each frame.
    others = jnp.concatenate([jnp.zeros((1, 10)), jnp.eye(10)]).astype(shape.dtype)
    along, crossed = jax.lax.map(moments, shape + others)
    axes = turns_of(jaxlie.SO3.exp(pose).as_matrix()).swapaxes(1, 2).reshape(72, 3)
    product = axes @ crossed[0].T
    above = product * jnp.asarray(_BELOW, product.dtype)
    same = product * jnp.asarray(_SAME, product.dtype)
    turns = above + above.T + 0.5 * (same + same.T)
    return turns, (along[1:] - along[0]).T
