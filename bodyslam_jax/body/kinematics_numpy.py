"""The kinematic chain in NumPy, for work that takes less time than its compilation.

A test compares it with `kinematics`, which has the same equations and tree.
"""

import numpy as np
from jaxtyping import Float

from bodyslam_jax.body.skeleton import PARENTS


def pose_joints(
    R: Float[np.ndarray, "n j 3 3"],
    rest: Float[np.ndarray, "*#n j 3"],
    pelvis: Float[np.ndarray, "n 3"],
) -> tuple[Float[np.ndarray, "n j 3 3"], Float[np.ndarray, "n j 3"]]:
    """Returns rotations and positions (m) of the first `j` joints, in the frame to
    which the root's rotation maps.

    `G_k = G_parent R_k`, `x_k = x_parent + G_parent (J_k - J_parent)`.

    Args:
        R: rotation of each joint in its parent's frame.
        rest: joints at rest J, m; one set, or one per body.
        pelvis: position of joint 0, m.
    """
    G, x = R.copy(), np.empty(R.shape[:3])
    x[:, 0] = pelvis
    for k in range(1, R.shape[1]):
        parent = PARENTS[k]
        bone = rest[..., k, :] - rest[..., parent, :]
        G[:, k] = G[:, parent] @ R[:, k]
        x[:, k] = x[:, parent] + (G[:, parent] @ bone[..., None])[..., 0]
    return G, x
