"""Generates geometry that is added to the body's mesh: skirts, long hair, shoes."""

import numpy as np
from scipy.spatial import ConvexHull

from bodyslam_jax.simulation.body_regions import SHOES, SOLE, Head, Outfit
from bodyslam_jax.simulation.posing import Person

_RINGS, _SPOKES = 14, 40


def skirt_sheet(person: Person, outfit: Outfit):
    """Returns a cone from the waist down: rings of vertices that follow the nearer
    thigh.

    It has positions (rings, spokes, 3), m, skinning weights (rings, spokes, 24), and
    whether the rings are closed.
    """
    p, rest = person.skin, person.rest
    hip, knee = rest[[1, 2], 1].mean(), rest[[4, 5], 1].mean()
    ankle = rest[[7, 8], 1].mean()
    waist, hem = hip + 0.075, hip - outfit.skirt * (hip - ankle)
    angle = np.linspace(0, 2 * np.pi, _SPOKES, endpoint=False)
    rows, weights = [], []
    legs = person.weights[:, [0, 1, 2, 3, 4, 5]].sum(axis=1) > 0.5
    middle, reach = np.zeros(2), np.zeros(2)
    for share in np.linspace(0, 1, _RINGS):
        y = waist + share * (hem - waist)
        near = p[legs & (abs(p[:, 1] - y) < 0.03)]
        low, high = near[:, [0, 2]].min(axis=0), near[:, [0, 2]].max(axis=0)
        now = (high - low) / 2 + 0.012 + 0.035 * share * (0.6 + outfit.looseness)
        middle = (
            (low + high) / 2 if share == 0 else 0.7 * middle + 0.3 * (low + high) / 2
        )
        reach = np.maximum(reach, now)
        fold = 1 + 0.03 * share * np.cos(9 * angle)
        rows.append(
            np.stack(
                [
                    middle[0] + reach[0] * fold * np.cos(angle),
                    np.full(_SPOKES, y),
                    middle[1] + reach[1] * fold * np.sin(angle),
                ],
                axis=1,
            )
        )
        side = np.clip(0.5 + 0.75 * np.cos(angle), 0, 1)
        follows = np.clip((waist - 0.06 - y) / (hip - knee), 0, 1) ** 0.7
        w = np.zeros((_SPOKES, 24))
        w[:, 0] = 1 - 0.85 * follows
        w[:, 1] = 0.85 * follows * side
        w[:, 2] = 0.85 * follows * (1 - side)
        weights.append(w)
    return np.stack(rows), np.stack(weights), True


def hair_sheet(person: Person, outfit: Outfit):
    """Returns a sheet round the back of the head down to the shoulders, or a ponytail,
    in the form of `skirt_sheet`."""
    head, rest = Head(person), person.rest
    if outfit.hair == "tail":
        angle = np.linspace(0, 2 * np.pi, 16, endpoint=False)
        share = np.linspace(0, 1, 9)
        width = 0.004 + 0.028 * np.sin(np.pi * share**0.7)
        back = head.ears[2] - 1.15 * head.width
        y = head.level + 0.25 * head.unit - 0.21 * share
        z = back - 0.045 * np.sin(np.pi * np.clip(share * 1.1, 0, 1)) - 0.01
        rows = np.stack(
            [
                width[:, None] * np.cos(angle),
                np.broadcast_to(y[:, None], (9, 16)),
                z[:, None] + width[:, None] * np.sin(angle),
            ],
            axis=2,
        )
        weights = np.zeros((9, 16, 24))
        weights[..., 15] = 1.0
        return rows, weights, True
    angle = np.radians(np.linspace(75, 285, 25))
    low = rest[12, 1] - 0.06
    share = np.linspace(0, 1, 12)[:, None]
    y = head.level + 0.75 * head.unit + share * (low - head.level - 0.75 * head.unit)
    bulge = np.clip(
        np.sqrt(np.clip(1 - ((1 - share) - 0.25) ** 2 / 0.8, 0.05, 1)), 0.55, 1
    )
    x = (head.width + 0.026) * bulge * np.sin(angle) * (1 + 0.15 * share)
    z = head.ears[2] + 0.005 + 1.32 * (head.width + 0.02) * bulge * np.cos(angle)
    rows = np.stack([x, np.broadcast_to(y, x.shape), z], axis=2)
    weights = np.zeros((*x.shape, 24))
    hang = np.broadcast_to(np.clip(2 * share - 1, 0, 1) * 0.4, x.shape)
    weights[..., 15], weights[..., 12] = 1 - hang, hang
    return rows, weights, False


def with_shoes(mesh, person: Person):
    """Returns the mesh with shoes: the convex hull of each foot, 8 mm thick."""
    skin, weights, faces, part, colours = mesh
    p, floor = person.skin, person.skin[:, 1].min()
    for ankle, toe, side in ((7, 10, 1), (8, 11, -1)):
        top = person.rest[ankle, 1] + 0.02
        own = np.flatnonzero((p[:, 1] < top) & (p[:, 0] * side > 0))
        middle = p[own].mean(axis=0)
        away = (p[own] - middle) * (1, 0, 1)
        away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
        hull = ConvexHull(p[own] + 0.008 * away)
        used, corner = np.unique(hull.simplices, return_inverse=True)
        corner = corner.reshape(-1, 3)
        q = hull.points[used]
        a, b, c = (q[corner[:, k]] for k in range(3))
        inwards = (np.cross(b - a, c - a) * hull.equations[:, :3]).sum(axis=1) < 0
        corner[inwards] = corner[inwards][:, ::-1]
        kind = np.where(q[:, 1] < floor + 0.012, SOLE, SHOES)
        faces = faces[~np.isin(faces, own).all(axis=1)]
        faces = np.concatenate([faces, (corner + len(skin)).astype(faces.dtype)])
        skin = np.concatenate([skin, q])
        weights = np.concatenate([weights, person.weights[own[used]]])
        part = np.concatenate([part, kind])
        palette = [
            np.median(colours[part[: len(colours)] == k], axis=0) for k in (SHOES, SOLE)
        ]
        colours = np.concatenate(
            [colours, np.where((kind == SHOES)[:, None], *palette)]
        )
    return skin, weights, faces, part, colours


def with_sheet(mesh, sheet, kind: int):
    """Returns the mesh with a sheet of rings appended that is visible from both
    sides."""
    skin, weights, faces, part, colours = mesh
    rows, more, closed = sheet
    n, m = rows.shape[:2]
    first = len(skin)
    grid = first + np.arange(n * m).reshape(n, m)
    right = np.roll(grid, -1, axis=1)
    a, b, c, d = (
        (grid[:-1], right[:-1], grid[1:], right[1:])
        if closed
        else (grid[:-1, :-1], grid[:-1, 1:], grid[1:, :-1], grid[1:, 1:])
    )
    out = np.concatenate(
        [np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (b, d, c))]
    )
    twice = np.concatenate(
        [out, out[:, ::-1] + n * m]
    )  # the inside has normals of its own
    colour = np.median(colours[part == kind], axis=0) if (part == kind).any() else 60.0
    count = 2 * n * m
    return (
        np.concatenate([skin, *(2 * [rows.reshape(-1, 3)])]),
        np.concatenate([weights, *(2 * [more.reshape(-1, 24)])]),
        np.concatenate([faces, twice.astype(faces.dtype)]),
        np.concatenate([part, np.full(count, kind)]),
        np.concatenate([colours, np.broadcast_to(colour, (count, 3))]),
    )
