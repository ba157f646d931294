"""People stand on the ground of the map.

    r = (n^T (s r'_WC + C_WC p_C) + s d - SOLE_HEIGHT_M - z) / σ

In m. `n^T x' + d = 0` is the ground among the landmarks, in units of the map: one
plane, or, where the ground is not a plane, level ground of a different height d under
each person in each frame; z is the height of what they stand on above it, such as a
ladder's rung. `p_C` is the soft minimum, along n, of heels and toes. It relates metres
of the body to units of the map, so scale is observable even where nobody walks.
Default: `weights.ground_sigma` = 0.04 m, one error for the whole sequence: times the
root of the number of frames. Ours.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bodyslam_jax.body import BodyModel, local_keypoints
from bodyslam_jax.graph.factor import FrameFactor, Key
from bodyslam_jax.graph.keypoint_jacobian import keypoint_jacobian
from bodyslam_jax.graph.losses import Loss, Squared
from bodyslam_jax.graph.state import State

HEELS_AND_TOES = (19, 21, 22, 24)
"""Big toe and heel among the keypoints of BODY_25, left and right."""
SOLE_HEIGHT_M = 0.018
"""Height of those keypoints above the sole, m."""
_SOFTNESS_M = 0.01
"""Softness of the minimum, m: a point this much higher has 1/e of the weight."""


class GroundContact(FrameFactor):
    """`r = (height of the lowest point of the feet - SOLE_HEIGHT_M) / σ`."""

    body: BodyModel
    normal: Float[Array, " 3"]
    """n, a unit vector, upwards."""
    offset: Float[Array, "h t"]
    """d, units of the map; the same everywhere if the ground is a plane."""
    sigma: Float[Array, "h t"]
    """m; `inf` where feet or the ground are not visible. The ground has one error in
    all frames, so this is its standard deviation times the root of their number."""
    height: Float[Array, "h t"]
    """z, m: 0 for who stands on the ground itself."""
    loss: Loss = Squared()
    padding = {"sigma": jnp.inf}
    map_units = {"offset": 1}
    keys = (("camera", 0), ("root", 0), ("pose", 0), ("scale", 0), ("shape", 0))

    def frame_residual(self, data, window, shared):
        (offset, sigma, above), (frame,) = data, window
        lowest = self._lowest(frame, shared, offset)
        return (lowest - SOLE_HEIGHT_M - above)[None] / sigma

    def residual(self, state: State) -> Float[Array, "h t 1"]:
        # As `KeypointReprojection` does, so that both compute the body once.
        p_H = local_keypoints(self.body, state.poses, state.shapes[:, None], "body25")
        p_H = p_H[..., np.array(HEELS_AND_TOES), :]
        C_CH, r_CH = state.roots[..., :3, :3], state.roots[..., :3, 3]
        up_C = self.normal @ state.cameras[:, :3, :3]
        up_H = jnp.einsum("tj,htjk->htk", up_C, C_CH)
        height = jnp.einsum("htfk,htk->htf", p_H, up_H)
        level = state.scale * (state.cameras[:, :3, 3] @ self.normal + self.offset)
        height = height + (jnp.sum(r_CH * up_C, axis=-1) + level)[..., None]
        lowest = _soft_minimum(height)
        return ((lowest - SOLE_HEIGHT_M - self.height) / self.sigma)[..., None]

    def jacobian(self, data, window, shared):
        (offset, sigma, above), (frame,) = data, window
        p_H, by_pose, by_shape = keypoint_jacobian(
            self.body, frame.pose, shared.shape, "body25", 0.0, HEELS_AND_TOES
        )
        height, up_C = self._heights(p_H, frame, shared, offset)
        share = jax.nn.softmax(-height / _SOFTNESS_M)
        up_H = frame.root[:3, :3].T @ up_C
        at_H = share @ p_H
        at_C = frame.root[:3, :3] @ at_H + frame.root[:3, 3]
        r_WC = frame.camera[:3, 3]
        # n^T C Exp(ω) p = up^T (p + ω x p), so the derivative is p x up.
        parts: dict[Key, Array] = {
            ("camera", 0): jnp.concatenate(
                [jnp.cross(at_C, up_C), shared.scale * self.normal]
            ),
            ("root", 0): jnp.concatenate([jnp.cross(at_H, up_H), up_C]),
            ("pose", 0): jnp.einsum("f,i,ifm->m", share, up_H, by_pose),
            ("scale", 0): (self.normal @ r_WC + offset)[None],
            ("shape", 0): jnp.einsum("f,i,fib->b", share, up_H, by_shape),
        }
        parts = {key: part[None] / sigma for key, part in parts.items()}
        lowest = _soft_minimum(height)
        return (lowest - SOLE_HEIGHT_M - above)[None] / sigma, parts

    def scales(self, state: State) -> Float[Array, "h t"]:
        """Returns the s that puts the feet at their height over the ground, for each
        person and frame."""
        return self.map_frames(self._scale, state)

    def _scale(self, data, window, shared, _):
        (offset, _, above), (frame,) = data, window
        eye = self.normal @ frame.camera[:3, 3] + offset
        over = self._lowest(frame, shared, offset) - SOLE_HEIGHT_M - above
        return (shared.scale * eye - over) / eye

    def soles(self, state: State) -> Float[Array, "h t 3"]:
        """Returns the lowest point of the soles in the camera frame, m."""
        return self.map_frames(self._sole, state)

    def _sole(self, data, window, shared, _):
        (offset, *_), (frame,) = data, window
        p_H = local_keypoints(self.body, frame.pose, shared.shape, "body25")
        p_H = p_H[np.array(HEELS_AND_TOES)]
        height, up_C = self._heights(p_H, frame, shared, offset)
        at_H = jax.nn.softmax(-height / _SOFTNESS_M) @ p_H
        return frame.root[:3, :3] @ at_H + frame.root[:3, 3] - SOLE_HEIGHT_M * up_C

    def _lowest(self, frame, shared, offset):
        p_H = local_keypoints(self.body, frame.pose, shared.shape, "body25")
        height, _ = self._heights(p_H[np.array(HEELS_AND_TOES)], frame, shared, offset)
        return _soft_minimum(height)

    def _heights(self, p_H, frame, shared, offset):
        """Returns heights of points above the ground, m, and its normal in C."""
        up_C = frame.camera[:3, :3].T @ self.normal
        p_C = p_H @ frame.root[:3, :3].T + frame.root[:3, 3]
        eye = shared.scale * (self.normal @ frame.camera[:3, 3] + offset)
        return p_C @ up_C + eye, up_C


def _soft_minimum(height: Float[Array, "*b f"]) -> Float[Array, "*b"]:
    return -_SOFTNESS_M * jax.nn.logsumexp(-height / _SOFTNESS_M, axis=-1)
