"""What a person wears: clothes, hair, shoes and a face on the body's mesh.

A detector trained on photographs looks for people in clothes. So the skin gets colours
by part, clothes stand off it and bridge its hollows, a skirt or long hair is geometry
of its own, and a head has eyes, brows and a mouth where the body model has them. Joints
and postures stay those of the body underneath: what is drawn is another outline only.
"""

import copy
import dataclasses
from typing import Literal

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse
from scipy.ndimage import gaussian_filter
from scipy.spatial import ConvexHull

from bodyslam_jax.body.skeleton import SURFACE_POINTS
from bodyslam_jax.simulation.posing import Person
from bodyslam_jax.simulation.raster import Hits, vertex_normals

PARTS = ("skin", "shirt", "trousers", "shoes", "sole", "hair", "eye", "iris", "lips")
"""What a vertex can be; trousers are a skirt as well."""
_SKIN, _SHIRT, _TROUSERS, _SHOES, _SOLE, _HAIR, _EYE, _IRIS, _LIPS = range(len(PARTS))
_TONES = np.array(
    [
        *((176, 202, 236), (150, 183, 224), (118, 158, 206), (92, 130, 181)),
        *((66, 99, 146), (48, 70, 108), (38, 52, 80)),
    ],
    float,
)
"""Skin, BGR, from light to dark."""
_HAIRS = np.array(
    [(18, 20, 24), (24, 34, 52), (40, 66, 104), (90, 150, 190), (120, 125, 130)], float
)
"""Hair, BGR: black, dark and light brown, fair, grey."""
_RINGS, _SPOKES = 14, 40
_FOLD = 0.008
"""Size of a cell of the noise that folds are made of, m."""


@dataclasses.dataclass(frozen=True)
class Outfit:
    """A style of clothes and hair; lengths are shares of the limb that they cover."""

    sleeves: float = 0.6
    """Of the arm, from 0.2 (a T-shirt) to 1."""
    legs: float = 1.0
    """Of the leg, from 0.35 (shorts) to 1."""
    skirt: float = 0.0
    """Of the leg, from the waist down; 0 is none."""
    is_dress: bool = False
    """Whether the skirt is of the shirt's cloth."""
    looseness: float = 1.0
    """How far clothes stand off: 1 is about 15 mm at the trunk."""
    hair: Literal["short", "cap", "long", "tail"] = "short"
    beard: bool = False
    boots: bool = False
    pattern: Literal["plain", "stripes", "checks", "print"] = "plain"
    """Of the shirt."""


@dataclasses.dataclass(frozen=True)
class Figure:
    """A dressed person: the mesh that is drawn, posed like the body underneath."""

    person: Person
    """The body whose vertices, weights and faces are those of the dressed mesh."""
    outfit: Outfit
    part: Int[np.ndarray, " v"]
    """Index into `PARTS` of each vertex."""
    colours: Float[np.ndarray, "v 3"]
    """BGR under a light of strength 1."""
    second: Float[np.ndarray, "3"]
    """Factor on the shirt's colour where its pattern is."""
    folds: Float[np.ndarray, "n n n"]
    """Unevenness of cloth in space, about ±1, repeated every `n` cells."""

    def albedo(
        self, hits: Hits, size: Float[np.ndarray, " p"]
    ) -> Float[np.ndarray, "p 3"]:
        """Colour under a light of strength 1 where the mesh is hit; pixels are of
        `size` m there, and what is smaller than one is not drawn."""
        corners = self.person.faces[hits.face]
        mean = lambda x: (x[corners] * hits.weights[..., None]).sum(axis=1)
        colour, place = mean(self.colours), mean(self.person.skin)
        shirt = self.part[corners] == _SHIRT
        cloth = shirt | (self.part[corners] == _TROUSERS)
        shirt, cloth = ((x * hits.weights).sum(axis=1) for x in (shirt, cloth))
        sharp = np.clip(2 - size / 0.012, 0, 1)
        pattern = 0.5 + sharp * (self._pattern(place) - 0.5)
        if self.outfit.pattern != "plain":
            colour = colour * (1 + (self.second - 1) * (pattern * shirt)[:, None])
        cell = np.floor(place / _FOLD).astype(int) % len(self.folds)
        uneven = self.folds[cell[:, 0], cell[:, 1], cell[:, 2]]
        return colour * (1 + (0.03 + 0.13 * cloth) * uneven)[:, None]

    def _pattern(self, place: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, " p"]:
        """0 or 1: where the shirt has its second colour."""
        x, y, z = place.T
        odd = lambda value, step: np.floor(value / step) % 2
        if self.outfit.pattern == "stripes":
            return odd(y, 0.045)
        if self.outfit.pattern == "checks":
            return np.abs(odd(x, 0.05) - odd(y, 0.05))
        chest = self.person.rest[9]
        inside = (abs(x) < 0.09) & (abs(y - chest[1] - 0.12) < 0.07) & (z > chest[2])
        return inside * odd(x + 0.3 * y, 0.03)


def draw_outfit(rng: np.random.Generator) -> Outfit:
    """A style at random; two people in five wear a skirt, a dress or shorts."""
    kind = rng.choice(["trousers", "trousers", "trousers", "shorts", "skirt", "dress"])
    skirt = rng.uniform(0.42, 0.68) if kind in ("skirt", "dress") else 0.0
    return Outfit(
        sleeves=float(rng.choice([rng.uniform(0.22, 0.45), 0.97])),
        legs=float(rng.uniform(0.36, 0.5)) if kind == "shorts" else 1.0,
        skirt=float(skirt),
        is_dress=kind == "dress",
        looseness=float(rng.uniform(0.5, 1.6)),
        hair=str(rng.choice(["short", "short", "cap", "long", "tail"])),  # pyright: ignore
        beard=bool(rng.random() < 0.2 and not skirt),
        boots=bool(rng.random() < 0.2),
        pattern=str(rng.choice(["plain", "plain", "stripes", "checks", "print"])),  # pyright: ignore
    )


def dress(
    person: Person, rng: np.random.Generator, outfit: Outfit | None = None
) -> Figure:
    """Dresses a person; colours are drawn from `rng`, as is the outfit if not given."""
    drawn = draw_outfit(rng)
    outfit = outfit or drawn
    part = _parts(person, outfit)
    skin = _clothed(person, outfit, part)
    weights, faces = person.weights, person.faces
    colours = _colours(person, outfit, part, rng)
    if outfit.skirt:
        cloth = _SHIRT if outfit.is_dress else _TROUSERS
        skin, weights, faces, part, colours = _with_sheet(
            (skin, weights, faces, part, colours), _skirt(person, outfit), cloth
        )
    mesh = skin, weights, faces, part, colours
    skin, weights, faces, part, colours = _with_shoes(mesh, person, outfit)
    if outfit.hair in ("long", "tail"):
        skin, weights, faces, part, colours = _with_sheet(
            (skin, weights, faces, part, colours), _long_hair(person, outfit), _HAIR
        )
    dressed = copy.copy(person)
    dressed.skin, dressed.weights, dressed.faces = skin, weights, faces
    second = rng.choice([rng.uniform(0.35, 0.7), rng.uniform(1.4, 2.0)])
    second = second * rng.uniform(0.8, 1.2, 3)
    folds = gaussian_filter(
        rng.standard_normal((48, 48, 48)), (2.5, 5.0, 2.5), mode="wrap"
    )
    return Figure(dressed, outfit, part, colours, second, folds / folds.std())


class _Head:
    """Where things are on a head of any shape, m, at rest."""

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
        """Over the eyes, in units."""
        return (p[:, 1] - self.level) / self.unit

    def azimuth(self, p: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, " v"]:
        """From the front (0) over the ears (90) to the back of the head, degrees."""
        return np.degrees(np.arctan2(abs(p[:, 0]), p[:, 2] - self.ears[2]))


def _parts(person: Person, outfit: Outfit) -> Int[np.ndarray, " v"]:
    """What each vertex of the body is, by the joint it follows and where it is."""
    p, rest = person.skin, person.rest
    joint = person.weights.argmax(axis=1)
    part = np.full(len(p), _SKIN)
    neckline = rest[12, 1] - 0.035
    trunk = np.isin(joint, (0, 3, 6, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21, 1, 2))
    wrist = abs(rest[[20, 21], 0]).mean()
    shoulder = abs(rest[[16, 17], 0]).mean()
    sleeve = shoulder + outfit.sleeves * (wrist - shoulder)
    collar = neckline + 0.25 * np.clip(abs(p[:, 0]) - 0.06, 0, 0.05)
    part[trunk & (p[:, 1] < collar) & (abs(p[:, 0]) < sleeve)] = _SHIRT
    hip, ankle = rest[[1, 2], 1].mean(), rest[[7, 8], 1].mean()
    waist = hip + 0.055
    hem = hip - outfit.legs * (hip - ankle) - 0.02
    part[(p[:, 1] < waist) & (p[:, 1] > hem) & (abs(p[:, 0]) < 0.35)] = _TROUSERS
    legs = p[:, 1] < hip - 0.1
    top_of_shoe = ankle + (0.22 if outfit.boots else 0.02)
    under = p[:, 1] < top_of_shoe
    part[legs & under] = _SHOES
    if outfit.legs >= 0.9 and not outfit.boots:  # trousers fall over the shoe
        part[legs & (p[:, 1] > ankle - 0.005)] = _TROUSERS
    if outfit.skirt:
        part[legs & (p[:, 1] >= top_of_shoe)] = _SKIN
        hem = hip - outfit.skirt * (hip - ankle) + 0.05
        covered = (p[:, 1] > hem) & (part != _SHIRT) & (p[:, 1] < waist)
        part[covered & (abs(p[:, 0]) < 0.35)] = _SHIRT if outfit.is_dress else _TROUSERS
    part[legs & (p[:, 1] < p[:, 1].min() + 0.018)] = _SOLE
    return _face(person, outfit, part)


def _face(person: Person, outfit: Outfit, part: np.ndarray) -> Int[np.ndarray, " v"]:
    """Hair, eyes, brows, lips and a beard."""
    head, p = _Head(person), person.skin
    on_head = person.weights[:, 15] + person.weights[:, 12] > 0.6
    height, azimuth = head.heights(p), head.azimuth(p)
    line = np.interp(
        azimuth, [0, 45, 75, 88, 105, 180], [0.5, 0.5, 0.3, -0.1, -0.6, -0.75]
    )
    front = on_head & (azimuth < 75)
    part[on_head & (height > line)] = _HAIR
    for eye in head.eyes:
        near = p - eye
        brow = front & (abs(near[:, 0]) < 0.022) & (abs(near[:, 1] - 0.024) < 0.0045)
        part[brow] = _HAIR
        inside = front & (np.hypot(near[:, 0] / 2, near[:, 1]) < 0.0055)
        part[inside] = _EYE
        part[inside & (np.hypot(near[:, 0], near[:, 1]) < 0.006)] = _IRIS
    mouth = head.nose[1] - 0.37 * head.unit
    if outfit.beard:
        jaw = front | (on_head & (azimuth < 95))
        part[jaw & (height < -0.55) & (p[:, 2] > head.ears[2])] = _HAIR
        part[front & (abs(p[:, 1] - mouth - 0.016) < 0.006)] = _HAIR
    lips = front & (abs(p[:, 0]) < 0.026) & (abs(p[:, 1] - mouth) < 0.0095)
    part[lips & (p[:, 2] > head.ears[2] + 0.05)] = _LIPS
    return part


def _clothed(
    person: Person, outfit: Outfit, part: Int[np.ndarray, " v"]
) -> Float[np.ndarray, "v 3"]:
    """The skin moved to where cloth, shoes and hair are, m.

    Cloth is the skin smoothed, so that it spans hollows, and pushed out along normals;
    soles stay on the floor.
    """
    p, rest, faces = person.skin, person.rest, person.faces
    smooth = _smoother(faces, len(p))
    moved = p.copy()
    for kind, rounds in ((_SHIRT, 30), (_TROUSERS, 12), (_SHOES, 25)):
        of_kind = np.isin(part, (_SHOES, _SOLE)) if kind == _SHOES else part == kind
        for _ in range(rounds):
            moved[of_kind] = (smooth @ moved)[of_kind]
    moved[part == _SOLE, 1] = p[part == _SOLE, 1]
    normal = vertex_normals(moved, faces)
    hip, ankle = rest[[1, 2], 1].mean(), rest[[7, 8], 1].mean()
    down = np.clip((hip - p[:, 1]) / (hip - ankle), 0, 1)
    head = _Head(person)
    off = np.zeros(len(p))
    hang = np.clip((rest[9, 1] - p[:, 1]) / (rest[9, 1] - hip), 0, 1)
    shirt = outfit.looseness * (0.010 + 0.010 * hang)
    off = np.where(part == _SHIRT, shirt + 0.004, off)
    off = np.where(part == _TROUSERS, outfit.looseness * (0.006 + 0.014 * down), off)
    off = np.where(np.isin(part, (_SHOES, _SOLE)), 0.010, off)
    thick = {"short": 0.014, "cap": 0.030, "long": 0.022, "tail": 0.012}[outfit.hair]
    grown = np.clip(head.heights(p) + 0.6, 0.15, 1.0)
    on_scalp = (part == _HAIR) & (head.azimuth(p) > 75) | (head.heights(p) > 0.4)
    off = np.where((part == _HAIR) & on_scalp, thick * grown, off)
    off = (smooth @ off + off) / 2
    moved = moved + off[:, None] * normal
    floor = p[:, 1].min()
    moved[:, 1] = np.maximum(moved[:, 1], np.minimum(p[:, 1], floor + 0.01))
    return moved


def _smoother(faces: Int[np.ndarray, "f 3"], count: int) -> sparse.csr_matrix:
    """Averages over neighbours along the edges of a mesh."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = np.unique(np.sort(edges.astype(np.int64), axis=1), axis=0)
    i, j = np.concatenate([edges, edges[:, ::-1]]).T
    degree = np.maximum(np.bincount(i, minlength=count), 1)
    mean = sparse.csr_matrix((1 / degree[i], (i, j)), shape=(count, count))
    alone = sparse.diags((np.bincount(i, minlength=count) == 0).astype(float))
    return sparse.csr_matrix(0.5 * mean + 0.5 * sparse.identity(count) + 0.5 * alone)


def _colours(
    person: Person, outfit: Outfit, part: np.ndarray, rng: np.random.Generator
) -> Float[np.ndarray, "v 3"]:
    """BGR of each vertex, by part and with some unevenness of skin and cloth."""
    tone = _TONES[rng.integers(len(_TONES))] * rng.uniform(0.93, 1.07, 3)
    cloth = lambda low, high, spread: np.clip(
        rng.uniform(low, high) + rng.uniform(-spread, spread, 3), 12, 235
    )
    palette = np.empty((len(PARTS), 3))
    palette[_SKIN] = tone
    palette[_SHIRT] = cloth(50, 210, 60)
    palette[_TROUSERS] = cloth(28, 130, 28)
    palette[_SHOES] = cloth(20, 150, 25)
    palette[_SOLE] = rng.choice([25.0, 190.0])
    hair = _HAIRS[rng.integers(len(_HAIRS) if tone[2] > 150 else 2)]
    palette[_HAIR] = hair * rng.uniform(0.8, 1.2)
    palette[_EYE] = (215, 218, 220)
    palette[_IRIS] = (35, 38, 42)
    palette[_LIPS] = tone * (0.62, 0.58, 0.82)
    colours = palette[part]
    head, p = _Head(person), person.skin
    for eye in head.eyes:  # The hollow of the eye is in shadow.
        near = np.exp(-(((p - eye) / (0.017, 0.013, 0.03)) ** 2).sum(axis=1))
        colours = np.where(
            (part == _SKIN)[:, None], colours * (1 - 0.4 * near[:, None]), colours
        )
    under = np.exp(
        -(((p - head.nose + (0, 0.016, 0)) / (0.012, 0.006, 0.03)) ** 2).sum(1)
    )
    colours = np.where(
        (part == _SKIN)[:, None], colours * (1 - 0.35 * under[:, None]), colours
    )
    return colours


def _skirt(person: Person, outfit: Outfit):
    """A cone from the waist down: rings of vertices that follow the nearer thigh."""
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


def _long_hair(person: Person, outfit: Outfit):
    """A sheet round the back of the head down to the shoulders, or a tail."""
    head, rest = _Head(person), person.rest
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


def _with_shoes(mesh, person: Person, outfit: Outfit):
    """The mesh with the convex hull of each foot, 8 mm thick, over the foot."""
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
        kind = np.where(q[:, 1] < floor + 0.012, _SOLE, _SHOES)
        faces = faces[~np.isin(faces, own).all(axis=1)]
        faces = np.concatenate([faces, (corner + len(skin)).astype(faces.dtype)])
        skin = np.concatenate([skin, q])
        weights = np.concatenate([weights, person.weights[own[used]]])
        part = np.concatenate([part, kind])
        palette = [
            np.median(colours[part[: len(colours)] == k], axis=0)
            for k in (_SHOES, _SOLE)
        ]
        colours = np.concatenate(
            [colours, np.where((kind == _SHOES)[:, None], *palette)]
        )
    return skin, weights, faces, part, colours


def _with_sheet(mesh, sheet, kind: int):
    """The mesh with a sheet of rings added, seen from both sides."""
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
    twice = np.concatenate([out, out[:, ::-1] + n * m])  # its inside has own normals
    colour = np.median(colours[part == kind], axis=0) if (part == kind).any() else 60.0
    count = 2 * n * m
    return (
        np.concatenate([skin, *(2 * [rows.reshape(-1, 3)])]),
        np.concatenate([weights, *(2 * [more.reshape(-1, 24)])]),
        np.concatenate([faces, twice.astype(faces.dtype)]),
        np.concatenate([part, np.full(count, kind)]),
        np.concatenate([colours, np.broadcast_to(colour, (count, 3))]),
    )
