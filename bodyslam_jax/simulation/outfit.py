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
