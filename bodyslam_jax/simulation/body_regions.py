"""Assigns a part of the outfit (shirt, skin, hair, ...) to each vertex of a mesh.

All positions are of the rest pose.

`Outfit` is a style of clothes and hair. A detector trained on photographs expects
people in clothes. Joints and body poses are those of the body underneath; clothes
change the outline and the colours only.
"""

import dataclasses
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from bodyslam_jax.body.skeleton import SURFACE_POINTS
from bodyslam_jax.simulation.posing import Person

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
