"""Displacement of the pelvis from frame to frame, with its derivatives.

`d_k = C_WH_{k-1}^T (r_WH_k - r_WH_{k-1})` with `r_WH = s r'_WC + C_WC r_CH`, for all
frames at once: forward differentiation would carry forty tangents through it.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.graph.factor import Frame
from bodyslam_jax.graph.state import State


def before(x: Float[Array, "h t *b"]) -> Float[Array, "h t *b"]:
    """What the frame before holds; the first frame's own in the first."""
    return jnp.concatenate([x[:, :1], x[:, :-1]], axis=1)


def displacement(before: Frame, now: Frame, scale: Array) -> Float[Array, " 3"]:
    """`C_WH_{k-1}^T (r_WH_k - r_WH_{k-1})`, m."""
    moved = scale * (now.camera[:3, 3] - before.camera[:3, 3])
    moved = moved + now.camera[:3, :3] @ now.root[:3, 3]
    moved = moved - before.camera[:3, :3] @ before.root[:3, 3]
    return before.root[:3, :3].T @ (before.camera[:3, :3].T @ moved)


def displacements(
    state: State,
) -> tuple[Float[Array, "h t 3"], dict[str, Float[Array, "h t 3 _"]]]:
    """`d` in m, and its derivatives by the camera and the root of this frame (`camera`,
    `root`) and of the frame before (`camera_1`, `root_1`), and by the scale."""
    camera = jnp.broadcast_to(state.cameras, state.roots.shape)
    s = state.scale
    C, r_WC = camera[..., :3, :3], camera[..., :3, 3]
    r_CH, C_CH = state.roots[..., :3, 3], state.roots[..., :3, :3]
    C_before, r_before = before(C), before(r_CH)
    to_H = (before(C_CH).swapaxes(-1, -2)) @ C_before.swapaxes(-1, -2)
    turn = lambda matrix, v: jnp.einsum("...ij,...j->...i", matrix, v)
    shift = r_WC - before(r_WC)
    moved = s * shift + turn(C, r_CH) - turn(C_before, r_before)
    d = turn(to_H, moved)
    # C Exp(ω) r = C r - C [r]x ω, and (C Exp(ω))^T w = C^T w + [C^T w]x ω
    here = to_H @ _turned(C, r_CH)
    there = -to_H @ _turned(C_before, r_before)
    there = there + before(C_CH).swapaxes(-1, -2) @ _cross_matrix(
        turn(C_before.swapaxes(-1, -2), moved)
    )
    still = jnp.zeros_like(here)
    join = lambda *parts: jnp.concatenate(parts, axis=-1)
    return d, {
        "camera": join(here, s * to_H),
        "camera_1": join(there, -s * to_H),
        "root": join(still, to_H @ C),
        "root_1": join(_cross_matrix(d), -to_H @ C_before),
        "scale": turn(to_H, shift)[..., None],
    }


def _turned(C: Float[Array, "*b 3 3"], r: Float[Array, "*b 3"]) -> Array:
    """`d (C Exp(ω) r) / dω = -C [r]x`, row by row a cross product."""
    return jnp.cross(jnp.broadcast_to(r[..., None, :], C.shape), C)


def _cross_matrix(r: Float[Array, "*b 3"]) -> Float[Array, "*b 3 3"]:
    """`[r]x`"""
    return jnp.cross(jnp.eye(3, dtype=r.dtype), r[..., None, :])
