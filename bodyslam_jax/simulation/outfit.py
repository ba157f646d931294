"""Styles of clothes and hair, and the parts of a dressed person.

A detector trained on photographs expects people in clothes. Joints and body poses are
those of the body underneath; clothes change the outline and the colours only.
"""

import dataclasses
from typing import Literal

import numpy as np

PARTS = ("skin", "shirt", "trousers", "shoes", "sole", "hair", "eye", "iris", "lips")
"""Parts of the outfit that a vertex can belong to; a skirt counts as trousers."""
SKIN, SHIRT, TROUSERS, SHOES, SOLE, HAIR, EYE, IRIS, LIPS = range(len(PARTS))

_Hair = Literal["short", "cap", "long", "tail"]
_Pattern = Literal["plain", "stripes", "checks", "print"]
_HAIR_STYLES: tuple[_Hair, ...] = ("short", "short", "cap", "long", "tail")
_PATTERNS: tuple[_Pattern, ...] = ("plain", "plain", "stripes", "checks", "print")
"""Hair styles and patterns to draw from; the first of each is twice as likely."""


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
