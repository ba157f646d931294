"""Keypoints of any common layout -> BODY_25.

A layout lists the part of the body that each of a detector's points is; the parts are
BODY_25's, and two more that other detectors have. Sources: OpenPose's documentation
(BODY_25, BODY_25B, COCO-18), COCO, COCO-WholeBody, Halpe (AlphaPose), ViTPose+ with
feet (easy_ViTPose's `coco_25`), Human3.6M as in MMPose, Kinect v2 (NTU RGB+D).

Names that files give their keypoints are mapped to parts of the body (`names_in`).
"""

import dataclasses
import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from bodyslam_jax.body.skeleton import BODY25

HEAD_TOP, SPINE = 25, 26
"""Parts that BODY_25 does not have, after those that it has."""
NUM_PARTS = SPINE + 1
_MIDDLE = {
    "nose": BODY25["nose"],
    **dict.fromkeys(("neck", "thorax", "midshoulder"), BODY25["neck"]),
    **dict.fromkeys(
        ("hip", "hips", "midhip", "hipcenter", "hipscenter", "centerhip"),
        BODY25["mid_hip"],
    ),
    **dict.fromkeys(("pelvis", "root"), BODY25["mid_hip"]),
    **dict.fromkeys(("head", "headtop", "tophead"), HEAD_TOP),
    **dict.fromkeys(("spine", "torso"), SPINE),
}


@dataclasses.dataclass(frozen=True)
class Layout:
    """An order of keypoints."""

    parts: list[int]
    """The part of the body that each point is, or -1 for none of them."""
    definition: str | None = None
    """Definition of hip and knee of its detectors, a name in
    `body.KEYPOINT_DEFINITIONS`; `None` if detectors of several definitions write this
    order."""


_AS_COCO17 = [0, 16, 15, 18, 17, 5, 2, 6, 3, 7, 4, 12, 9, 13, 10, 14, 11]
_HUMAN36M = [*range(8, 15), SPINE, 1, 0, HEAD_TOP, 5, 6, 7, 2, 3, 4]
_FEET = [19, 20, 21, 22, 23, 24]
_HALPE = [*_AS_COCO17, HEAD_TOP, 1, 8, 19, 22, 20, 23, 21, 24]
VITPOSE = [0, 16, 15, 18, 17, 1, 5, 2, 6, 3, 7, 4, 12, 9, 8, 13, 10, 14, 11, *_FEET]
LAYOUTS: dict[int, dict[str, Layout]] = {
    17: {
        "COCO": Layout(_AS_COCO17, "coco"),
        "Human3.6M": Layout(_HUMAN36M),
    },
    18: {
        "OpenPose's COCO": Layout(
            [0, 1, 2, 3, 4, 5, 6, 7, *range(9, 15), 15, 16, 17, 18], "openpose"
        ),
        "COCO, then the neck": Layout([*_AS_COCO17, 1], "coco"),
    },
    25: {
        "BODY_25": Layout(list(range(25))),
        # Its neck is the upper end of the neck, not the middle of the shoulders.
        "BODY_25B": Layout([*_AS_COCO17, -1, HEAD_TOP, *_FEET], "openpose"),
        "ViTPose with feet": Layout(VITPOSE, "coco"),
        "Kinect v2": Layout(
            [
                *[8, SPINE, -1, HEAD_TOP, 5, 6, 7, -1, 2, 3, 4, -1, 12, 13, 14, -1],
                *[9, 10, 11, -1, 1, -1, -1, -1, -1],
            ]
        ),
    },
    26: {"Halpe": Layout(_HALPE, "halpe")},
    133: {"COCO-WholeBody": Layout([*_AS_COCO17, *_FEET, *[-1] * 110], "coco")},
    # Face and hands follow.
    136: {"Halpe, full body": Layout([*_HALPE, *[-1] * 110], "halpe")},
}
"""Layouts by their number of keypoints, the usual one first."""
_MIDPOINTS = (
    (BODY25["neck"], BODY25["right_shoulder"], BODY25["left_shoulder"]),
    (BODY25["mid_hip"], BODY25["right_hip"], BODY25["left_hip"]),
)
"""Keypoints that are the middle of two others."""


def usual_layout(num: int) -> Layout | None:
    """Returns the usual layout of `num` keypoints; `None` if none has as many."""
    return next(iter(LAYOUTS.get(num, {}).values()), None)


def from_layout(points: np.ndarray, layout: list[int]) -> np.ndarray:
    """Returns BODY_25 of keypoints (..., j, 3) whose parts are those of `layout`."""
    index = np.full(25, -1)
    for place, part in enumerate(layout):
        if 0 <= part < 25:
            index[part] = place
    found = np.where((index >= 0)[:, None], points[..., index, :], 0.0)
    for missing, a, b in _MIDPOINTS:
        if index[missing] < 0:
            # As OpenPose was trained: the middle of the pair, if both are detected.
            found[..., missing, :2] = (found[..., a, :2] + found[..., b, :2]) / 2
            found[..., missing, 2] = np.minimum(found[..., a, 2], found[..., b, 2])
    return found


def _sided(**parts: str) -> dict[str, tuple[int, int]]:
    """Returns right and left keypoint of each part of BODY_25, by each word for it."""
    return {
        word: (BODY25[f"right_{part}"], BODY25[f"left_{part}"])
        for part, words in parts.items()
        for word in words.split()
    }


_SIDED = _sided(
    shoulder="shoulder sho",
    elbow="elbow elb",
    wrist="wrist wri",
    hip="hip",
    knee="knee",
    ankle="ankle ank",
    eye="eye",
    ear="ear",
    big_toe="bigtoe toe footindex",
    small_toe="smalltoe littletoe",
    heel="heel",
)
_SECOND_CHOICES = _sided(wrist="hand", ankle="foot")
"""Names that some files give wrist and ankle; they count if no other name has them."""
_RIGHT, _LEFT = {"right", "r"}, {"left", "l"}
_LIMBS = {
    BODY25[f"{side}_{part}"]
    for side in ("right", "left")
    for part in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
}
_MIN_LIMB_JOINTS = 8
"""Least number of the twelve joints of the limbs that must be named."""


def layout_of(names: Sequence[Any]) -> list[int] | None:
    """Returns the part of each name, as in `LAYOUTS`; `None` if too few are a
    body's."""
    words = [_words(str(name)) for name in names]
    layout = [_part(side, rest, _SIDED) for side, rest in words]
    for place, (side, rest) in enumerate(words):
        part = _part(side, rest, _SECOND_CHOICES)
        if part >= 0 and part not in layout:
            layout[place] = part
    taken: set[int] = set()
    for place, part in enumerate(layout):
        # Of two names of one part, such as `head` and `head_top`, the first counts.
        if part in taken:
            layout[place] = -1
        taken.add(part)
    return layout if len(_LIMBS & set(layout)) >= _MIN_LIMB_JOINTS else None


def names_in(data: Any) -> list[str] | None:
    """Returns the names of keypoints that a JSON file's header gives, in order; or
    None.

    easy_ViTPose has `skeleton`, by index; MMPose `keypoint_id2name` in its metadata;
    COCO lists of `keypoints` in `categories`; others plain lists.
    """
    if not isinstance(data, dict):
        return None
    for key in ("meta_info", "dataset_meta", "metadata", "meta", "info"):
        if (found := names_in(data.get(key))) is not None:
            return found
    for key in _KEYS:
        if (found := _listed(data.get(key))) is not None:
            return found
    by_name = data.get("keypoint_name2id")
    if isinstance(by_name, dict):
        return _listed({str(v): k for k, v in by_name.items()})
    categories = data.get("categories")
    for category in categories if isinstance(categories, list) else []:
        if isinstance(category, dict) and (found := _listed(category.get("keypoints"))):
            return found
    return None


_KEYS = ("keypoint_id2name", "skeleton", "keypoint_names", "keypoints_names")
_KEYS += ("joint_names", "keypoint_labels", "names", "bodyparts")


def _listed(value: Any) -> list[str] | None:
    """Returns names in order, of a list or by index; None if it is something else."""
    if isinstance(value, dict):
        try:
            value = {int(k): v for k, v in value.items()}
        except (TypeError, ValueError, OverflowError):
            return None
        if sorted(value) != list(range(len(value))):
            return None
        value = [value[k] for k in range(len(value))]
    if not isinstance(value, list) or not value:
        return None
    return value if all(isinstance(name, str) for name in value) else None


def _words(name: str) -> tuple[str, str]:
    """Returns the side in a name, `r`, `l` or nothing, and the rest of the name,
    joined."""
    name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", " ", name)
    words = [w for w in re.split(r"[^a-z0-9]+", name.lower()) if w]
    side = next((w for w in words if w in _RIGHT | _LEFT), "")
    if side:
        words.remove(side)
    elif len(words) == 1 and words[0][:1] in ("l", "r") and words[0][1:] in _SIDED:
        side, words = words[0][0], [words[0][1:]]
    elif len(words) == 1:
        for long in ("right", "left"):
            if words[0].startswith(long) and words[0] != long:
                side, words = long, [words[0].removeprefix(long)]
    if words and words[-1] in ("joint", "keypoint"):
        words.pop()
    return side[:1], "".join(words)


def _part(side: str, rest: str, sided: dict[str, tuple[int, int]]) -> int:
    if side and rest in sided:
        return sided[rest][side == "l"]
    return _MIDDLE.get(rest, -1) if not side else -1
