"""Generates geometry that is added to the body's mesh: skirts, long hair, shoes.

Each vertex of the mesh is assigned a part of the outfit (shirt, skin, hair, ...) in the
rest pose. `Outfit` is a style of clothes and hair: a detector trained on photographs
expects people in clothes. Joints and body poses are those of the body underneath;
clothes change the outline and the colours only.
"""

import dataclasses
from typing import Literal

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull

from bodyslam_jax.body.skeleton import SURFACE_POINTS
from bodyslam_jax.simulation.posing import Person

_RINGS, _SPOKES = 14, 40
PARTS = ("skin", "shirt", "trousers", "shoes", "sole", "hair", "eye", "iris", "lips")
"""Parts of the outfit that a vertex can belong to; a skirt counts as trousers."""
SKIN, SHIRT, TROUSERS, SHOES, SOLE, HAIR, EYE, IRIS, LIPS = range(len(PARTS))
_Hair = Literal["short", "cap", "long", "tail"]
_Pattern = Literal["plain", "stripes", "checks", "print"]
_HAIR_STYLES: tuple[_Hair, ...] = ("short", "short", "cap", "long", "tail")
_PATTERNS: tuple[_Pattern, ...] = ("plain", "plain", "stripes", "checks", "print")
"""Hair styles and patterns to draw from; the first of each is twice as likely."""


class Head:
    """Landmarks of the head of one person at rest, m."""

    def __init__(self, person: Person):
        at = lambda name: person.skin[person.picks[SURFACE_POINTS.index(name)]]
        self.eyes = np.stack([at("right_eye"), at("left_eye")])
        self.ears = (at("right_ear") + at("left_ear")) / 2
        self.width = abs(at("left_ear")[0] - at("right_ear")[0]) / 2
        self.top = at("head_top")[1]
        self.nose = at("nose")
        self.unit = self.top - self.eyes[:, 1].mean()
        """Eyes to the top of the head, about 0.11 m."""
        self.level = self.eyes[:, 1].mean()

    def heights(self, p: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, " v"]:
        """Returns heights above the eyes, in multiples of `unit`."""
        return (p[:, 1] - self.level) / self.unit

    def azimuth(self, p: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, " v"]:
        """Returns the unsigned azimuth about the head's vertical axis, degrees: 0 in
        front, 90 at the ears, 180 at the back."""
        return np.degrees(np.arctan2(abs(p[:, 0]), p[:, 2] - self.ears[2]))


@dataclasses.dataclass(frozen=True)
class Outfit:
    """A style of clothes and hair; lengths are shares of the limb that they cover."""

    sleeves: float = 0.6
    """Share of the arm that is covered, from 0.2 (a T-shirt) to 1."""
    legs: float = 1.0
    """Share of the leg that trousers cover, from 0.35 (shorts) to 1."""
    skirt: float = 0.0
    """Share of the leg that a skirt covers, from the waist down; 0 without a skirt."""
    is_dress: bool = False
    """Whether the skirt is of the shirt's cloth."""
    looseness: float = 1.0
    """Distance of clothes from the skin; 1 is about 15 mm at the trunk."""
    hair: _Hair = "short"
    beard: bool = False
    boots: bool = False
    pattern: _Pattern = "plain"
    """Pattern of the shirt."""


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


def parts_of(person: Person, outfit: Outfit) -> Int[np.ndarray, " v"]:
    """Returns the index into `PARTS` of each vertex, from the joint with the largest
    skinning weight and the position at rest."""
    p, rest = person.skin, person.rest
    joint = person.weights.argmax(axis=1)
    part = np.full(len(p), SKIN)
    neckline = rest[12, 1] - 0.035
    trunk = np.isin(joint, (0, 3, 6, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21, 1, 2))
    wrist = abs(rest[[20, 21], 0]).mean()
    shoulder = abs(rest[[16, 17], 0]).mean()
    sleeve = shoulder + outfit.sleeves * (wrist - shoulder)
    collar = neckline + 0.25 * np.clip(abs(p[:, 0]) - 0.06, 0, 0.05)
    part[trunk & (p[:, 1] < collar) & (abs(p[:, 0]) < sleeve)] = SHIRT
    hip, ankle = rest[[1, 2], 1].mean(), rest[[7, 8], 1].mean()
    waist = hip + 0.055
    hem = hip - outfit.legs * (hip - ankle) - 0.02
    part[(p[:, 1] < waist) & (p[:, 1] > hem) & (abs(p[:, 0]) < 0.35)] = TROUSERS
    legs = p[:, 1] < hip - 0.1
    top_of_shoe = ankle + (0.22 if outfit.boots else 0.02)
    under = p[:, 1] < top_of_shoe
    part[legs & under] = SHOES
    if outfit.legs >= 0.9 and not outfit.boots:  # trousers fall over the shoe
        part[legs & (p[:, 1] > ankle - 0.005)] = TROUSERS
    if outfit.skirt:
        part[legs & (p[:, 1] >= top_of_shoe)] = SKIN
        hem = hip - outfit.skirt * (hip - ankle) + 0.05
        covered = (p[:, 1] > hem) & (part != SHIRT) & (p[:, 1] < waist)
        part[covered & (abs(p[:, 0]) < 0.35)] = SHIRT if outfit.is_dress else TROUSERS
    part[legs & (p[:, 1] < p[:, 1].min() + 0.018)] = SOLE
    return _face(person, outfit, part)


def _face(person: Person, outfit: Outfit, part: np.ndarray) -> Int[np.ndarray, " v"]:
    """Sets hair, eyes, brows, lips and a beard in `part`, in place, and returns it."""
    head, p = Head(person), person.skin
    on_head = person.weights[:, 15] + person.weights[:, 12] > 0.6
    height, azimuth = head.heights(p), head.azimuth(p)
    line = np.interp(
        azimuth, [0, 45, 75, 88, 105, 180], [0.5, 0.5, 0.3, -0.1, -0.6, -0.75]
    )
    front = on_head & (azimuth < 75)
    part[on_head & (height > line)] = HAIR
    for eye in head.eyes:
        near = p - eye
        brow = front & (abs(near[:, 0]) < 0.022) & (abs(near[:, 1] - 0.024) < 0.0045)
        part[brow] = HAIR
        inside = front & (np.hypot(near[:, 0] / 2, near[:, 1]) < 0.0055)
        part[inside] = EYE
        part[inside & (np.hypot(near[:, 0], near[:, 1]) < 0.006)] = IRIS
    mouth = head.nose[1] - 0.37 * head.unit
    if outfit.beard:
        jaw = front | (on_head & (azimuth < 95))
        part[jaw & (height < -0.55) & (p[:, 2] > head.ears[2])] = HAIR
        part[front & (abs(p[:, 1] - mouth - 0.016) < 0.006)] = HAIR
    lips = front & (abs(p[:, 0]) < 0.026) & (abs(p[:, 1] - mouth) < 0.0095)
    part[lips & (p[:, 2] > head.ears[2] + 0.05)] = LIPS
    return part


def draw_outfit(rng: np.random.Generator) -> Outfit:
    """Draws a random style; two people in five wear a skirt, a dress or shorts."""
    kind = rng.choice(["trousers", "trousers", "trousers", "shorts", "skirt", "dress"])
    skirt = rng.uniform(0.42, 0.68) if kind in ("skirt", "dress") else 0.0
    return Outfit(
        sleeves=float(rng.choice([rng.uniform(0.22, 0.45), 0.97])),
        legs=float(rng.uniform(0.36, 0.5)) if kind == "shorts" else 1.0,
        skirt=float(skirt),
        is_dress=kind == "dress",
        looseness=float(rng.uniform(0.5, 1.6)),
        hair=_HAIR_STYLES[rng.integers(len(_HAIR_STYLES))],
        beard=bool(rng.random() < 0.2 and not skirt),
        boots=bool(rng.random() < 0.2),
        pattern=_PATTERNS[rng.integers(len(_PATTERNS))],
    )
