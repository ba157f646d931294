"""People stand on the ground plane of the map.

    r = (n^T (s r'_WC + C_WC p_C) + s d - SOLE) / σ

In m. `n^T x' + d = 0` is the ground plane among the landmarks, in units of the map;
`p_C` is the soft minimum, along n, of heels and toes. It relates metres of the body to
units of the map, so scale is observable even where nobody walks. Default:
`weights.ground_sigma` = 0.04 m, one error for the whole sequence: times the root of the
number of frames. Ours.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bodyslam_jax.body import BodyModel, local_keypoints
from bodyslam_jax.graph.factor import FrameFactor, Key, Limbs
from bodyslam_jax.graph.keypoint_jacobian import (
    keypoint_jacobian,
    turning_joints,
)
from bodyslam_jax.graph.losses import Loss, Squared
from bodyslam_jax.graph.state import State

HEELS_AND_TOES = (19, 21, 22, 24)
"""Big toe and heel among the keypoints of BODY_25, left and right."""
SOLE = 0.018
"""Height of those keypoints above the sole, m."""
_SOFTNESS = 0.01
"""Of the soft minimum: a point this much higher has e times less weight, m."""


class GroundContact(FrameFactor):
    """`r = (height of the lowest point of the feet above the plane - SOLE) / σ`."""

    body: BodyModel
    plane: Float[Array, " 4"]
    """Upward unit normal n, and d in units of the map."""
    sigma: Float[Array, "h t"]
    """m; `inf` where feet are not visible. The plane has one error in all frames, so
    this is its standard deviation times the root of their number."""
    loss: Loss = Squared()
    padding = {"sigma": jnp.inf}
    keys = (("camera", 0), ("root", 0), ("pose", 0), ("scale", 0), ("shape", 0))

    @property
    def limbs(self) -> Limbs:
        return (turning_joints(self.body, "body25", HEELS_AND_TOES),)

    def frame_residual(self, data, window, shared):
        (sigma,), (frame,) = data, window
        return (self._lowest(frame, shared) - SOLE)[None] / sigma

    def jacobian(self, data, window, shared):
        (sigma,), (frame,) = data, window
        points = keypoint_jacobian(self.body, frame.pose, shared.shape, "body25", 0.0)
        feet = np.array(HEELS_AND_TOES)
        p_H, by_pose, by_shape = points[0][feet], points[1][:, feet], points[2][feet]
        height, up_C = self._heights(p_H, frame, shared)
        share = jax.nn.softmax(-height / _SOFTNESS)
        up_H = frame.root[:3, :3].T @ up_C
        at_H = share @ p_H
        at_C = frame.root[:3, :3] @ at_H + frame.root[:3, 3]
        normal, offset = self.plane[:3], self.plane[3]
        r_WC = frame.camera[:3, 3]
        # n^T C Exp(ω) p = up^T (p + ω x p), so the derivative is p x up.
        parts: dict[Key, Array] = {
            ("camera", 0): jnp.concatenate(
                [jnp.cross(at_C, up_C), shared.scale * normal]
            ),
            ("root", 0): jnp.concatenate([jnp.cross(at_H, up_H), up_C]),
            ("pose", 0): jnp.einsum("f,i,ifm->m", share, up_H, by_pose),
            ("scale", 0): (normal @ r_WC + offset)[None],
            ("shape", 0): jnp.einsum("f,i,fib->b", share, up_H, by_shape),
        }
        parts = {key: part[None] / sigma for key, part in parts.items()}
        return (_soft_minimum(height) - SOLE)[None] / sigma, parts

    def scales(self, state: State) -> Float[Array, "h t"]:
        """The s that would put the feet on the ground, for each person and frame."""
        frames = lambda _, window, shared, __: self._scale(window[0], shared)
        return self.map_frames(frames, state)

    def _scale(self, frame, shared):
        eye = self.plane[:3] @ frame.camera[:3, 3] + self.plane[3]
        return (shared.scale * eye - self._lowest(frame, shared) + SOLE) / eye

    def _lowest(self, frame, shared):
        p_H = local_keypoints(self.body, frame.pose, shared.shape, "body25")
        height, _ = self._heights(p_H[np.array(HEELS_AND_TOES)], frame, shared)
        return _soft_minimum(height)

    def _heights(self, p_H, frame, shared):
        """Heights of points above the ground, m, and the ground's normal in C."""
        normal, offset = self.plane[:3], self.plane[3]
        up_C = frame.camera[:3, :3].T @ normal
        p_C = p_H @ frame.root[:3, :3].T + frame.root[:3, 3]
        eye = shared.scale * (normal @ frame.camera[:3, 3] + offset)
        return p_C @ up_C + eye, up_C


def _soft_minimum(height: Float[Array, " f"]) -> Float[Array, ""]:
    return -_SOFTNESS * jax.nn.logsumexp(-height / _SOFTNESS)
