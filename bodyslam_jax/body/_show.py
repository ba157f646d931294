"""A picture of a body model: what it can look like, and whether it moves as it should.

matplotlib's own 3D is slow and hides faces badly; an orthographic view of shaded
triangles, far ones first, is enough here.
"""

from pathlib import Path

import jax.numpy as jnp
import numpy as np

from bodyslam_jax.body._model import BodyModel
from bodyslam_jax.body._skeleton import JOINT_NAMES
from bodyslam_jax.body._skinning import vertices

NUM_SHAPES = 4
"""Shape components shown at ±2 standard deviations."""

POSTURES: dict[str, dict[str, tuple[float, float, float]]] = {
    "arms down": {
        "left_shoulder": (0.0, 0.0, -1.2),
        "right_shoulder": (0.0, 0.0, 1.2),
    },
    "step": {
        "left_shoulder": (0.0, -0.4, -1.2),
        "right_shoulder": (0.0, -0.4, 1.2),
        "left_hip": (-0.5, 0.0, 0.0),
        "right_hip": (0.35, 0.0, 0.0),
        "right_knee": (0.5, 0.0, 0.0),
        "left_ankle": (0.1, 0.0, 0.0),
    },
    "sitting": {
        "left_shoulder": (0.0, 0.0, -1.1),
        "right_shoulder": (0.0, 0.0, 1.1),
        "left_elbow": (0.0, -1.2, 0.0),
        "right_elbow": (0.0, 1.2, 0.0),
        "left_hip": (-1.5, 0.0, 0.0),
        "right_hip": (-1.5, 0.0, 0.0),
        "left_knee": (1.5, 0.0, 0.0),
        "right_knee": (1.5, 0.0, 0.0),
    },
    "bent forward": {
        "left_shoulder": (0.0, -1.2, 0.0),
        "right_shoulder": (0.0, 1.2, 0.0),
        "spine1": (0.4, 0.0, 0.0),
        "spine2": (0.3, 0.0, 0.0),
        "spine3": (0.2, 0.0, 0.0),
    },
}
"""Axis-angle rotations, rad, of the joints that are not at rest."""


def save_picture(model: BodyModel, path: str | Path) -> None:
    """Draws shape components at ±2σ (front) and postures (side) to an image file."""
    from matplotlib.figure import Figure  # slow to import, and only needed here

    figure = Figure(figsize=(13, 8.5), layout="constrained")
    axes = figure.subplots(2, 2 * NUM_SHAPES + 1, sharey="row")
    for axis in axes.flat:
        axis.set_axis_off()
        axis.set_aspect("equal")
    pose, trans = jnp.zeros(72, model.dtype), jnp.zeros(3, model.dtype)
    faces = np.asarray(model.faces)
    zero = jnp.zeros(10, model.dtype)
    columns = [(0.0, 0)] + [(s, k) for k in range(NUM_SHAPES) for s in (-2.0, 2.0)]
    for axis, (amount, k) in zip(axes[0], columns, strict=True):
        points = vertices(model, pose, zero.at[k].set(amount), trans)
        draw_body(axis, np.asarray(points), faces, from_side=False)
        axis.set_title(f"β{k} = {amount:+.0f}" if amount else "β = 0", fontsize=9)
    views = [(name, side) for name in POSTURES for side in (False, True)]
    for axis, (name, side) in zip(axes[1], views, strict=False):
        points = vertices(model, posture(name, model.dtype), zero, trans)
        draw_body(axis, np.asarray(points), faces, from_side=side)
        axis.set_title(f"{name}{', side' if side else ''}", fontsize=9)
    stature = float(np.ptp(np.asarray(model.template)[:, 1]))
    figure.suptitle(
        f"{model.name}: {model.num_vertices} vertices, β = 0 is {stature:.2f} m tall"
    )
    figure.savefig(path, dpi=100)


def posture(name: str, dtype=None):
    """One of `POSTURES` as SMPL's 72 numbers."""
    pose = np.zeros((24, 3))
    for joint, rotation in POSTURES[name].items():
        pose[JOINT_NAMES.index(joint)] = rotation
    return jnp.asarray(pose.ravel(), dtype)


def draw_body(axis, points, faces, from_side=False, colour=(0.75, 0.78, 0.85)) -> None:
    """Shaded triangles on matplotlib axes, seen from the front or the person's left."""
    from matplotlib.collections import PolyCollection

    if from_side:  # from +x: forward is to the left
        u, depth = -points[:, 2], points[:, 0]
    else:  # from +z: the subject's left is to the right
        u, depth = points[:, 0], points[:, 2]
    seen = np.stack([u, points[:, 1], depth], -1)
    corner = seen[faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-12
    front = normal[:, 2] > 0
    order = np.argsort(corner[front].mean(1)[:, 2])
    light = np.array([0.3, 0.4, 0.866])
    shade = (0.3 + 0.7 * np.clip(normal[front] @ light, 0, 1))[order]
    axis.add_collection(
        PolyCollection(
            list(corner[front][order][:, :, :2]),
            facecolors=shade[:, None] * np.asarray(colour),
            antialiased=False,
        )
    )
    axis.autoscale_view()
