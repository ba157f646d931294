"""Warns of unusual observations that no single hypothesis explains."""

from collections.abc import Callable

import numpy as np

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.diagnostics.agreement.explanations import ImageMap
from bodyslam_jax.diagnostics.agreement.facing import opposed, shares, trunk_directions
from bodyslam_jax.diagnostics.agreement.image_points import (
    MID_HIP,
    NECK,
    People,
    centred,
    distances,
    have_points,
    in_common,
    project,
)
from bodyslam_jax.diagnostics.agreement.undo import with_keypoints_mapped_back
from bodyslam_jax.types import Intrinsics, Keypoints, Sequence

_MIN_FRAMES = 10
"""Number of frames from which a statement about most of them is made."""
_MAJORITY_SHARE = 0.8
_MIN_OPPOSED_SHARE = 0.6
_MIN_MISPLACED_DISTANCE_SIZES, _MIN_MISPLACED_SHARE = 0.6, 0.1
"""Distance, in sizes of a person, from which a body probably belongs to somebody else,
and the share of frames from which that is a warning."""
_MIN_SIZE_DIFFERENCE = 0.12
"""Relative difference in size that exceeds a regressor's usual error."""
_MIN_OUTSIDE_SHARE = 0.02
"""Share of points outside the image from which the image must have been rotated."""


def warn_of_oddities(
    sequence: Sequence, people: People, warn: Callable[[str], None], *, sides: bool
) -> Sequence:
    """Warns of unusual people, and returns the sequence, with keypoints rotated back if
    they do not fit into the image.

    Args:
        sides: whether to warn of left and right sides that contradict each other.

    **Raises:** `InputError` if most bodies are outside the image.
    """
    projected = project(people.camera, people.bodies)
    for h in range(min(people.keypoints.shape[1], people.bodies.shape[1])):
        detected = people.keypoints[:, h]
        if sides:
            _warn_of_sides(h, detected, projected[:, h], warn)
        _warn_of_person(h, detected, projected[:, h], people, warn)
    sequence = _upright(sequence, people, warn)
    if sequence.keypoints is None:
        _check_bodies_alone(people, projected, warn)
    elif sequence.bodies is None:
        _warn_of_renumbering(sequence.keypoints, warn)
        _warn_of_a_corner(sequence.keypoints, people.camera, warn)
    return sequence


def _warn_of_sides(h: int, detected, projected, warn) -> None:
    shown, against = opposed(detected, projected)
    if shown.sum() >= _MIN_FRAMES and against.sum() > _MIN_OPPOSED_SHARE * shown.sum():
        warn(
            f"person {h}: left and right of the keypoints contradict the bodies in "
            f"{100 * against.sum() / shown.sum():.0f} % of the frames in which it "
            "shows "
            "whether the person is seen from the front: sides are exchanged in the "
            "keypoints, or the bodies face the other way."
        )


def _warn_of_person(h: int, detected, projected, people: People, warn) -> None:
    apart = distances(detected[:, None], projected[:, None])[:, 0, 0]
    both = np.isfinite(apart)
    if both.sum() < _MIN_FRAMES:
        return
    away = both & (apart > _MIN_MISPLACED_DISTANCE_SIZES)
    if (
        _MIN_MISPLACED_SHARE * both.sum()
        < away.sum()
        < (1 - _MIN_MISPLACED_SHARE) * both.sum()
    ):
        first, last = np.flatnonzero(away)[[0, -1]]
        warn(
            f"person {h}: in {100 * away.sum() / both.sum():.0f} % of the frames, "
            f"between {first} and {last}, the bodies are more than "
            f"{_MIN_MISPLACED_DISTANCE_SIZES:g} of the person's size from the "
            "keypoints: of somebody else there?"
        )
    near = both & ~away
    big, small = (centred(uv[near])[1] for uv in in_common(detected, projected))
    ratio = big / np.maximum(small, 1e-3)
    ratio = ratio[np.isfinite(ratio)]
    if len(ratio) < _MIN_FRAMES:
        return
    low, middle, high = np.quantile(ratio, [0.1, 0.5, 0.9])
    if (low > 1 + _MIN_SIZE_DIFFERENCE / 2 and middle > 1 + _MIN_SIZE_DIFFERENCE) or (
        high < 1 - _MIN_SIZE_DIFFERENCE / 2 and middle < 1 - _MIN_SIZE_DIFFERENCE
    ):
        focal = float(people.camera.params[0])
        warn(
            f"person {h}: {middle:.2f} times as large in the keypoints as in the "
            "bodies "
            f"({low:.2f} to {high:.2f}): bodies that are {middle:.2f} times too far "
            "away, "
            f"or of a camera of {middle * focal:.0f} px focal length, not {focal:.0f} "
            "px."
        )


def _upright(sequence: Sequence, people: People, warn) -> Sequence:
    """Warns of people who lie or are upside down in nearly all frames, and rotates
    keypoints back if they exceed the image."""
    width, height = sequence.intrinsics.width, sequence.intrinsics.height
    kind = "keypoints" if have_points(people.keypoints).any() else "bodies"
    points = people.keypoints
    if kind == "bodies":
        points = project(people.camera, people.bodies)
    count, share = shares(trunk_directions(points))
    worst = max(("upside down", "left", "right"), key=lambda name: share[name])
    if count < _MIN_FRAMES or share[worst] < _MAJORITY_SHARE:
        return sequence
    percent = f"{100 * share[worst]:.0f} %"
    if worst == "upside down":
        warn(
            f"{kind}: heads are below feet in {percent} of all people and frames; if "
            "people stand, the video is upside down, or "
            + (
                "y was counted from the lower edge."
                if kind == "keypoints"
                else "y points up in the bodies' frame, where the camera's points down."
            )
        )
        return sequence
    clockwise = worst == "right"
    if kind == "keypoints" and _exceeds(sequence.keypoints, width, height):
        w, h = width - 1.0, height - 1.0
        image = (
            ImageMap(np.array([[0.0, -1.0], [1.0, 0.0]]), np.array([h, 0.0]))
            if clockwise
            else ImageMap(np.array([[0.0, 1.0], [-1.0, 0.0]]), np.array([0.0, w]))
        )
        back = with_keypoints_mapped_back(sequence, image)
        if not _exceeds(back.keypoints, width, height):
            warn(
                f"keypoints are of an image of {height}x{width} px turned by 90 "
                "degrees "
                f"(people lie in {percent} of all frames, and beyond the edge of this "
                f"video of {width}x{height} px): turned back."
            )
            return back
    warn(
        f"{kind}: people lie on their side, heads to the {worst}, in {percent} of all "
        f"people and frames; if they stand, {kind} were made on a copy turned by 90 "
        "degrees (a phone's video without its rotation): make them on the video as it "
        "is shown."
    )
    return sequence


def _exceeds(keypoints: Keypoints | None, width: int, height: int) -> bool:
    if keypoints is None:
        return False
    uv = keypoints.uv[keypoints.confidence > 0.3]
    if not len(uv):
        return False
    margin = 0.02 * max(width, height)
    beyond = (uv < -margin) | (uv > np.array([width, height]) + margin)
    return bool(beyond.any(-1).mean() > _MIN_OUTSIDE_SHARE)


def _check_bodies_alone(people: People, projected, warn) -> None:
    """Checks, for bodies without keypoints, that they are in the image and in a camera
    frame."""
    width, height = people.camera.width, people.camera.height
    present = have_points(people.bodies)
    if not present.any():
        return
    u, v = projected[..., 0], projected[..., 1]
    inside = ((u >= 0) & (u < width) & (v >= 0) & (v < height)).any(-1)
    share = 100 * float((~inside[present]).mean())
    if share > 70:
        raise InputError(
            f"bodies are outside the image of {width}x{height} px in {share:.0f} % of "
            "their frames; expected bodies in the frame of the camera, x right, y "
            "down, "
            "z forward, in m, not in a world."
        )
    if share > 20:
        warn(f"bodies are outside the image in {share:.0f} % of their frames.")
    trunk = (people.bodies[..., NECK, :] - people.bodies[..., MID_HIP, :])[present]
    away = trunk[:, 2] > 0.8 * np.linalg.norm(trunk, axis=-1)
    if len(away) >= _MIN_FRAMES and away.mean() > _MAJORITY_SHARE:
        warn(
            f"bodies: heads point away from the camera in {100 * away.mean():.0f} % of "
            "all frames: z up, as in a world? Expected the camera's frame, x right, y "
            "down, z forward."
        )


def _warn_of_renumbering(keypoints: Keypoints, warn) -> None:
    """Warns of keypoints whose last frame suggests that only every n-th frame was
    processed and renumbered."""
    detected = np.any(keypoints.confidence > 0, axis=(0, 2))
    t, count = len(detected), int(np.flatnonzero(detected)[-1]) + 1
    for n in (2, 3, 4, 5, 6, 10):
        if (
            count == -(-t // n)
            and count >= _MIN_FRAMES
            and detected[:count].mean() > _MAJORITY_SHARE
        ):
            warn(
                f"keypoints only in frames 0 to {count - 1} of {t}, one frame in {n}: "
                f"taken as they are numbered; if only one frame in {n} was looked at, "
                "and numbered anew, give them the numbers of their frames."
            )


def _warn_of_a_corner(keypoints: Keypoints, camera: Intrinsics, warn) -> None:
    """Warns of keypoints that lie in the upper left quarter only, as on a copy of half
    the size."""
    size = np.array([camera.width, camera.height])
    uv = keypoints.uv[keypoints.confidence > 0]
    high = np.quantile(uv, 0.99, axis=0) if len(uv) else size
    frames = int((keypoints.confidence > 0).any((0, 2)).sum())
    if frames >= _MIN_FRAMES and (high < 0.5 * size).all():
        warn(
            f"keypoints reach ({high[0]:.0f}, {high[1]:.0f}) px only, of {size[0]}x"
            f"{size[1]}: all in the upper left quarter; if people are elsewhere in the "
            "video, the keypoints are of a smaller copy of it."
        )
