"""Dresses a person: the body's mesh with clothes, hair, shoes and colours.

Cloth stands off the skin and bridges its hollows; colours are drawn at random for each
part.
"""

import copy
import dataclasses

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse
from scipy.ndimage import gaussian_filter

from bodyslam_jax.simulation.garments import (
    EYE,
    HAIR,
    IRIS,
    LIPS,
    PARTS,
    SHIRT,
    SHOES,
    SKIN,
    SOLE,
    TROUSERS,
    Head,
    Outfit,
    draw_outfit,
    hair_sheet,
    parts_of,
    skirt_sheet,
    with_sheet,
    with_shoes,
)
from bodyslam_jax.simulation.posing import Person
from bodyslam_jax.simulation.raster import Hits, vertex_normals

_SKIN_TONES = np.array(
    [
        *((176, 202, 236), (150, 183, 224), (118, 158, 206), (92, 130, 181)),
        *((66, 99, 146), (48, 70, 108), (38, 52, 80)),
    ],
    float,
)
"""Skin colours, BGR, from light to dark."""
_HAIR_COLOURS = np.array(
    [(18, 20, 24), (24, 34, 52), (40, 66, 104), (90, 150, 190), (120, 125, 130)], float
)
"""Hair colours, BGR: black, dark and light brown, fair, grey."""
_FOLD_CELL_M = 0.008
"""Cell size of the noise that models folds of cloth."""


@dataclasses.dataclass(frozen=True)
class Figure:
    """A dressed person: the mesh that is drawn, posed like the body underneath."""

    person: Person
    """The body whose vertices, weights and faces are those of the dressed mesh."""
    outfit: Outfit
    part: Int[np.ndarray, " v"]
    """Index into `PARTS` of each vertex."""
    colours: Float[np.ndarray, "v 3"]
    """Colour of each vertex, BGR, under a light of intensity 1."""
    second: Float[np.ndarray, "3"]
    """Factor on the shirt's colour inside its pattern."""
    folds: Float[np.ndarray, "n n n"]
    """Unevenness of cloth in space, about ±1, repeated every `n` cells."""

    def albedo(
        self, hits: Hits, size: Float[np.ndarray, " p"]
    ) -> Float[np.ndarray, "p 3"]:
        """Returns the colour (BGR) at the hits under a light of intensity 1.

        `size` is that of a pixel on the surface, m; smaller detail is left out.
        """
        corners = self.person.faces[hits.face]
        mean = lambda x: (x[corners] * hits.weights[..., None]).sum(axis=1)
        colour, place = mean(self.colours), mean(self.person.skin)
        shirt = self.part[corners] == SHIRT
        cloth = shirt | (self.part[corners] == TROUSERS)
        shirt, cloth = ((x * hits.weights).sum(axis=1) for x in (shirt, cloth))
        sharp = np.clip(2 - size / 0.012, 0, 1)
        pattern = 0.5 + sharp * (self._pattern(place) - 0.5)
        if self.outfit.pattern != "plain":
            colour = colour * (1 + (self.second - 1) * (pattern * shirt)[:, None])
        cell = np.floor(place / _FOLD_CELL_M).astype(int) % len(self.folds)
        uneven = self.folds[cell[:, 0], cell[:, 1], cell[:, 2]]
        return colour * (1 + (0.03 + 0.13 * cloth) * uneven)[:, None]

    def _pattern(self, place: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, " p"]:
        """Returns 1 where the shirt has its second colour, else 0."""
        x, y, z = place.T
        odd = lambda value, step: np.floor(value / step) % 2
        if self.outfit.pattern == "stripes":
            return odd(y, 0.045)
        if self.outfit.pattern == "checks":
            return np.abs(odd(x, 0.05) - odd(y, 0.05))
        chest = self.person.rest[9]
        inside = (abs(x) < 0.09) & (abs(y - chest[1] - 0.12) < 0.07) & (z > chest[2])
        return inside * odd(x + 0.3 * y, 0.03)


def dress(
    person: Person, rng: np.random.Generator, outfit: Outfit | None = None
) -> Figure:
    """Dresses a person; colours are drawn from `rng`, as is the outfit if not given."""
    drawn = draw_outfit(rng)
    outfit = outfit or drawn
    part = parts_of(person, outfit)
    skin = clothed_skin(person, outfit, part)
    weights, faces = person.weights, person.faces
    colours = vertex_colours(person, part, rng)
    if outfit.skirt:
        cloth = SHIRT if outfit.is_dress else TROUSERS
        skin, weights, faces, part, colours = with_sheet(
            (skin, weights, faces, part, colours), skirt_sheet(person, outfit), cloth
        )
    mesh = skin, weights, faces, part, colours
    skin, weights, faces, part, colours = with_shoes(mesh, person)
    if outfit.hair in ("long", "tail"):
        skin, weights, faces, part, colours = with_sheet(
            (skin, weights, faces, part, colours), hair_sheet(person, outfit), HAIR
        )
    dressed = copy.copy(person)
    dressed.skin, dressed.weights, dressed.faces = skin, weights, faces
    second = rng.choice([rng.uniform(0.35, 0.7), rng.uniform(1.4, 2.0)])
    second = second * rng.uniform(0.8, 1.2, 3)
    folds = gaussian_filter(
        rng.standard_normal((48, 48, 48)), (2.5, 5.0, 2.5), mode="wrap"
    )
    return Figure(dressed, outfit, part, colours, second, folds / folds.std())


def clothed_skin(
    person: Person, outfit: Outfit, part: Int[np.ndarray, " v"]
) -> Float[np.ndarray, "v 3"]:
    """Returns the vertices of the outer surface: cloth, shoes, hair and bare skin, m.

    Cloth is the skin smoothed, so that it bridges hollows, and displaced along its
    normals; soles stay on the floor.
    """
    p, rest, faces = person.skin, person.rest, person.faces
    smooth = smoother(faces, len(p))
    moved = p.copy()
    for kind, rounds in ((SHIRT, 30), (TROUSERS, 12), (SHOES, 25)):
        of_kind = np.isin(part, (SHOES, SOLE)) if kind == SHOES else part == kind
        for _ in range(rounds):
            moved[of_kind] = (smooth @ moved)[of_kind]
    moved[part == SOLE, 1] = p[part == SOLE, 1]
    normal = vertex_normals(moved, faces)
    hip, ankle = rest[[1, 2], 1].mean(), rest[[7, 8], 1].mean()
    down = np.clip((hip - p[:, 1]) / (hip - ankle), 0, 1)
    head = Head(person)
    off = np.zeros(len(p))
    hang = np.clip((rest[9, 1] - p[:, 1]) / (rest[9, 1] - hip), 0, 1)
    shirt = outfit.looseness * (0.010 + 0.010 * hang)
    off = np.where(part == SHIRT, shirt + 0.004, off)
    off = np.where(part == TROUSERS, outfit.looseness * (0.006 + 0.014 * down), off)
    off = np.where(np.isin(part, (SHOES, SOLE)), 0.010, off)
    thick = {"short": 0.014, "cap": 0.030, "long": 0.022, "tail": 0.012}[outfit.hair]
    grown = np.clip(head.heights(p) + 0.6, 0.15, 1.0)
    on_scalp = (part == HAIR) & (head.azimuth(p) > 75) | (head.heights(p) > 0.4)
    off = np.where((part == HAIR) & on_scalp, thick * grown, off)
    off = (smooth @ off + off) / 2
    moved = moved + off[:, None] * normal
    floor = p[:, 1].min()
    moved[:, 1] = np.maximum(moved[:, 1], np.minimum(p[:, 1], floor + 0.01))
    return moved


def smoother(faces: Int[np.ndarray, "f 3"], count: int) -> sparse.csr_matrix:
    """Returns the matrix that averages values over neighbours along the edges of a
    mesh."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = np.unique(np.sort(edges.astype(np.int64), axis=1), axis=0)
    i, j = np.concatenate([edges, edges[:, ::-1]]).T
    degree = np.maximum(np.bincount(i, minlength=count), 1)
    mean = sparse.csr_matrix((1 / degree[i], (i, j)), shape=(count, count))
    alone = sparse.diags((np.bincount(i, minlength=count) == 0).astype(float))
    return sparse.csr_matrix(0.5 * mean + 0.5 * sparse.identity(count) + 0.5 * alone)


def vertex_colours(
    person: Person, part: np.ndarray, rng: np.random.Generator
) -> Float[np.ndarray, "v 3"]:
    """Returns the colour (BGR) of each vertex, by part, with some variation of skin and
    cloth."""
    tone = _SKIN_TONES[rng.integers(len(_SKIN_TONES))] * rng.uniform(0.93, 1.07, 3)
    cloth = lambda low, high, spread: np.clip(
        rng.uniform(low, high) + rng.uniform(-spread, spread, 3), 12, 235
    )
    palette = np.empty((len(PARTS), 3))
    palette[SKIN] = tone
    palette[SHIRT] = cloth(50, 210, 60)
    palette[TROUSERS] = cloth(28, 130, 28)
    palette[SHOES] = cloth(20, 150, 25)
    palette[SOLE] = rng.choice([25.0, 190.0])
    hair = _HAIR_COLOURS[rng.integers(len(_HAIR_COLOURS) if tone[2] > 150 else 2)]
    palette[HAIR] = hair * rng.uniform(0.8, 1.2)
    palette[EYE] = (215, 218, 220)
    palette[IRIS] = (35, 38, 42)
    palette[LIPS] = tone * (0.62, 0.58, 0.82)
    colours = palette[part]
    head, p = Head(person), person.skin
    for eye in head.eyes:  # The hollow of the eye is in shadow.
        near = np.exp(-(((p - eye) / (0.017, 0.013, 0.03)) ** 2).sum(axis=1))
        colours = np.where(
            (part == SKIN)[:, None], colours * (1 - 0.4 * near[:, None]), colours
        )
    under = np.exp(
        -(((p - head.nose + (0, 0.016, 0)) / (0.012, 0.006, 0.03)) ** 2).sum(1)
    )
    colours = np.where(
        (part == SKIN)[:, None], colours * (1 - 0.35 * under[:, None]), colours
    )
    return colours
