"""Keypoints as a file lists them -> BODY_25.

Removes invalid values, finds the layout, and exchanges x and y where they are swapped.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from bodyslam_jax.body.skeleton import BODY25_FACE
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io.frame_index import Warn
from bodyslam_jax.io.keypoints.keypoint_format import Listed
from bodyslam_jax.io.keypoints.layout_evidence import choose_layout
from bodyslam_jax.io.keypoints.layouts import LAYOUTS, VITPOSE, from_layout
from bodyslam_jax.io.keypoints.lying import lying
from bodyslam_jax.io.keypoints.names import layout_of

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
