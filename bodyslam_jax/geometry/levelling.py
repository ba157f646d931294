"""Aligns the y axis of the world with the estimated up direction."""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax.geometry.gravity import Upright, find_upright
from bodyslam_jax.geometry.vertical_edges import Edges, find_vertical


def level(
    T_WC: Float[np.ndarray, "t 4 4"],
    T_WH: Float[np.ndarray, "h t 4 4"],
    feet: Float[np.ndarray, "h t 2 3"],
    present: Bool[np.ndarray, "h t"],
    landmarks: Float[np.ndarray, "l 3"],
    fps: float,
    fitted: Bool[np.ndarray, " h"],
    gravity: tuple[float, ...] = (),
    standing: Bool[np.ndarray, "h t 2"] | None = None,
    edges: Edges | None = None,
    on_floor: Bool[np.ndarray, " h"] | None = None,
) -> tuple[Float[np.ndarray, "4 4"], Upright]:
    """Returns the rigid motion to a world whose y axis is up, and the estimate of up.

    Cues (see `find_upright`) are evaluated in a roughly upright world, whose y axis is
    opposite to `gravity` (in the first camera's axes) if that is measured, else the
    mean direction of people's trunks, or, without people, the first camera's -y.
    `up` and `normal` of the returned `Upright` are in the given world. Where gravity is
    measured, up is estimated a second time without it, for comparison.

    Args:
        T_WC, T_WH: poses of the camera and of people's roots, m.
        feet: toe joints in the world, m.
        gravity: direction of gravity in the first camera's axes; empty if not measured.
        landmarks, fitted, standing, edges, on_floor: see `find_upright`.
    """
    up = -T_WC[0, :3, 1]
    if gravity:
        up = -T_WC[0, :3, :3] @ np.asarray(gravity, float)
    elif present.any():
        up = T_WH[present][:, :3, 1].sum(axis=0)
    rough = upright(T_WC, up / np.linalg.norm(up))
    turn = rough[:3, :3]
    at = lambda points: points @ turn.T + rough[:3, 3]
    found = find_upright(
        T_WH[..., :3, 1] @ turn.T,
        at(feet),
        present,
        at(T_WC[:, :3, 3]),
        at(landmarks),
        fps,
        fitted,
        np.array([0.0, 1.0, 0.0]) if gravity else None,
        standing,
        None if edges is None else find_vertical(edges.rotated(turn)),
        on_floor,
    )
    whole = upright(rough @ T_WC, found.up) @ rough
    found = dataclasses.replace(
        found, up=turn.T @ found.up, normal=turn.T @ found.normal
    )
    if gravity:
        rest = (standing, edges, on_floor)
        _, unaided = level(T_WC, T_WH, feet, present, landmarks, fps, fitted, (), *rest)
        cosine = float(np.clip(unaided.up @ turn[1], -1, 1))
        found = dataclasses.replace(
            found,
            unaided=float(np.arccos(cosine)),
            unaided_sigma=unaided.sigma_if_sloping,
        )
    return whole, found


def upright(
    T_WC: Float[np.ndarray, "t 4 4"], up: Float[np.ndarray, " 3"]
) -> Float[np.ndarray, "4 4"]:
    """Returns the rigid motion to a world whose origin is the first camera, with y
    along the unit vector `up` and z horizontal in the camera's viewing direction."""
    y = up
    ahead = T_WC[0, :3, 2] - y * (y @ T_WC[0, :3, 2])
    if np.linalg.norm(ahead) < 1e-3:  # The camera looks straight up or down.
        ahead = T_WC[0, :3, 1] - y * (y @ T_WC[0, :3, 1])
    z = ahead / np.linalg.norm(ahead)
    turn = np.eye(4)
    turn[:3, :3] = np.stack([np.cross(y, z), y, z])
    turn[:3, 3] = -turn[:3, :3] @ T_WC[0, :3, 3]
    return turn
