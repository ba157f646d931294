"""Masks of the people in an image: given ones, or capsules around keypoints."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from bodyslam_jax.io.masks import mask_names, read_named, resized_to
from bodyslam_jax.types import DetectedPeople, Keypoints, MaskUse, Sequence

_LIMBS = (
    (1, 8, 0.11),  # trunk
    (1, 2, 0.06),
    (1, 5, 0.06),
    (2, 3, 0.045),
    (3, 4, 0.04),
    (5, 6, 0.045),
    (6, 7, 0.04),
    (2, 9, 0.07),
    (5, 12, 0.07),
    (9, 12, 0.08),
    (9, 10, 0.06),
    (10, 11, 0.045),
    (12, 13, 0.06),
    (13, 14, 0.045),
    (1, 0, 0.08),
    (0, 15, 0.06),
    (0, 16, 0.06),
    (15, 17, 0.07),
    (16, 18, 0.07),
    (11, 22, 0.035),
    (11, 24, 0.035),
    (14, 19, 0.035),
    (14, 21, 0.035),
)
"""BODY_25 limbs with their half widths, relative to the person's height. With the parts
below, and no margin, they cover 99.7 % of the default body at rest in a view from the
front, and 99.9 % from the side."""
_EXTENDED_PARTS = (
    (8, 1, 0.35, 0.10),  # head
    (3, 4, 0.5, 0.05),  # hands
    (6, 7, 0.5, 0.05),
    (10, 11, 0.25, 0.05),  # feet
    (13, 14, 0.25, 0.05),
)
"""Parts beyond the keypoints: from, to, share of the limb beyond `to`, half width."""
_MIN_CONFIDENCE = 0.05
SILHOUETTE_STEP = 4
"""Image pixels per pixel of a silhouette (`DetectedPeople.silhouettes`)."""
_MAX_GAP_S = 1.0
"""Longest time without a detection over which a person is still masked, s."""


def person_masks(
    sequence: Sequence, margin: float
) -> Iterator[UInt8[np.ndarray, "y x"] | None]:
    """Yields the masks of all people, frame after frame: 255 is person; `None` without
    masks, keypoints and detections.

    Args:
        margin: width added on all sides, relative to the person's height in the image.

    **Raises:** `ValueError` if the size of a given mask is not that of the image.
    """
    size = (sequence.intrinsics.height, sequence.intrinsics.width)
    if sequence.masks is not None:
        radius = max(1, round(margin * 0.25 * size[0]))
        kernel = cv2.getStructuringElement(
            cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)
        )
        people = _painted(sequence)
        for k, given in enumerate(_given_masks(sequence, sequence.masks)):
            mask = cv2.dilate(np.where(given, 255, 0).astype(np.uint8), kernel)
            for person in people:
                draw_person(mask, person[k], margin)
            yield mask
    elif sequence.keypoints is not None or sequence.detected is not None:
        people = np.zeros((0, sequence.num_frames, 25, 3))
        if sequence.keypoints is not None:
            people = _fill_gaps(sequence.keypoints, round(_MAX_GAP_S * sequence.fps))
        for k in range(sequence.num_frames):
            mask = np.zeros(size, dtype=np.uint8)
            for person in people:
                draw_person(mask, person[k], margin)
            if sequence.detected is not None:
                _draw_detected(mask, sequence.detected, k, margin)
            yield mask
    else:
        for _ in range(sequence.num_frames):
            yield None


def _given_masks(sequence: Sequence, folder: Path) -> Iterator[Bool[np.ndarray, "y x"]]:
    """Yields the given masks of the sequence's frames: true is person."""
    use = sequence.mask_use
    size = (sequence.intrinsics.width, sequence.intrinsics.height)
    if use is None:
        use = MaskUse(tuple((name,) for name in mask_names(folder)))
    files = use.files
    if sequence.picks is not None:
        files = [files[k] for k in sequence.picks]
    for names in files:
        mask = np.zeros(size[::-1], dtype=bool)
        for name in names:
            found = read_named(folder, name)
            if found.shape != mask.shape:
                found = resized_to(folder / name, found, size)
            mask |= found != use.inverted
        yield mask


def _painted(sequence: Sequence) -> Float[np.ndarray, "h t 25 3"]:
    """Returns people whose keypoints are masked besides given masks; none if these are
    complete."""
    use = sequence.mask_use
    if use is None or not use.with_keypoints or sequence.keypoints is None:
        return np.zeros((0, sequence.num_frames, 25, 3))
    return _fill_gaps(sequence.keypoints, round(_MAX_GAP_S * sequence.fps))


def _draw_detected(
    mask: UInt8[np.ndarray, "y x"], people: DetectedPeople, k: int, margin: float
) -> None:
    """Paints all detected people of frame `k`."""
    for index in np.flatnonzero(people.frame == k):
        draw_person(mask, people.keypoints[index], margin)
    if people.silhouettes is None:
        return
    small = np.unpackbits(people.silhouettes[k], axis=1)
    radius = max(1, round(margin * 0.25 * mask.shape[0] / SILHOUETTE_STEP))
    small = cv2.dilate(small, np.ones((2 * radius + 1, 2 * radius + 1), np.uint8))
    large = small.repeat(SILHOUETTE_STEP, axis=0).repeat(SILHOUETTE_STEP, axis=1)
    mask[large[: mask.shape[0], : mask.shape[1]] > 0] = 255


def draw_person(
    mask: UInt8[np.ndarray, "y x"], points: Float[np.ndarray, "25 3"], margin: float
) -> None:
    """Paints one person, given as (u px, v px, confidence), into `mask` with 255."""
    detected = points[:, 2] > _MIN_CONFIDENCE
    if detected.sum() < 2:
        return
    height = _height(points, detected)
    paint = lambda a, b, width: cv2.line(
        mask,
        _pixel(a),
        _pixel(b),
        255,
        thickness=max(1, min(round(2 * (width + margin) * height), 4000)),
        lineType=cv2.LINE_8,
    )
    for i, j, width in _LIMBS:
        if detected[i] and detected[j]:
            paint(points[i], points[j], width)
    for i, j, beyond, width in _EXTENDED_PARTS:
        if detected[i] and detected[j]:
            end = points[j] + beyond * (points[j] - points[i])
            paint(points[j], end, width)


def _height(points: np.ndarray, detected: np.ndarray) -> float:
    """Estimates the height of a person in the image (px), also if bent or partly
    hidden."""
    box = np.ptp(points[detected, :2], axis=0)
    size = float(np.hypot(*box))
    if detected[1] and detected[8]:  # the trunk is 0.3 of the height
        size = max(size, float(np.linalg.norm(points[1, :2] - points[8, :2])) / 0.3)
    return size


def _pixel(point: np.ndarray) -> tuple[int, int]:
    x, y = np.clip(np.round(point[:2]), -20000, 20000)
    return int(x), int(y)


def _fill_gaps(keypoints: Keypoints, max_gap: int) -> Float[np.ndarray, "h t 25 3"]:
    """Returns keypoints with short gaps interpolated, so that people are masked in
    frames without a detection."""
    points = np.concatenate([keypoints.uv, keypoints.confidence[..., None]], axis=-1)
    num_frames = points.shape[1]
    for person in points:
        for j in range(25):
            at = np.flatnonzero(person[:, j, 2] > _MIN_CONFIDENCE)
            if not len(at):
                continue
            before = at[np.searchsorted(at, np.arange(num_frames), "right") - 1]
            after = at[
                np.minimum(np.searchsorted(at, np.arange(num_frames)), len(at) - 1)
            ]
            # Before the first detection a person is absent.
            for k in np.setdiff1d(np.arange(at[0], num_frames), at):
                if abs(k - before[k]) <= max_gap and abs(k - after[k]) <= max_gap:
                    part = (k - before[k]) / max(after[k] - before[k], 1)
                    part = min(max(part, 0.0), 1.0)
                    a, b = person[before[k], j], person[after[k], j]
                    person[k, j] = (1 - part) * a + part * b
    return points
