"""Keypoints as a file lists them -> BODY_25.

Removes invalid values, finds the layout, and exchanges x and y where they are swapped.

x and y that were exchanged show by people who lie on their side. With (y, x) in place
of (x, y) everybody lies with the head to the left. So they do if the image is rotated
by 90 degrees, but then they are not mirrored: in an upright image, a person who faces
the camera has the right side of the body on the left.
"""

import dataclasses
from pathlib import Path

import numpy as np
from jaxtyping import Float

from bodyslam_jax.body.skeleton import BODY25, BODY25_FACE, BODY25_TOES_AND_HEELS
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io.frame_index import Warn
from bodyslam_jax.io.keypoints.keypoint_format import Listed
from bodyslam_jax.io.keypoints.layout_evidence import choose_layout
from bodyslam_jax.io.keypoints.layouts import LAYOUTS, VITPOSE, from_layout, layout_of

_MAX_LOST_SHARE = 0.5
"""Share of detections that are not usable from which a file is refused."""
_MIN_VALID_POINTS = 4
"""Least number of valid points of a usable detection."""
_MIN_LYING_SHARE = 0.85
"""Share of the detections that lie sideways from which the reason is the image axes,
not posture."""
_MIN_MIRRORED_SHARE = 0.7
"""Least share of mirrored detections with which x and y are exchanged."""
_MIN_DETECTIONS = 10
"""Least number of detections for a decision about x and y."""
_MIN_PRESENT_CONFIDENCE = 0.05
_MIN_CONFIDENCE = 0.3
_NECK, _MID_HIP = BODY25["neck"], BODY25["mid_hip"]
_RIGHT, _LEFT = (
    (BODY25[f"{side}_shoulder"], BODY25[f"{side}_hip"]) for side in ("right", "left")
)
_FEET = (BODY25_TOES_AND_HEELS[:2], BODY25_TOES_AND_HEELS[2:])
"""Toe and heel of either foot."""
_MAX_TRUNK_SLOPE_DEG = 35.0
"""Largest angle between the trunk of a lying person and the image's rows, degrees."""
_MIN_BREADTH_RATIO = 0.2
"""Ratio of breadth to length of the trunk below which a person is seen from the side,
and left and right are not informative."""
_MAX_FACE_SHARE = 0.99
"""Share of detections with a face above which the detector gives a face to people seen
from behind, too."""
_MIN_LYING_DETECTIONS = 5
"""Least number of detections for a decision."""


def arranged(path: Path, listed: Listed, warn: Warn) -> list[Float[np.ndarray, "25 3"]]:
    """Returns the keypoints of each row of a file in BODY_25 order: u px, v px,
    confidence.

    The file's layout follows from its names of keypoints. Without names it is the usual
    layout of that number of keypoints, unless the distances between them clearly favour
    another one (`layout_evidence`). Keypoints with a non-finite value are missing.

    **Raises:** `InputError`, naming the file, if most detections are lost to such
    values, or no known order of as many points fits a body.
    """
    raw = [points for _, points, _ in listed.rows]
    found: list[np.ndarray] = [np.zeros((25, 3))] * len(raw)
    counts = np.array([len(points) for points in raw], dtype=np.int64)
    layout = None if listed.parts is None else layout_of(listed.parts)
    if listed.parts is not None and layout is None:
        named = ", ".join(listed.parts[:4])
        warn(f"keypoints: named {named}, ..., which are no body's: names not used.")
    points_of = {int(n): np.flatnonzero(counts == n) for n in np.unique(counts)}
    whole = _whole(path, raw, warn)
    for num, rows in points_of.items():
        points = np.stack([whole[k] for k in rows])
        if listed.row_first:
            points = points[..., [1, 0, 2]]
        points, order = _in_order(path, points, layout, listed, warn)
        from_rows = order is VITPOSE and not listed.row_first
        has_face = set(BODY25_FACE) <= set(order)
        points = _right_way_round(points, has_face, from_rows, warn)
        for k, row in zip(rows, points, strict=True):
            found[k] = row
    return found


def _whole(path: Path, raw: list[np.ndarray], warn: Warn) -> list[np.ndarray]:
    """Returns the keypoints, with non-finite ones replaced by keypoints of confidence
    0."""
    broken, total, lost = 0, 0, 0
    whole = []
    for points in raw:
        finite = np.asarray(np.isfinite(points).all(axis=-1))
        # A missing point (confidence 0) may have no coordinates.
        bad = ~finite & ~(points[:, 2] <= 0)
        broken, total = broken + int(bad.sum()), total + len(points)
        lost += (
            bool(bad.any())
            and int((finite & (points[:, 2] > 0)).sum()) < _MIN_VALID_POINTS
        )
        whole.append(np.where(finite[:, None], points, 0.0))
    if lost > _MAX_LOST_SHARE * len(raw):
        raise InputError(
            f"{path}: {broken} of {total} keypoints with NaN or infinity, so that "
            f"{lost} of {len(raw)} people have fewer than {_MIN_VALID_POINTS} left."
        )
    if broken:
        warn(
            f"keypoints: {broken} of {total} have NaN, null or infinity in them: taken "
            "as missing."
        )
    return whole


def _in_order(
    path: Path,
    points: np.ndarray,
    layout: list[int] | None,
    listed: Listed,
    warn: Warn,
) -> tuple[np.ndarray, list[int]]:
    """Returns the keypoints in BODY_25 order, and the layout of the file."""
    num = points.shape[1]
    if layout is not None and listed.parts is not None:
        if len(layout) != num:
            raise InputError(
                f"{path}: names of {len(layout)} keypoints, but {num} a person."
            )
        return from_layout(points, layout), layout
    if num not in LAYOUTS:
        *others, last = LAYOUTS
        expected = f"{', '.join(map(str, others))} or {last}"
        raise InputError(f"{path}: {num} keypoints a person, not {expected}.")
    layouts = {name: layout.parts for name, layout in LAYOUTS[num].items()}
    if len(layouts) == 1:
        [only] = layouts.values()
        return from_layout(points, only), only
    choice = choose_layout(points, layouts)
    usual = next(iter(layouts))
    if not choice.plausible:
        raise InputError(
            f"{path}: {num} keypoints a person in no known order: as "
            f"{', '.join(layouts)} limbs are too long for a body; give them in "
            f"{usual}'s order, or in a file that names them (`keypoint_names`)."
        )
    if choice.poor_fit:
        warn(
            f"keypoints: {num} a person fit a body badly as {usual} (log-likelihood "
            f"{choice.nats[usual]:.1f} a point, usually more than 1): in another order?"
        )
    if choice.changed:
        warn(
            f"keypoints: {num} a person taken as {choice.layout}, not as {usual}: by "
            "the distances between them, log-likelihoods a point "
            f"{choice.nats[choice.layout]:.1f} and {choice.nats[usual]:.1f}."
        )
    return from_layout(points, layouts[choice.layout]), layouts[choice.layout]


def _right_way_round(
    points: np.ndarray, has_face: bool, from_rows: bool, warn: Warn
) -> np.ndarray:
    """Returns the keypoints, with x and y exchanged if people lie sideways because the
    file has (y, x); unchanged, with a warning, if a rotation of the image explains it
    as well.

    Args:
        has_face: whether the layout has nose and eyes.
        from_rows: whether the layout is that of a tool that writes (y, x).
    """
    found = lying(points, has_face)
    if len(points) < _MIN_DETECTIONS or found.share < _MIN_LYING_SHARE:
        return points
    share = f"people lie on their side, head to the left, {100 * found.share:.0f} %"
    if from_rows or found.mirrored >= _MIN_MIRRORED_SHARE:
        why = "and easy_ViTPose, whose order this is, writes (y, x)"
        if not from_rows:
            why = "and their faces and feet are those of a mirror image"
        warn(f"keypoints: {share} of the time, {why}: taken as (y, x), not (x, y).")
        return points[..., [1, 0, 2]]
    warn(
        f"keypoints: {share} of the time: if they do not, these are (y, x) in place of "
        "(x, y), or of the video before it was turned upright."
    )
    return points


@dataclasses.dataclass(frozen=True)
class Lying:
    """Detections that lie on their side with the head to the left of the image."""

    share: float
    """Share of all detections."""
    mirrored: float
    """Of the lying detections with evidence, the share whose face and feet fit an
    exchange of x and y; those of the others fit a rotation. NaN without evidence."""


def lying(points: Float[np.ndarray, "n 25 3"], has_face: bool) -> Lying:
    """Evaluates whether `n` detections (u px, v px, confidence; BODY_25 order) lie
    sideways, and whether they are mirrored.

    Args:
        has_face: whether the detector's layout has nose and eyes, so that their absence
            means a person seen from behind.
    """
    has_trunk = (points[:, [_NECK, _MID_HIP], 2] > _MIN_PRESENT_CONFIDENCE).all(axis=1)
    points = points[has_trunk]
    if not len(points):
        return Lying(0.0, np.nan)
    trunk = points[:, _MID_HIP, :2] - points[:, _NECK, :2]
    length = np.maximum(np.linalg.norm(trunk, axis=1), 1e-9)
    flat = trunk[:, 0] > np.cos(np.radians(_MAX_TRUNK_SLOPE_DEG)) * length
    sure = points[..., 2] > _MIN_CONFIDENCE
    sides = zip(_RIGHT, _LEFT, strict=True)
    across = [points[:, r, 1] - points[:, l, 1] for r, l in sides]
    breadth = np.mean(across, axis=0) / length
    usable = (
        flat
        & sure[:, [*_RIGHT, *_LEFT]].all(axis=1)
        & (np.abs(breadth) > _MIN_BREADTH_RATIO)
    )
    facing = _facing(points, sure, length, has_face)
    usable &= facing != 0
    if usable.sum() < _MIN_LYING_DETECTIONS:
        return Lying(float(flat.mean()), np.nan)
    # With x and y exchanged, the right side of a person who faces the camera has the
    # smaller y.
    fits = np.sign(-breadth[usable]) == np.sign(facing[usable])
    share = float(np.average(fits, weights=np.abs(facing[usable])))
    return Lying(float(flat.mean()), share)


def _facing(
    points: np.ndarray, sure: np.ndarray, length: np.ndarray, has_face: bool
) -> np.ndarray:
    """Returns positive numbers for people who face the camera, negative ones for those
    seen from behind, 0 for unknown.

    By whether a face is detected; if everybody has one, by the feet: toes of a person
    who faces the camera are lower in an upright image than the heels, as the camera is
    above the ground. With the head to the left, lower is further to the right.
    """
    face = sure[:, list(BODY25_FACE)].sum(axis=1) >= 2
    if has_face and face.mean() <= _MAX_FACE_SHARE:
        none = (points[:, list(BODY25_FACE), 2] <= _MIN_PRESENT_CONFIDENCE).all(axis=1)
        return np.where(face, 1.0, np.where(none, -1.0, 0.0))
    lower = np.zeros((len(_FEET), len(points)))
    for row, (toe, heel) in zip(lower, _FEET, strict=True):
        both = sure[:, toe] & sure[:, heel]
        row[both] = ((points[:, toe, 0] - points[:, heel, 0]) / length)[both]
    return lower.mean(axis=0)
