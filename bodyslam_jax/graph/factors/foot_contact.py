"""Foot points in contact with the ground hardly move in the world.

    r_ki = (q_i(k) - q_i(k-1)) / σ_ki,    q_i = p_W,i - κ r_WH
    p_W,i = r_WH + C_WH p_H,i(θ, β̂),    r_WH = ŝ r'_WC + C_WC r_CH

for toes and heels i, with `σ_ki = σ L(β̂) / sqrt(P_ki P_k-1,i)`: `P` is the probability
of contact (`motion.contact_network`), so that a point that probably swings has little
weight, and `L` the leg length. In m. A foot rolls, and is rigid in the body model, so
that its points in contact move forward by κ = 3 % of the pelvis' displacement (CMU
walks: 2.7 ± 0.5 %, runs -2 %).

Shape β̂ and scale ŝ are constants, those of the optimum without this factor: steps of
estimated postures have a common error of some per cent, and thousands of points in
contact would make people or world grow or shrink by as much (2 to 3 % where they are
free). Default: `weights.contact_sigma` = 0.02 legs at 30 fps, four times the true slip,
as it is correlated over a stance; Cauchy. Ours.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bodyslam_jax.body import BodyModel, local_keypoints
from bodyslam_jax.body.skeleton import BODY25_TOES_AND_HEELS
from bodyslam_jax.graph.factor import Frame, FrameFactor, Key
from bodyslam_jax.graph.keypoint_jacobian import keypoint_jacobian
from bodyslam_jax.graph.losses import Loss, Squared
from bodyslam_jax.graph.pelvis_displacement import previous_frame
from bodyslam_jax.graph.state import State

SLIP_RATIO = 0.03
"""κ: displacement of a point in contact as a share of the pelvis'."""
_TOES_AND_HEELS = np.array(BODY25_TOES_AND_HEELS)


class FootContact(FrameFactor):
    """`r = (q(k) - q(k-1)) / σ` of toes and heels."""

    body: BodyModel
    shape: Float[Array, "h t 10"]
    """β̂, the same in all frames of a person."""
    scale: Float[Array, "h t"]
    """ŝ, m per unit of the map, the same everywhere."""
    sigma: Float[Array, "h t 4"]
    """σ of a point's displacement from k-1 to k, m; `inf` without contact. Left
    toe, left heel, right toe, right heel."""
    loss: Loss = Squared()
    padding = {"sigma": jnp.inf}
    map_units = {"scale": -1}
    keys = tuple((name, lag) for name in ("camera", "root", "pose") for lag in range(2))

    def frame_residual(self, data, window, shared):
        shape, scale, sigma = data
        now, before = (self._points(frame, shape, scale) for frame in window)
        return (now - before) / sigma[:, None]

    def _points(
        self, frame: Frame, shape: Float[Array, " 10"], scale: Float[Array, ""]
    ) -> Float[Array, "4 3"]:
        p_H = local_keypoints(self.body, frame.pose, shape, "body25")[_TOES_AND_HEELS]
        p_C = p_H @ frame.root[:3, :3].T + (1 - SLIP_RATIO) * frame.root[:3, 3]
        eye = (1 - SLIP_RATIO) * scale * frame.camera[:3, 3]
        return p_C @ frame.camera[:3, :3].T + eye

    def residual(self, state: State) -> Float[Array, "h t 4 3"]:
        p_H = local_keypoints(self.body, state.poses, self.shape, "body25")
        p_H = p_H[..., _TOES_AND_HEELS, :]
        C_CH, r_CH = state.roots[..., :3, :3], state.roots[..., None, :3, 3]
        p_C = p_H @ C_CH.swapaxes(-1, -2) + (1 - SLIP_RATIO) * r_CH
        eye = (1 - SLIP_RATIO) * self.scale[..., None] * state.cameras[:, :3, 3]
        C_CW = state.cameras[:, :3, :3].swapaxes(-1, -2)
        q = p_C @ C_CW + eye[..., None, :]
        return (q - previous_frame(q)) / self.sigma[..., None]

    def jacobians(self, state):
        of_frames = jax.vmap(self._with_derivatives)
        q, parts = jax.vmap(of_frames, (0, None, 0, 0, 0))(
            state.poses, state.cameras, state.roots, self.shape, self.scale
        )
        sigma = self.sigma[..., None]
        keys: dict[Key, Array] = {}
        for name, part in parts.items():
            keys[name, 0] = part / sigma[..., None]
            keys[name, 1] = -previous_frame(part) / sigma[..., None]
        return (q - previous_frame(q)) / sigma, keys

    def _with_derivatives(self, pose, camera, root, shape, scale):
        """Returns the points q of one frame, m, with derivatives by its variables."""
        p_H, by_pose, _ = keypoint_jacobian(
            self.body, pose, shape, "body25", 0.0, BODY25_TOES_AND_HEELS
        )
        C_WC, r_WC = camera[:3, :3], camera[:3, 3]
        C_CH, r_CH = root[:3, :3], root[:3, 3]
        C_WH = C_WC @ C_CH
        q_C = p_H @ C_CH.T + (1 - SLIP_RATIO) * r_CH
        # C Exp(ω) p = C p + C (ω x p): row i of the derivative is p x (row i of C).
        turned = lambda C, p: jnp.cross(p[:, None], C)
        wide = lambda C: jnp.broadcast_to(
            (1 - SLIP_RATIO) * C, (len(_TOES_AND_HEELS), 3, 3)
        )
        eye = jnp.eye(3, dtype=pose.dtype)
        join = lambda *parts: jnp.concatenate(parts, axis=-1)
        return q_C @ C_WC.T + (1 - SLIP_RATIO) * scale * r_WC, {
            "camera": join(turned(C_WC, q_C), wide(scale * eye)),
            "root": join(turned(C_WH, p_H), wide(C_WC)),
            "pose": jnp.einsum("ij,jfm->fim", C_WH, by_pose),
        }
