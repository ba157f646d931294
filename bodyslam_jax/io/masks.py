"""Masks that are given: which file is of which frame, and whether they can be right.

A look at some of them, when the input is read: inverted masks, masks of another size,
of another video or without anybody in them would be noticed by nothing but a bad map.
"""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax.io.camera.calibration import project_points
from bodyslam_jax.io.frame_index import InvalidContent, Warn, frames_of_names
from bodyslam_jax.io.video import list_images
from bodyslam_jax.types import Bodies, Intrinsics, Keypoints, MaskUse

_LOOKED_AT = 12
"""Masks that are looked at when the input is read."""
_SURE = 0.3
_FEWEST_POINTS = 20
_MOST = 0.5
"""Share of the image that people seldom fill, and of masks that say the same."""
_BORDER = 0.75
"""Share of the image's border that people never fill."""
_OUTSIDE = 0.35
"""Share of a person's points within the masks below which these are not theirs."""
_NOTHING_LEFT = 0.9
_NEAR = 0.02
"""Of the image's longer side: keypoints may be so far outside a mask's rim."""
_SAME_ASPECT = 0.015
_ABOUT_PELVIS = np.array([[x, y, 0.0] for x in (-0.1, 0.1) for y in (-0.5, -0.2, 0.3)])
"""m, of places that belong to most bodies, in whatever posture."""


def read_masks(
    folder: Path,
    *,
    num_frames: int,
    intrinsics: Intrinsics,
    images: tuple[str, ...] = (),
    people: Keypoints | None = None,
    bodies: Bodies | None = None,
    warn: Warn,
) -> MaskUse:
    """How the masks in a folder are to be used, after a look at some of them.

    Masks whose zeros are the people are inverted, with a warning, and masks of another
    size but the same shape resized. Where masks do not cover the people, or are not
    there for all frames, people's keypoints are painted, too.

    **Raises:** `ValueError`, naming folder or file, if there are not as many masks as
    frames, and numbers in their names do not say which are missing, or if their shape
    is not the images'.
    """
    if not folder.is_dir():
        raise ValueError(f"{folder}: not a folder of mask images.")
    names = [path.name for path in list_images(folder)]
    files, missing = _by_frame(folder, names, num_frames, images, warn)
    there = [k for k in range(num_frames) if k not in missing]
    looked_at = np.unique(np.linspace(0, len(there) - 1, _LOOKED_AT).astype(int))
    size = (intrinsics.width, intrinsics.height)
    masks, resized = {}, ""
    for k in (there[i] for i in looked_at):
        masks[k] = read_mask(folder / files[k][0])
        found = (masks[k].shape[1], masks[k].shape[0])
        if found != size:
            masks[k] = resized_to(folder / files[k][0], masks[k], size)
            resized = f"{found[0]}x{found[1]}"
    if resized:
        warn(f"masks of {resized} px: resized to the video's {size[0]}x{size[1]} px.")
    points = _points(people, bodies, intrinsics)
    inverted, covered = _judged(masks, points, warn)
    return MaskUse(tuple(files), inverted, not covered or bool(missing))


def read_mask(path: Path) -> Bool[np.ndarray, "y x"]:
    """Where a mask is not zero; of a lossy image, where it is bright. An image that has
    nothing but transparency to tell is read by that.

    **Raises:** `ValueError`, naming the file, if it is no image.
    """
    data = np.fromfile(path, dtype=np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    if image is None:
        raise ValueError(f"{path}: not an image that OpenCV can read.")
    if image.ndim == 3 and image.shape[2] == 4:
        color, alpha = image[..., :3].max(axis=2), image[..., 3]
        image = alpha if np.ptp(color) == 0 and np.ptp(alpha) > 0 else color
    elif image.ndim == 3:
        image = image.max(axis=2)
    lossy = path.suffix.lower() in (".jpg", ".jpeg", ".webp")
    return image > (image.max(initial=0) // 2 if lossy else 0)


def resized_to(
    path: Path, mask: Bool[np.ndarray, "y x"], size: tuple[int, int]
) -> Bool[np.ndarray, "h w"]:
    """The mask for images of that size (width, height).

    **Raises:** `ValueError`, naming the file, if its shape is another.
    """
    height, width = mask.shape
    if abs(np.log(width / height * size[1] / size[0])) > _SAME_ASPECT:
        raise ValueError(
            f"{path}: {width}x{height} px, but the video is {size[0]}x{size[1]} px."
        )
    found = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    return found > 0


def _by_frame(
    folder: Path, names: list[str], num_frames: int, images: tuple[str, ...], warn: Warn
) -> tuple[list[tuple[str, ...]], set[int]]:
    """The masks of each frame, and the frames without one of their own, which have
    those before and after."""
    if len(names) == num_frames:
        return [(name,) for name in names], set()
    count = f"{len(names)} masks, but the video has {num_frames} frames"
    if not names or len(names) > num_frames:
        raise ValueError(f"{folder}: {count}.")
    try:
        quiet = lambda _: None
        frames = frames_of_names(
            names,
            what="masks",
            num_frames=num_frames,
            images=images,
            complete=False,
            warn=quiet,
        )
    except InvalidContent as error:
        raise ValueError(f"{folder}: {count}, and {error}.") from None
    of_frame = {frame: name for name, frame in frames.items()}
    own = np.array(sorted(of_frame))
    if len(own) == own[-1] - own[0] + 1 and not set(names) <= set(images):
        raise ValueError(
            f"{folder}: {count}, and no gaps in their numbers to say which are missing."
        )
    files = []
    for k in range(num_frames):
        at = int(np.searchsorted(own, k))
        near = (
            {k} if k in of_frame else {own[max(at - 1, 0)], own[min(at, len(own) - 1)]}
        )
        files.append(tuple(of_frame[int(n)] for n in sorted(near)))
    warn(
        f"masks of {len(names)} of {num_frames} frames, by the numbers in their names: "
        "in the others those before and after are used, and people's keypoints."
    )
    return files, set(range(num_frames)) - set(of_frame)


def _points(
    people: Keypoints | None, bodies: Bodies | None, intrinsics: Intrinsics
) -> Float[np.ndarray, "h t n 3"] | None:
    """Of each person in each frame points (u px, v px, 1 where it is there, else 0)."""
    if people is not None:
        sure = people.confidence > _SURE
        seen = sure if sure.any() else people.confidence > 0
        return np.concatenate([people.uv, seen[..., None].astype(float)], axis=-1)
    if bodies is None:
        return None
    place = bodies.trans[:, :, None] + _ABOUT_PELVIS
    uv = project_points(intrinsics, place.reshape(-1, 3)).reshape(*place.shape[:3], 2)
    there = np.broadcast_to(bodies.present[..., None], uv.shape[:3])
    return np.concatenate([uv, there[..., None].astype(float)], axis=-1)


def _judged(
    masks: dict[int, np.ndarray], points: np.ndarray | None, warn: Warn
) -> tuple[bool, bool]:
    """Whether masks are inverted, and whether they cover anybody then."""
    area = float(np.median([mask.mean() for mask in masks.values()]))
    border = float(np.median([_on_border(mask) for mask in masks.values()]))
    within = _within(masks, points)
    least = within.min(initial=1.0)
    inverted = bool(border > _BORDER and area > _MOST and least < _OUTSIDE)
    if not len(within):
        inverted = border > _BORDER and _MOST < area < 1
    if inverted:
        what = "they touch nearly all of its border"
        if len(within):
            what = f"no more than {100 * least:.0f} % of a person's points"
        warn(f"masks: {100 * area:.0f} % of the image, and {what}: taken as inverted.")
        within, area = 1 - within, 1 - area
    if area > _NOTHING_LEFT:
        warn(f"masks: {100 * area:.0f} % of the image: little is left to follow.")
    most = within.max(initial=0.0)
    if len(within) and most < _OUTSIDE:
        what = "nothing" if area == 0 else f"{100 * most:.0f} % of people's points"
        warn(
            f"masks: cover {what}: of another video? People's keypoints are masked "
            "beside them."
        )
        return inverted, False
    return inverted, True


def _within(masks: dict[int, np.ndarray], points: np.ndarray | None) -> np.ndarray:
    """For each person of whom enough is seen, the share of points in the masks."""
    if points is None:
        return np.zeros(0)
    count, hit = np.zeros(len(points)), np.zeros(len(points))
    for k, mask in masks.items():
        near = 2 * max(1, round(_NEAR * max(mask.shape))) + 1
        wide = cv2.dilate(mask.astype(np.uint8), np.ones((near, near), np.uint8))
        height, width = mask.shape
        if mask.mean() > _MOST:
            wide = mask.astype(np.uint8)
        u, v = np.round(points[:, k, :, 0]), np.round(points[:, k, :, 1])
        inside = (points[:, k, :, 2] > 0) & (u >= 0) & (v >= 0)
        inside &= (u < width) & (v < height)
        at = np.where(inside, v, 0).astype(int), np.where(inside, u, 0).astype(int)
        count += inside.sum(axis=1)
        hit += (inside & (wide[at] > 0)).sum(axis=1)
    enough = count >= _FEWEST_POINTS
    return hit[enough] / count[enough]


def _on_border(mask: np.ndarray) -> float:
    edges = (mask[0], mask[-1], mask[:, 0], mask[:, -1])
    return float(np.concatenate(edges).mean())
