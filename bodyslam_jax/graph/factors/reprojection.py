"""Pixels of landmarks and of people's keypoints (Section 3.6 of the paper).

Henning et al., BodySLAM, ECCV 2022. What all terms have in common is in `factor.py`.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from bodyslam_jax.body import KEYPOINT_NAMES, BodyModel, local_keypoints
from bodyslam_jax.geometry.camera import project
from bodyslam_jax.graph.factor import (
    Factor,
    FrameFactor,
    Key,
    Limbs,
)
from bodyslam_jax.graph.keypoint_curvature import keypoint_curvature
from bodyslam_jax.graph.keypoint_jacobian import keypoint_jacobian, turning_joints
from bodyslam_jax.graph.losses import Loss, squared_norm
from bodyslam_jax.graph.state import State


class Reprojection(Factor):
    """Static landmarks seen by the moving camera: `u(T_WC^-1 l) - z`.

    Both are in the unscaled map, so the scale s does not enter.
    """

    frame: Int[Array, " m"]
    landmark: Int[Array, " m"]
    pixel: Float[Array, "m 2"]
    sigma: Float[Array, " m"]
    """Standard deviation of each pixel coordinate, px."""
    loss: Loss

    def residual(self, state: State) -> Float[Array, "m 2"]:
        camera = state.cameras[self.frame]
        offset = state.landmarks[self.landmark] - camera[:, :3, 3]
        # Fused sums: a product for each observation would be far too small.
        p_C = sum(camera[:, j, :3] * offset[:, j, None] for j in range(3))
        return (project(state.intrinsics, p_C) - self.pixel) / self.sigma[:, None]


class KeypointReprojection(FrameFactor):
    """Keypoints of the person: `u(T_CH p_H(θ, β)) - z`."""

    body: BodyModel
    pixel: Float[Array, "h t j 2"]
    sigma: Float[Array, "h t j"]
    """px; `inf` where there is no keypoint."""
    loss: Loss
    bias: float | Float[Array, ""] = 0.0
    """Share of the detector's own idea of hips, neck and shoulders, 1."""
    layout: str = eqx.field(static=True, default="body25")
    of_people = True
    time_fields = ("pixel", "sigma")
    padding = {"sigma": jnp.inf}

    @property
    def keys(self) -> tuple[Key, ...]:
        return ("root", 0), ("pose", 0), ("shape", 0), ("intrinsics", 0)

    @property
    def limbs(self) -> Limbs:
        count = len(KEYPOINT_NAMES[self.layout])
        return tuple(
            turning_joints(self.body, self.layout, (point,)) for point in range(count)
        )

    def data(self):
        return self.pixel, self.sigma

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
        seen, push = jax.linearize(lambda p: project(shared.intrinsics, p), p_C)
        basis = jnp.eye(3, dtype=p_C.dtype)
        by_C = jnp.stack([push(jnp.broadcast_to(e, p_C.shape)) for e in basis], -1)
        by_C = by_C / sigma[:, None, None]
        by_H = by_C @ C_CH
        by_intrinsics = jax.jacfwd(lambda i: project(i, p_C))(shared.intrinsics)
        # p_C = C Exp(ω) p_H + r: dp_C/dω = -C [p_H]x, row by row the cross product.
        turn = jnp.cross(p_H[:, None, :], by_H)
        return (seen - pixel) / sigma[:, None], {
            ("root", 0): jnp.concatenate([turn, by_C], axis=-1),
            # Fused products: a matrix product for each keypoint would be too small.
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
        """What `J^T J` leaves out of the cost's second derivatives, `Σ w r^T ∂²r`: by
        turns of the root, then of the joints (rad), and by those and shape.

        Weights of the loss are held, as the solver holds them. What perspective bends
        is left out as well, a share of the error over the body's size in the image.
        """

        # Each frame's own, where a loss has one scale for each measurement.
        losses = jax.tree.map(
            lambda x: jnp.broadcast_to(x, self.sigma.shape), self.loss
        )

        def one(data, window, shared, loss):
            (pixel, sigma), (frame,) = data, window
            given = self.body, frame.pose, shared.shape, self.layout, self.bias
            C_CH = frame.root[:3, :3]
            p_C = keypoint_jacobian(*given)[0] @ C_CH.T + frame.root[:3, 3]
            residual, pull = jax.vjp(
                lambda p: (project(shared.intrinsics, p) - pixel) / sigma[:, None], p_C
            )
            weight = loss.weight(squared_norm(residual))[:, None]
            (by_C,) = pull(weight * residual)
            return keypoint_curvature(*given, by_C @ C_CH)

        return self.map_frames(one, state, losses)
