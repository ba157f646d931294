"""Applies the consequence of an accepted explanation: a correction, a warning, or a
refusal."""

import dataclasses
from collections.abc import Callable

import numpy as np

from bodyslam_jax.body import BodyModel
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.diagnostics.agreement.explanations import Explanation
from bodyslam_jax.diagnostics.agreement.facing import shares, trunk_directions
from bodyslam_jax.diagnostics.agreement.image_points import People, people_of, sizes
from bodyslam_jax.diagnostics.agreement.undo import (
    with_bodies_moved,
    with_keypoints_mapped_back,
)
from bodyslam_jax.types import Sequence

_MAX_DEPTH_FACTOR = 1.6
"""Factor by which a regressor may misjudge all depths."""
_MIN_CENTRE_OFFSET_SHARE = 0.1
"""Distance of a principal point from the image centre, as a share of the image's longer
side, that occurs only in cropped images."""
_MAX_SHIFT_SIZES = 0.2
"""Common shift in the image up to which it may be a regressor's error, sizes of a
person."""

Warn = Callable[[str], None]


def undone(
    sequence: Sequence,
    body: BodyModel,
    crowd: People,
    found: Explanation,
    given: float,
    best: float,
    warn: Warn,
) -> Sequence:
    """Returns the sequence with the effect of the explanation undone, where that is
    safe.

    Args:
        given: distance as given, in sizes of a person.
        best: distance under the explanation.

    **Raises:** `InputError` if it is ambiguous which side is right.
    """
    figures = (
        f"distance {best:.2f} of a person's size then, {given:.2f} as they are (median)"
    )
    if found.kind == "sides":
        warn(
            "left and right of the keypoints contradict the bodies: they fit with "
            "sides "
            f"exchanged ({figures}); either the keypoints' sides are, or the bodies "
            "face "
            "the other way."
        )
        return sequence
    if found.kind == "focal":
        return _refocused(sequence, body, found.factor, figures, warn)
    if found.kind == "unit":
        if not found.reason:
            if abs(np.log(found.factor)) < np.log(_MAX_DEPTH_FACTOR):
                return sequence  # a warning follows
            raise InputError(
                f"people are {found.factor:.2f} times as large in the keypoints as in "
                f"the bodies, in the same place ({figures}); expected bodies with "
                "`trans` in m."
            )
        warn(
            f"bodies are in another unit: `trans` divided by {found.factor:.4g} "
            f"({figures})."
        )
        return with_bodies_moved(sequence, body, lambda p: p / found.factor)
    if found.kind in ("crop", "copy"):
        return _shifted(sequence, body, crowd, found, figures, warn)
    return _turned_back(sequence, body, crowd, found, figures, warn)


def _refocused(sequence, body, factor: float, figures: str, warn: Warn) -> Sequence:
    focal = float(sequence.intrinsics.params[0])
    warn(
        f"bodies fit the keypoints as of a camera of {factor * focal:.0f} px focal "
        f"length, the camera has {focal:.0f} px: their distances are divided by "
        f"{factor:.3g} ({figures})."
    )
    depth = np.array([1.0, 1.0, factor])
    return with_bodies_moved(sequence, body, lambda p: p / depth)


def _shifted(sequence, body, crowd, found, figures: str, warn: Warn) -> Sequence:
    """Corrects a principal point, warns of a small shift, and refuses a crop.

    A crop is not undone, because it is measured to some pixels only. Another principal
    point is, if it is the image centre, which most tools assume.
    """
    camera = sequence.intrinsics
    fx, fy, cx, cy = camera.params[:4]
    to_middle = np.array([(camera.width - 1) / 2 - cx, (camera.height - 1) / 2 - cy])
    size = float(np.nanmedian(sizes(crowd.keypoints)))
    shift = found.image.b
    if found.kind == "crop" and np.linalg.norm(shift - to_middle) < 0.06 * size:
        warn(
            "bodies fit the keypoints as of a camera whose principal point is the "
            "middle "
            f"of the image, not ({cx:.0f}, {cy:.0f}): moved accordingly ({figures})."
        )
        move = lambda p: p + p[:, 2:] * np.array([*(to_middle / [fx, fy]), 0.0])
        moved = with_bodies_moved(sequence, body, move)
        if np.linalg.norm(to_middle) < _MIN_CENTRE_OFFSET_SHARE * max(
            camera.width, camera.height
        ):
            return moved
        text = (
            f"the camera file has its principal point at ({cx:.0f}, {cy:.0f}) px, "
            f"{np.linalg.norm(to_middle):.0f} px from the middle of the image; bodies "
            "and keypoints together say that it is the middle. Unless the video was "
            "cropped and the bodies' tool did not know, the file is wrong."
        )
        contradictions = (*sequence.contradictions, text)
        return dataclasses.replace(moved, contradictions=contradictions)
    if found.kind == "crop" and np.linalg.norm(shift) < _MAX_SHIFT_SIZES * size:
        warn(
            f"keypoints lie ({shift[0]:.0f}, {shift[1]:.0f}) px from the bodies in all "
            f"frames ({figures})."
        )
        return sequence
    resized = f"times {found.factor:.2f} and " if found.kind == "copy" else ""
    raise InputError(
        f"keypoints are where the bodies are only if those are {resized}moved by "
        f"({shift[0]:.0f}, {shift[1]:.0f}) px in all frames ({figures}); expected "
        "keypoints in pixels of this video, not of a cropped or padded copy, and "
        "bodies "
        "in the frame of its camera."
    )


def _turned_back(
    sequence, body, crowd: People, found: Explanation, figures: str, warn: Warn
) -> Sequence:
    """Undoes rotated or resized images and other camera axes, and refuses mirrored
    images."""
    upright = shares(trunk_directions(crowd.keypoints))[1]["upright"]
    if found.kind == "axes":
        about_sight = found.R[2, 2] == 1
        if about_sight and upright < 0.5:
            raise InputError(
                "keypoints and bodies are turned in the image against each other "
                f"(bodies fit if {found.name}: {figures}), and in neither are people "
                "upright; expected both in the video's own orientation."
            )
        warn(
            f"bodies are in another frame than the camera's (x right, y down, z "
            f"forward): {found.name}; turned into it ({figures})."
        )
        return with_bodies_moved(sequence, body, lambda p: p @ found.R.T, found.R)
    width, height = sequence.intrinsics.width, sequence.intrinsics.height
    if found.factor == 1:
        what = f"an image {found.name}"
    else:
        size = f"{found.factor * width:.0f}x{found.factor * height:.0f} px"
        turned = f", {found.name}" if found.name else ""
        what = f"a copy of {size}{turned}"
        if not found.reason:
            raise InputError(
                f"keypoints are of {what}, {found.factor:.3f} times this video of "
                f"{width}x{height} px, as the bodies have it ({figures}); expected "
                "keypoints in pixels of the video."
            )
    if "mirrored" in found.name:
        raise InputError(
            f"keypoints fit the bodies only as of {what} ({figures}): one of the two "
            "is "
            "of a mirrored copy; expected both of the video as it is."
        )
    if found.name == "":
        warn(
            f"keypoints fit the bodies as of {what}: divided by {found.factor:.3g} "
            f"({figures})."
        )
        return with_keypoints_mapped_back(sequence, found.image)
    back = with_keypoints_mapped_back(sequence, found.image)
    righted = shares(trunk_directions(people_of(back, body).keypoints))[1]["upright"]
    if not righted > max(0.5, upright):
        raise InputError(
            f"keypoints fit the bodies only as of {what} ({figures}), but people are "
            f"upright in {100 * upright:.0f} % of the keypoints as they are and in "
            f"{100 * righted:.0f} % then; expected both of the video as it is."
        )
    warn(f"keypoints fit the bodies as of {what}: turned back ({figures}).")
    return back
