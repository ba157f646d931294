"""Warns of unusual observations that no single hypothesis explains, such as
people who lie or are seen from behind."""

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.diagnostics.agreement.image_points import (
    ANKLES,
    L_HIP,
    L_SHOULDER,
    MID_HIP,
    NECK,
    R_HIP,
    R_SHOULDER,
    People,
    centred,
    distances,
    have_points,
    in_common,
    project,
)
from bodyslam_jax.types import Intrinsics, Keypoints, Sequence

_MIN_FRAMES = 10
"""Number of frames from which a statement about most of them is made."""
_MAJORITY_SHARE = 0.8
"""Share of frames or people that is nearly all of them."""
_MIN_OPPOSED_SHARE = 0.6
"""Share of the frames that show it from which left and right contradict each other."""
_MIN_MISPLACED_DISTANCE_SIZES, _MIN_MISPLACED_SHARE = 0.6, 0.1
"""Distance, in sizes of a person, from which a body probably belongs to somebody else,
and the share of frames from which that is a warning."""
_MIN_SIZE_DIFFERENCE = 0.12
"""Relative difference in size that exceeds a regressor's usual error."""
_MAX_UPRIGHT_ANGLE_DEG = 55.0
"""Angle between trunk and image vertical beyond which a person lies."""
_MIN_WIDTH_RATIO = 0.15
"""Ratio of the width of hips and shoulders to the length of the trunk from which front
and back are distinguishable."""


def warn_of_oddities(
    sequence: Sequence, people: People, warn: Callable[[str], None]
) -> Sequence:
    """Warns of unusual people, and returns the sequence, with a contradiction for each
    person whose bodies are somebody else's in part of the frames.

    **Raises:** `InputError` if most bodies are outside the image.
    """
    projected = project(people.camera, people.bodies)
    misplaced: list[str] = []
    for h in range(min(people.keypoints.shape[1], people.bodies.shape[1])):
        detected = people.keypoints[:, h]
        _warn_of_sides(h, detected, projected[:, h], warn)
        misplaced += _misplaced(h, detected, projected[:, h])
        _warn_of_size(h, detected, projected[:, h], people, warn)
    _warn_of_lying(people, projected, warn)
    if sequence.keypoints is None:
        _check_bodies_alone(people, projected, warn)
    elif sequence.bodies is None:
        _warn_of_a_corner(sequence.keypoints, people.camera, warn)
    if not misplaced:
        return sequence
    contradictions = (*sequence.contradictions, *misplaced)
    return dataclasses.replace(sequence, contradictions=contradictions)


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


def _misplaced(h: int, detected, projected) -> list[str]:
    """Returns a text if a person's bodies are far from the keypoints in some of the
    frames, as where a tracker exchanged two people."""
    apart = distances(detected[:, None], projected[:, None])[:, 0, 0]
    both = np.isfinite(apart)
    away = both & (apart > _MIN_MISPLACED_DISTANCE_SIZES)
    share = away.sum() / max(both.sum(), 1)
    if both.sum() < _MIN_FRAMES or share <= _MIN_MISPLACED_SHARE:
        return []
    first, last = np.flatnonzero(away)[[0, -1]]
    return [
        f"person {h}: in {100 * share:.0f} % of the frames, between {first} and "
        f"{last}, the bodies are more than {_MIN_MISPLACED_DISTANCE_SIZES:g} of the "
        "person's size from the keypoints: of somebody else there, as where a tracker "
        "exchanged two people?"
    ]


def _warn_of_size(h: int, detected, projected, people: People, warn) -> None:
    apart = distances(detected[:, None], projected[:, None])[:, 0, 0]
    near = apart <= _MIN_MISPLACED_DISTANCE_SIZES
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
            f"bodies ({low:.2f} to {high:.2f}): bodies that are {middle:.2f} times too "
            f"far away, or of a camera of {middle * focal:.0f} px focal length, not "
            f"{focal:.0f} px."
        )


def _warn_of_lying(people: People, projected, warn) -> None:
    """Warns of people who lie or are upside down in nearly all frames."""
    kind = "keypoints" if have_points(people.keypoints).any() else "bodies"
    points = people.keypoints if kind == "keypoints" else projected
    count, share = shares(trunk_directions(points))
    worst = max(("upside down", "left", "right"), key=lambda name: share[name])
    if count < _MIN_FRAMES or share[worst] < _MAJORITY_SHARE:
        return
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
        return
    warn(
        f"{kind}: people lie on their side, heads to the {worst}, in {percent} of all "
        f"people and frames; if they stand, {kind} were made on a copy turned by 90 "
        "degrees (a phone's video without its rotation): make them on the video as it "
        "is shown."
    )


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


def trunk_directions(uv: Float[np.ndarray, "*n 14 2"]) -> Float[np.ndarray, "*n"]:
    """Returns the direction from neck to hips, rad: 0 points down, positive to the
    right of the image.

    NaN where visible legs point in another direction, as those of people who bend or
    sit.
    """
    trunk = uv[..., MID_HIP, :] - uv[..., NECK, :]
    ankles = uv[..., ANKLES, :]
    valid = np.isfinite(ankles[..., :1])
    count = valid.sum(-2)
    foot = np.where(valid, ankles, 0.0).sum(-2) / np.maximum(count, 1)
    leg = foot - uv[..., MID_HIP, :]
    with np.errstate(invalid="ignore"):
        straight = (leg * trunk).sum(-1) > 0.5 * np.linalg.norm(
            leg, axis=-1
        ) * np.linalg.norm(trunk, axis=-1)
    angle = np.arctan2(trunk[..., 0], trunk[..., 1])
    return np.where((count[..., 0] == 0) | straight, angle, np.nan)


def shares(
    directions: Float[np.ndarray, "*n"],
) -> tuple[int, dict[str, float]]:
    """Returns the number of people in all frames with a known direction, and the shares
    of those who are upright, upside down, or lie with the head to the left or right."""
    angle = np.degrees(directions[np.isfinite(directions)])
    if not len(angle):
        return 0, dict.fromkeys(("upright", "upside down", "left", "right"), 0.0)
    lying = np.abs(np.abs(angle) - 90) < 90 - _MAX_UPRIGHT_ANGLE_DEG
    return len(angle), {
        "upright": float((np.abs(angle) <= _MAX_UPRIGHT_ANGLE_DEG).mean()),
        "upside down": float((np.abs(angle) >= 180 - _MAX_UPRIGHT_ANGLE_DEG).mean()),
        "left": float((lying & (angle > 0)).mean()),
        "right": float((lying & (angle < 0)).mean()),
    }


def facings(uv: Float[np.ndarray, "*n 14 2"]) -> Float[np.ndarray, "*n"]:
    """Returns the signed width of shoulders and hips over the trunk's length: positive
    from behind, negative from the front, NaN if unknown."""
    trunk = uv[..., MID_HIP, :] - uv[..., NECK, :]
    across = (
        uv[..., R_SHOULDER, :]
        - uv[..., L_SHOULDER, :]
        + uv[..., R_HIP, :]
        - uv[..., L_HIP, :]
    ) / 2
    length2 = np.maximum((trunk**2).sum(-1), 1.0)
    return (across[..., 0] * trunk[..., 1] - across[..., 1] * trunk[..., 0]) / length2


def opposed(
    detected: Float[np.ndarray, "*n 14 2"], projected: Float[np.ndarray, "*n 14 2"]
) -> tuple[Bool[np.ndarray, "*n"], Bool[np.ndarray, "*n"]]:
    """Returns where both facings are distinguishable, and where they also contradict
    each other."""
    a, b = facings(detected), facings(projected)
    shown = (np.abs(np.nan_to_num(a)) > _MIN_WIDTH_RATIO) & (
        np.abs(np.nan_to_num(b)) > _MIN_WIDTH_RATIO
    )
    return shown, shown & (np.nan_to_num(a) * np.nan_to_num(b) < 0)
