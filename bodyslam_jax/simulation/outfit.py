"""Styles of clothes and hair, and the parts of a dressed person.

A detector trained on photographs expects people in clothes. Joints and body poses are
those of the body underneath; clothes change the outline and the colours only.
"""

import dataclasses
from typing import Literal

import numpy as np

PARTS = ("skin", "shirt", "trousers", "shoes", "sole", "hair", "eye", "iris", "lips")
"""What a vertex can be; trousers are a skirt as well."""
SKIN, SHIRT, TROUSERS, SHOES, SOLE, HAIR, EYE, IRIS, LIPS = range(len(PARTS))

_Hair = Literal["short", "cap", "long", "tail"]
_Pattern = Literal["plain", "stripes", "checks", "print"]
_HAIR: tuple[_Hair, ...] = ("short", "short", "cap", "long", "tail")
_PATTERNS: tuple[_Pattern, ...] = ("plain", "plain", "stripes", "checks", "print")
"""Those drawn at random; the first is drawn twice as often."""


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
    hair: _Hair = "short"
    beard: bool = False
    boots: bool = False
    pattern: _Pattern = "plain"
    """Of the shirt."""


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
        hair=_HAIR[rng.integers(len(_HAIR))],
        beard=bool(rng.random() < 0.2 and not skirt),
        boots=bool(rng.random() < 0.2),
        pattern=_PATTERNS[rng.integers(len(_PATTERNS))],
    )
