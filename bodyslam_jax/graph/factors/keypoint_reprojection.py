"""Body keypoints projected into the camera (e_joints, section 3.6 of the paper).

    r = (u(T_CH p_H(θ, β)) - z) / σ

In px, two rows for each keypoint of each person. Neither the camera's pose nor the
scale enters, as people are estimated relative to the camera. Default: σ is a detector's
error in metres of the body (`people.keypoint_sigma`) times f/z and
`weights.keypoint_inflation` = 2.5, or `weights.keypoint_sigma` over the confidence;
Geman-McClure loss of scale `weights.keypoint_loss` = 4 standard deviations of one
keypoint. The paper: `λ = confidence²` px^-2, Geman-McClure with 100 px (Bogo et al.,
2016).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.body import BodyModel, local_keypoints
from bodyslam_jax.geometry import so3
from bodyslam_jax.geometry.camera import project
from bodyslam_jax.graph.factor import FrameFactor
from bodyslam_jax.graph.keypoint_jacobian import (
    carried_by_joints,
    keypoint_curvature,
    keypoint_jacobian,
    placed,
)
from bodyslam_jax.graph.losses import Loss, squared_norm
from bodyslam_jax.graph.state import State


class KeypointReprojection(FrameFactor):
    """`r = (u(T_CH p_H(θ, β)) - z) / σ`, for each person, frame and keypoint."""

    body: BodyModel
    pixel: Float[Array, "h t j 2"]
    sigma: Float[Array, "h t j"]
    """px; `inf` where the keypoint is missing."""
    loss: Loss
    bias: float | Float[Array, ""] = 0.0
    """Share of the offset between a detector's hips, neck and shoulders and the joints
    of the body model (`body.DETECTOR_BIAS`)."""
    layout: str = eqx.field(static=True, default="body25")
    padding = {"sigma": jnp.inf}
    keys = (("root", 0), ("pose", 0), ("shape", 0), ("intrinsics", 0))

    def residual(self, state: State) -> Float[Array, "h t j 2"]:
        shape = state.shapes[:, None]
        p_H = local_keypoints(self.body, state.poses, shape, self.layout, self.bias)
        root = state.roots
        p_C = p_H @ root[..., :3, :3].swapaxes(-1, -2) + root[..., None, :3, 3]
        return (project(state.intrinsics, p_C) - self.pixel) / self.sigma[..., None]

    def frame_residual(self, data, window, shared):
        return self.jacobian(data, window, shared)[0]

    def jacobian(self, data, window, shared):
        pixel, sigma = data
        (frame,) = window
        C_CH = frame.root[:3, :3]
        p_H, by_pose, by_shape = keypoint_jacobian(
            self.body, frame.pose, shared.shape, self.layout, self.bias
        )
        p_C = p_H @ C_CH.T + frame.root[:3, 3]
        pixels, push = jax.linearize(lambda p: project(shared.intrinsics, p), p_C)
        basis = jnp.eye(3, dtype=p_C.dtype)
        by_C = jnp.stack([push(jnp.broadcast_to(e, p_C.shape)) for e in basis], -1)
        by_C = by_C / sigma[:, None, None]
        by_H = by_C @ C_CH
        by_intrinsics = jax.jacfwd(lambda i: project(i, p_C))(shared.intrinsics)
        # p_C = C Exp(ω) p_H + r: dp_C/dω = -C [p_H]x, row by row the cross product.
        turn = jnp.cross(p_H[:, None, :], by_H)
        return (pixels - pixel) / sigma[:, None], {
            ("root", 0): jnp.concatenate([turn, by_C], axis=-1),
            # Fused products: one small matrix product for each keypoint would be slow.
            ("pose", 0): sum(
                (by_H[..., i, None] * by_pose[i][:, None] for i in (1, 2)),
                by_H[..., 0, None] * by_pose[0][:, None],
            ),
            ("shape", 0): by_H @ by_shape,
            ("intrinsics", 0): by_intrinsics / sigma[:, None, None],
        }

    def curvature(
        self, state: State
    ) -> tuple[Float[Array, "h t 72 72"], Float[Array, "h t 72 10"]]:
        """Returns the second-order term `Σ w r^T ∂²r`: by rotations of root and
        joints (72, rad) twice, and by those and shape.

        Weights of the loss are constants, as in the solver. Second derivatives of the
        projection are left out: they are smaller by the error over the body's size in
        the image.
        """

        # A loss may have one scale for each measurement.
        losses = jax.tree.map(
            lambda x: jnp.broadcast_to(x, self.sigma.shape), self.loss
        )

        def one(data, window, shared, loss):
            (pixel, sigma), (frame,) = data, window
            R, C_CH = so3.exp(frame.pose), frame.root[:3, :3]
            found = carried_by_joints(
                self.body, R, shared.shape, self.layout, self.bias
            )
            p_H = jnp.sum(placed(found), axis=0)
            p_C = p_H @ C_CH.T + frame.root[:3, 3]
            residual, pull = jax.vjp(
                lambda p: (project(shared.intrinsics, p) - pixel) / sigma[:, None], p_C
            )
            weight = loss.weight(squared_norm(residual))[:, None]
            (by_C,) = pull(weight * residual)
            return keypoint_curvature(found, by_C @ C_CH)

        return self.map_frames(one, state, losses)
