"""Draws a body model: its shape components and a few postures.

Views are orthographic, of shaded triangles that are drawn back to front: matplotlib's
3D axes are slow and order faces wrongly.
"""

from pathlib import Path

import jax.numpy as jnp
import numpy as np

from bodyslam_jax.body.model import BodyModel
from bodyslam_jax.body.skeleton import JOINT_NAMES
from bodyslam_jax.body.skinning import vertices
from bodyslam_jax.config.errors import InputError

NUM_SHAPES = 4
"""Number of shape components that are drawn at ±2 standard deviations."""

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
    """Draws shape components at ±2σ and postures to an image file.

    **Raises:** `InputError` if the path lacks the suffix of an image format.
    """
    from matplotlib.figure import Figure  # slow to import, and only needed here

    figure = Figure(figsize=(13, 7.5), layout="constrained")
    suffix, formats = Path(path).suffix, sorted(figure.canvas.get_supported_filetypes())
    if suffix[1:].lower() not in formats:
        expected = ", ".join(f".{kind}" for kind in formats)
        raise InputError(f"{path}: suffix {suffix!r}, expected one of {expected}.")
    rows = figure.subplots(2, 1)
    trans, zero = jnp.zeros(3, model.dtype), jnp.zeros(10, model.dtype)
    columns = [(0.0, 0)] + [(s, k) for k in range(NUM_SHAPES) for s in (-2.0, 2.0)]
    shapes = [
        (f"β{k} = {s:+.0f}" if s else "β = 0", "arms down", zero.at[k].set(s), False)
        for s, k in columns
    ]
    postures = [
        (f"{name}, side" if side else name, name, zero, side)
        for name in POSTURES
        for side in (False, True)
    ]
    for axis, pictures in zip(rows, (shapes, postures), strict=True):
        for at, (title, name, shape, from_side) in enumerate(pictures):
            points = vertices(model, posture(name, model.dtype), shape, trans)
            points = np.asarray(points) - np.asarray(model.joint_template[0])
            draw_body(axis, points, np.asarray(model.faces), from_side, (1.1 * at, 0.0))
            axis.text(1.1 * at, 0.98, title, ha="center", fontsize=9)
        axis.set_aspect("equal")
        axis.set_axis_off()
        axis.autoscale_view()
    stature = float(np.ptp(np.asarray(model.template)[:, 1]))
    figure.suptitle(
        f"{model.name}: {model.num_vertices} vertices, β = 0 is {stature:.2f} m tall"
    )
    figure.savefig(path, dpi=100)


def posture(name: str, dtype=None):
    """Returns one of `POSTURES` as SMPL's 72 pose parameters, rad."""
    pose = np.zeros((24, 3))
    for joint, rotation in POSTURES[name].items():
        pose[JOINT_NAMES.index(joint)] = rotation
    return jnp.asarray(pose.ravel(), dtype)


def draw_body(
    axis, points, faces, from_side=False, at=(0.0, 0.0), colour=(0.75, 0.78, 0.85)
) -> None:
    """Draws shaded triangles on matplotlib axes, viewed from the front or the left of
    the person."""
    from matplotlib.collections import PolyCollection

    if from_side:  # from +x: forward is to the left
        u, depth = -points[:, 2], points[:, 0]
    else:  # from +z: the subject's left is to the right
        u, depth = points[:, 0], points[:, 2]
    view = np.stack([u + at[0], points[:, 1] + at[1], depth], -1)
    corner = view[faces]
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
