"""Keypoints as a file lists them -> BODY_25.

Removes invalid values, finds the layout, and exchanges x and y where they are swapped.

x and y that were exchanged show by people who lie on their side. With (y, x) in place
of (x, y) everybody lies with the head to the left. So they do if the image is rotated
by 90 degrees, but then they are not mirrored: in an upright image, a person who faces
the camera has the right side of the body on the left.

The layout is that of the largest likelihood, from distances in the image. Points that
are neighbours on a body are at most as far apart in the image as their bone is long.
Under each layout, distances between neighbours have a heavy-tailed density as wide as
the bone is long; a point that the layout does not name is anywhere about the body.
Posture, view and orientation in the image do not matter, nor does the number of
detected points. For real and simulated people the right order has 1.3 nats per point or
more, a random one 0 ± 0.4 and at most 1.0; two known orders differ by 0.6 or more.
"""

import dataclasses
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax.body.skeleton import BODY25, BODY25_FACE, BODY25_TOES_AND_HEELS
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io.frame_index import Warn
from bodyslam_jax.io.keypoints.keypoint_format import Listed
from bodyslam_jax.io.keypoints.layouts import (
    HEAD_TOP,
    LAYOUTS,
    NUM_PARTS,
    SPINE,
    VITPOSE,
    from_layout,
    layout_of,
)

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
MIN_CONFIDENCE = 0.3
"""Least confidence of a keypoint whose position is trusted."""
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
_MIN_POINTS = 6
"""Least number of keypoints of a detection that is evaluated."""
_MIN_EVIDENCE = 5
_MIN_WHOLE_BODY_POINTS = 12
"""Number of keypoints from which detections fit their layout well: they are not of a
half hidden body."""
_MIN_LOG_LIKELIHOOD = 1.1
"""Least log-likelihood of a layout that is chosen, nats per keypoint."""
_MIN_LOG_LIKELIHOOD_GAIN = 0.3
"""Least gain in log-likelihood of a layout other than the usual one, nats per
keypoint."""
_MIN_AGREEMENT = 0.8
"""Least share of the detections for which it must be better."""
_IMPLAUSIBLE_LOG_LIKELIHOOD, _POOR_LOG_LIKELIHOOD = 0.1, 0.7
"""Log-likelihoods (nats per keypoint) below which keypoints are not those of a body in
the usual layout (random points have up to 0.4), and below which they fit it poorly."""
_MIN_POSTURE_CHANGE = 0.02
"""Least change of posture of a moving person, relative to the person's size."""
_RMS_DISTANCES_M = (0.15, 0.25, 0.35, 0.5, 0.7)
"""Candidates for the RMS distance of the detected points from their mean, m; a half
hidden body has less."""
_BACKGROUND_WIDTH_M = 0.6
"""Width of the density of points without neighbours, m."""
_DISTANCES_M = (
    ("shoulder", "elbow", 0.28),
    ("elbow", "wrist", 0.25),
    ("hip", "knee", 0.40),
    ("knee", "ankle", 0.40),
    ("shoulder", "hip", 0.50),
    ("eye", "ear", 0.09),
    ("nose", "eye", 0.05),
    ("nose", "ear", 0.11),
    ("neck", "shoulder", 0.17),
    ("mid_hip", "hip", 0.10),
    ("ear", "shoulder", 0.25),
    ("ankle", "heel", 0.07),
    ("ankle", "big_toe", 0.17),
    ("ankle", "small_toe", 0.16),
    ("big_toe", "small_toe", 0.08),
    ("heel", "big_toe", 0.22),
    ("heel", "small_toe", 0.20),
    ("right_shoulder", "left_shoulder", 0.33),
    ("right_hip", "left_hip", 0.20),
    ("right_eye", "left_eye", 0.06),
    ("right_ear", "left_ear", 0.14),
    ("nose", "neck", 0.22),
    ("neck", "mid_hip", 0.50),
    ("head_top", "nose", 0.15),
    ("head_top", "neck", 0.28),
    ("spine", "mid_hip", 0.20),
    ("spine", "neck", 0.30),
)
"""Distances between neighbours on a body, of both sides where no side is named, m:
those of the default body at rest within 5 cm, which is little beside the width of the
density."""
_PARTS = {**BODY25, "head_top": HEAD_TOP, "spine": SPINE}
_SIDED = {name.partition("_")[2] for name in BODY25 if name.startswith("left_")}


def _neighbours() -> Iterator[tuple[tuple[int, int], float]]:
    """Yields the pairs of parts of `_DISTANCES_M`, right before left, with their
    distances, m."""
    for first, second, length in _DISTANCES_M:
        sided = {first, second} & _SIDED
        for side in ("right_", "left_") if sided else ("",):
            a, b = (
                _PARTS[side + name if name in sided else name]
                for name in (first, second)
            )
            yield (a, b), length


_NEIGHBOURS = list(_neighbours())


@dataclasses.dataclass(frozen=True)
class Choice:
    """The layout that keypoints are in."""

    layout: str
    changed: bool
    """True if it is not the usual layout of that number of keypoints."""
    plausible: bool
    """True if the keypoints are those of a body in any of the layouts."""
    poor_fit: bool
    """True if the keypoints are plausible, but fit the layout poorly."""
    nats: dict[str, float]
    """Log-likelihood of each layout, nats per point."""


def arranged(path: Path, listed: Listed, warn: Warn) -> list[Float[np.ndarray, "25 3"]]:
    """Returns the keypoints of each row of a file in BODY_25 order: u px, v px,
    confidence.

    The file's layout follows from its names of keypoints. Without names it is the usual
    layout of that number of keypoints, unless the distances between them clearly favour
    another one. Keypoints with a non-finite value are missing.

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
    sure = points[..., 2] > MIN_CONFIDENCE
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


def choose_layout(
    points: Float[np.ndarray, "n j 3"], layouts: Mapping[str, list[int]]
) -> Choice:
    """Returns the layout of `n` detections among `layouts`, the first being the usual
    one.

    Another is chosen only if it is plausible, much better, better for nearly all
    detections, and postures change.
    """
    first = next(iter(layouts))
    present = points[..., 2] > _MIN_PRESENT_CONFIDENCE
    enough = present.sum(axis=1) >= _MIN_POINTS
    points, present = points[enough], present[enough]
    if not len(points):
        return Choice(first, False, True, False, {})
    nats = {name: likelihood(points, present, la) for name, la in layouts.items()}
    mean = {name: float(value.mean()) for name, value in nats.items()}
    best = max(mean, key=lambda name: mean[name])
    better = nats[best] > nats[first]
    if (
        best != first
        and mean[best] >= _MIN_LOG_LIKELIHOOD
        and mean[best] - mean[first] >= _MIN_LOG_LIKELIHOOD_GAIN
        and better.mean() >= _MIN_AGREEMENT
        and _changes(points, present)
    ):
        return Choice(best, True, True, False, mean)
    many = present.sum(axis=1) >= _MIN_WHOLE_BODY_POINTS
    least = float(nats[first][many].mean()) if many.sum() >= _MIN_EVIDENCE else np.inf
    poor = least < _POOR_LOG_LIKELIHOOD and _changes(points[many], present[many])
    implausible = (
        poor
        and least < _IMPLAUSIBLE_LOG_LIKELIHOOD
        and max(mean.values()) < _MIN_LOG_LIKELIHOOD
    )
    return Choice(first, False, not implausible, poor and not implausible, mean)


def likelihood(
    points: Float[np.ndarray, "n j 3"],
    present: Bool[np.ndarray, "n j"],
    layout: list[int],
) -> Float[np.ndarray, " n"]:
    """Returns the log-likelihood of each of `n` detections under a layout, nats per
    detected point, in units in which the RMS distance from the mean is 0.5."""
    uv = _normalised(points, present)
    num = len(points)
    position, has_part = (
        np.zeros((num, NUM_PARTS, 2)),
        np.zeros((num, NUM_PARTS), dtype=bool),
    )
    for k, part in enumerate(layout):
        if part >= 0:
            position[:, part], has_part[:, part] = uv[:, k], present[:, k]
    pairs = [
        (a, b, length, ((position[:, a] - position[:, b]) ** 2).sum(axis=-1))
        for (a, b), length in _NEIGHBOURS
    ]
    found = np.full(num, -np.inf)
    for size in _RMS_DISTANCES_M:
        total, count = np.zeros((num, NUM_PARTS)), np.zeros((num, NUM_PARTS))
        for a, b, length, square in pairs:
            both = has_part[:, a] & has_part[:, b]
            value = both * _density(square * size**2, 0.8 * length)
            for part in (a, b):
                total[:, part] += value
                count[:, part] += both
        alone = _density((uv**2).sum(axis=-1) * size**2, _BACKGROUND_WIDTH_M)
        sums = np.zeros(num)
        for k, part in enumerate(layout):
            if part >= 0:
                near = total[:, part] / np.maximum(count[:, part], 1)
                value = np.where(count[:, part] > 0, near, alone[:, k])
            else:
                value = alone[:, k]
            sums += present[:, k] * value
        mean = sums / np.maximum(present.sum(axis=1), 1)
        found = np.maximum(found, mean + 2 * np.log(size / 0.5))
    return found


def _density(square: np.ndarray, width: float) -> np.ndarray:
    """Returns the log density, up to 1/2π, of Student's t with two degrees of freedom
    in the plane."""
    return -2 * np.log(width) - 2 * np.log1p(square / (2 * width**2))


def _normalised(points: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Returns positions relative to the mean of the detected points, scaled to an RMS
    of 1."""
    count = np.maximum(present.sum(axis=1), 1)[:, None]
    uv = (
        points[..., :2]
        - ((points[..., :2] * present[..., None]).sum(axis=1) / count)[:, None]
    )
    square = ((uv**2).sum(axis=-1) * present).sum(axis=1, keepdims=True) / count
    return uv / np.sqrt(np.maximum(square, 1e-12))[..., None]


def _changes(points: np.ndarray, present: np.ndarray) -> bool:
    """Returns True if postures differ, as those of a moving person do."""
    often = present.mean(axis=0) > 0.5
    if not often.any():
        return True
    uv = np.where(present[..., None], _normalised(points, present), np.nan)[:, often]
    away = uv - np.nanmedian(uv, axis=0)
    return bool(np.nanmedian(np.linalg.norm(away, axis=-1)) > _MIN_POSTURE_CHANGE)
