"""The foot that carries a person stands still: scale without any learnt motion."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from bodyslam_jax.body import BodyModel, local_keypoints
from bodyslam_jax.body.skeleton import BODY25_TOES_AND_HEELS
from bodyslam_jax.graph.factor import FrameFactor, Key, Limbs
from bodyslam_jax.graph.factors.human_motion import unit_length
from bodyslam_jax.graph.keypoint_jacobian import turning_joints
from bodyslam_jax.graph.losses import Loss, Squared
from bodyslam_jax.graph.state import State

BODY25_FEET = BODY25_TOES_AND_HEELS
"""Big toe and heel, left and right."""


class StanceFoot(FrameFactor):
    """The foot that carries the weight does not move in the world, between k-1 and k.

    `(p_W(k) - p_W(k-1)) / (L(β) σ)` for each point of the feet, with
    `p_W = s r'_WC + C_WC (C_CH p_H(θ, β) + r_CH)` and the leg's length `L`, both in m.

    Needs no learnt motion, and sees scale through the length of the leg. Errors are in
    lengths of the leg: postures that err move the foot of a smaller person less, and
    errors in metres would shrink people and world.
    """

    body: BodyModel
    sigma: Float[Array, "h t f"]
    """Legs per frame, for the points of the feet; `inf` where one does not carry."""
    loss: Loss = Squared()
    points: tuple[int, ...] = eqx.field(static=True, default=BODY25_FEET)
    """Which keypoints of BODY_25 they are."""
    of_people = True
    time_fields = ("sigma",)
    padding = {"sigma": jnp.inf}

    @property
    def keys(self) -> tuple[Key, ...]:
        frames = ("camera", "root", "pose")
        both = tuple((name, lag) for name in frames for lag in range(2))
        return (*both, ("scale", 0), ("shape", 0))

    @property
    def limbs(self) -> Limbs:
        return tuple(turning_joints(self.body, "body25", (k,)) for k in self.points)

    def data(self):
        return self.sigma

    def frame_residual(self, data, window, shared):
        now, before = (self._feet(f, shared) for f in window)
        leg = unit_length(self.body, shared)
        return (now - before) / leg / data[:, None]

    def _feet(self, frame, shared):
        p_H = local_keypoints(self.body, frame.pose, shared.shape, "body25")
        p_C = p_H[jnp.array(self.points)] @ frame.root[:3, :3].T + frame.root[:3, 3]
        return p_C @ frame.camera[:3, :3].T + shared.scale * frame.camera[:3, 3]


def stance_mask(
    body: BodyModel, state: State, present: Bool[Array, "h t"]
) -> Bool[Array, "h t 4"]:
    """Which of toes and heels is lowest, along the body's up axis, in k-1 and in k."""
    points = local_keypoints(body, state.poses, state.shapes[:, None], "body25")
    height: Float[Array, "h t 4"] = points[..., np.array(BODY25_FEET), 1]
    lowest = height == height.min(axis=-1, keepdims=True)
    lowest = lowest & present[..., None]
    before = jnp.concatenate([jnp.zeros_like(lowest[:, :1]), lowest[:, :-1]], axis=1)
    return lowest & before
