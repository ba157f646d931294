"""Applies the consequence of an accepted explanation: a correction, a warning, or a
refusal.

Corrected are bodies that were placed by another focal length, or by a principal point
in the middle of the image, as most tools assume one. Everything else is refused: a
repair would rest on figures of some per cent, and whoever made the input can repair it
exactly.
"""

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from bodyslam_jax.body import BodyModel
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.diagnostics.agreement.explanations import Explanation
from bodyslam_jax.diagnostics.agreement.image_points import People, sizes
from bodyslam_jax.types import Sequence

_MAX_DEPTH_FACTOR = 1.6
"""Factor by which a regressor may misjudge all depths."""
_MIN_CENTRE_OFFSET_SHARE = 0.1
"""Distance of a principal point from the image centre, as a share of the image's longer
side, that occurs only in cropped images."""
_MAX_CENTRE_ERROR_SIZES = 0.06
"""Distance of the principal point that bodies and keypoints tell from the middle of the
image, sizes of a person, up to which it is the middle: the error of a mean shift, half
of the least distance of bodies from keypoints (0.05 to 0.13)."""
_MAX_SHIFT_SIZES = 0.2
"""Common shift in the image up to which it may be a regressor's error, sizes of a
person."""

Warn = Callable[[str], None]


def resolved(
    sequence: Sequence,
    body: BodyModel,
    crowd: People,
    found: Explanation,
    given: float,
    best: float,
    warn: Warn,
) -> Sequence:
    """Returns the sequence with another focal length or principal point undone.

    Args:
        given: distance as given, in sizes of a person.
        best: distance under the explanation.

    **Raises:** `InputError` for any other explanation that no error of a regressor is.
    """
    figures = (
        f"distance {best:.2f} of a person's size then, {given:.2f} as they are (median)"
    )
    camera = sequence.intrinsics
    if found.kind == "focal":
        focal = float(camera.params[0])
        warn(
            f"bodies fit the keypoints as of a camera of {found.factor * focal:.0f} px "
            f"focal length, the camera has {focal:.0f} px: their distances are divided "
            f"by {found.factor:.3g} ({figures})."
        )
        depth = np.array([1.0, 1.0, found.factor])
        return _with_bodies_moved(sequence, body, lambda p: p / depth)
    if found.kind == "unit":
        if abs(np.log(found.factor)) < np.log(_MAX_DEPTH_FACTOR):
            return sequence  # a warning follows
        raise InputError(
            f"people are {found.factor:.2f} times as large in the keypoints as in "
            f"the bodies, in the same place ({figures}); expected bodies with "
            "`trans` in m."
        )
    if found.kind == "crop":
        return _shifted(sequence, body, crowd, found.shift, figures, warn)
    width, height = (round(found.factor * n) for n in (camera.width, camera.height))
    size = f" of {width}x{height} px, {found.factor:.3f} times the video's,"
    raise InputError(
        f"keypoints fit the bodies only as of a copy{size * (found.factor != 1)} "
        f"{found.name or 'upright'} ({figures}); expected keypoints in pixels of this "
        f"video, {camera.width}x{camera.height} px, and bodies in its camera's frame "
        "(x right, y down, z forward)."
    )


def _shifted(
    sequence, body, crowd, shift: np.ndarray, figures: str, warn: Warn
) -> Sequence:
    """Corrects a principal point, warns of a small shift, and refuses a crop.

    A crop is not undone, because it is measured to some pixels only. Another principal
    point is, if it is the image centre, which most tools assume.
    """
    camera = sequence.intrinsics
    fx, fy, cx, cy = camera.params[:4]
    to_middle = np.array([(camera.width - 1) / 2 - cx, (camera.height - 1) / 2 - cy])
    size = float(np.nanmedian(sizes(crowd.keypoints)))
    if np.linalg.norm(shift - to_middle) < _MAX_CENTRE_ERROR_SIZES * size:
        warn(
            "bodies fit the keypoints as of a camera whose principal point is the "
            f"middle of the image, not ({cx:.0f}, {cy:.0f}): moved accordingly "
            f"({figures})."
        )
        move = lambda p: p + p[:, 2:] * np.array([*(to_middle / [fx, fy]), 0.0])
        moved = _with_bodies_moved(sequence, body, move)
        away = np.linalg.norm(to_middle)
        if away < _MIN_CENTRE_OFFSET_SHARE * max(camera.width, camera.height):
            return moved
        text = (
            f"the camera file has its principal point at ({cx:.0f}, {cy:.0f}) px, "
            f"{away:.0f} px from the middle of the image; bodies and keypoints "
            "together say that it is the middle. Unless the video was cropped and the "
            "bodies' tool did not know, the file is wrong."
        )
        contradictions = (*sequence.contradictions, text)
        return dataclasses.replace(moved, contradictions=contradictions)
    by = f"({shift[0]:.0f}, {shift[1]:.0f}) px"
    if np.linalg.norm(shift) < _MAX_SHIFT_SIZES * size:
        warn(f"keypoints lie {by} from the bodies in all frames ({figures}).")
        return sequence
    raise InputError(
        f"keypoints are where the bodies are only if those are moved by {by} in all "
        f"frames ({figures}); expected keypoints in pixels and frames of this video, "
        "not of a cropped, padded or shorter copy, and bodies in the frame of its "
        "camera."
    )


def _with_bodies_moved(
    sequence: Sequence,
    body: BodyModel,
    place: Callable[[Float[np.ndarray, "m 3"]], Float[np.ndarray, "m 3"]],
) -> Sequence:
    """Returns the sequence with the pelvis positions (m, camera frame) of its bodies
    mapped by `place`."""
    bodies = sequence.bodies
    assert bodies is not None
    at = bodies.present
    J_0 = np.asarray(body.joint_template[0], float)
    J_0 = J_0 + bodies.shapes[at] @ np.asarray(body.joint_shape_dirs[0], float).T
    trans = bodies.trans.copy()
    trans[at] = place(trans[at] + J_0) - J_0
    return dataclasses.replace(
        sequence, bodies=dataclasses.replace(bodies, trans=trans)
    )
