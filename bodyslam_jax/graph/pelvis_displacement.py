"""Displacement of the pelvis from frame to frame, with its derivatives.

    d_k = C_WH,k-1^T (r_WH,k - r_WH,k-1),    r_WH = s r'_WC + C_WC r_CH

Derivatives are in closed form for all frames at once; forward differentiation would
carry about forty tangents.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.graph.factor import Frame
from bodyslam_jax.graph.state import State


def previous_frame(x: Float[Array, "h t *b"]) -> Float[Array, "h t *b"]:
    """Returns the values of the previous frame; for the first frame, its own."""
    return jnp.concatenate([x[:, :1], x[:, :-1]], axis=1)


def displacement(previous: Frame, now: Frame, scale: Array) -> Float[Array, " 3"]:
    """Returns `C_WH,k-1^T (r_WH,k - r_WH,k-1)`, m."""
    moved = scale * (now.camera[:3, 3] - previous.camera[:3, 3])
    moved = moved + now.camera[:3, :3] @ now.root[:3, 3]
    moved = moved - previous.camera[:3, :3] @ previous.root[:3, 3]
    return previous.root[:3, :3].T @ (previous.camera[:3, :3].T @ moved)


def displacements(state: State) -> Float[Array, "h t 3"]:
    """Returns `d` of all people and frames, m."""
    C_HW_1, _, moved = _moved(state)
    return _rotate(C_HW_1, moved)


def displacements_with_derivatives(
    state: State,
) -> tuple[Float[Array, "h t 3"], dict[str, Float[Array, "h t 3 _"]]]:
    """Returns `d` in m, and its derivatives by camera and root of this frame (`camera`,
    `root`) and of the previous one (`camera_1`, `root_1`), and by the scale."""
    C_HW_1, shift, moved = _moved(state)
    camera = jnp.broadcast_to(state.cameras, state.roots.shape)
    C, r_CH, s = camera[..., :3, :3], state.roots[..., :3, 3], state.scale
    C_1, r_1 = previous_frame(C), previous_frame(r_CH)
    C_HC_1 = previous_frame(state.roots[..., :3, :3]).swapaxes(-1, -2)
    d = _rotate(C_HW_1, moved)
    # C Exp(ω) r = C r - C [r]x ω, and (C Exp(ω))^T w = C^T w + [C^T w]x ω
    by_rotation = C_HW_1 @ by_rotation_of(C, r_CH)
    by_rotation_1 = -C_HW_1 @ by_rotation_of(C_1, r_1)
    by_rotation_1 = by_rotation_1 + C_HC_1 @ _cross_matrix(
        _rotate(C_1.swapaxes(-1, -2), moved)
    )
    zero = jnp.zeros_like(by_rotation)
    join = lambda *parts: jnp.concatenate(parts, axis=-1)
    return d, {
        "camera": join(by_rotation, s * C_HW_1),
        "camera_1": join(by_rotation_1, -s * C_HW_1),
        "root": join(zero, C_HW_1 @ C),
        "root_1": join(_cross_matrix(d), -C_HW_1 @ C_1),
        "scale": _rotate(C_HW_1, shift)[..., None],
    }


def _moved(state: State) -> tuple[Array, Array, Float[Array, "h t 3"]]:
    """Returns C_HW of the previous frame, the displacement of the camera (units of the
    map), and that of the pelvis in the world, m."""
    camera = jnp.broadcast_to(state.cameras, state.roots.shape)
    C, r_WC = camera[..., :3, :3], camera[..., :3, 3]
    r_CH, C_CH = state.roots[..., :3, 3], state.roots[..., :3, :3]
    C_1 = previous_frame(C)
    C_HW_1 = previous_frame(C_CH).swapaxes(-1, -2) @ C_1.swapaxes(-1, -2)
    shift = r_WC - previous_frame(r_WC)
    moved = state.scale * shift + _rotate(C, r_CH)
    return C_HW_1, shift, moved - _rotate(C_1, previous_frame(r_CH))


def pelvis_in_world(state: State) -> Float[Array, "h t 3"]:
    """Returns `r_WH = s r'_WC + C_WC r_CH`, m."""
    camera = jnp.broadcast_to(state.cameras, state.roots.shape)
    turned = _rotate(camera[..., :3, :3], state.roots[..., :3, 3])
    return state.scale * camera[..., :3, 3] + turned


def _rotate(matrix: Float[Array, "*b 3 3"], v: Float[Array, "*b 3"]) -> Array:
    return jnp.einsum("...ij,...j->...i", matrix, v)


def by_rotation_of(C: Float[Array, "*b 3 3"], r: Float[Array, "*b 3"]) -> Array:
    """Returns `d (C Exp(ω) r) / dω = -C [r]x`: each row is a cross product."""
    return jnp.cross(jnp.broadcast_to(r[..., None, :], C.shape), C)


def _cross_matrix(r: Float[Array, "*b 3"]) -> Float[Array, "*b 3 3"]:
    """Returns `[r]x`."""
    return jnp.cross(jnp.eye(3, dtype=r.dtype), r[..., None, :])
