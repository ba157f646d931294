"""Person masks: which file belongs to which frame, and whether they are plausible.

Some of them are checked when the input is read. Masks that are inverted, of another
size, of another video or empty would otherwise only show as a bad map.
"""

import functools
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io.archive import read_npz
from bodyslam_jax.io.camera.calibration import project_points
from bodyslam_jax.io.declared_size import ASPECT_TOLERANCE
from bodyslam_jax.io.frame_index import InvalidContent, Warn, frames_of_names
from bodyslam_jax.io.images import read_image
from bodyslam_jax.io.keypoints.arrange import MIN_CONFIDENCE
from bodyslam_jax.io.video import list_images
from bodyslam_jax.types import Bodies, Intrinsics, Keypoints, MaskUse

_NUM_CHECKED = 12
"""Number of masks that are checked when the input is read."""
_MIN_POINTS = 20
"""Least number of points of a person, in all checked frames, for a comparison."""
_MAX_AREA_SHARE = 0.5
"""Share of the image that people seldom fill."""
_MAX_BORDER_SHARE = 0.75
"""Share of the image's border that people never fill."""
_MIN_COVERED_SHARE = 0.35
"""Least share of a person's points within masks that are of this video."""
_MAX_MASKED_SHARE = 0.9
"""Masked share of the image from which too little remains for tracking."""
_MARGIN = 0.02
"""Largest distance of a keypoint from a mask that counts as within, relative to the
image's longer side."""
_PELVIS_POINTS_M = np.array(
    [[x, y, 0.0] for x in (-0.1, 0.1) for y in (-0.5, -0.2, 0.3)]
)
"""Points relative to the pelvis, m, that lie on most bodies in any posture."""


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
    """Checks some of the masks in a folder or in one `.npz` and returns how they are to
    be used.

    Masks in which zero marks people are inverted, and masks of another size but the
    same aspect ratio are resized, both with a warning. If masks do not cover the
    people, or some frames have none, regions around keypoints are masked, too.

    **Raises:** `InputError`, naming folder or file, if masks are missing and the
    numbers in their names do not tell which, or if their aspect ratio is not that of
    the images.
    """
    names = mask_names(folder)
    files, missing = _by_frame(folder, names, num_frames, images, warn)
    present = [k for k in range(num_frames) if k not in missing]
    checked = np.unique(np.linspace(0, len(present) - 1, _NUM_CHECKED).astype(int))
    size = (intrinsics.width, intrinsics.height)
    masks, resized = {}, ""
    for k in (present[i] for i in checked):
        masks[k] = read_named(folder, files[k][0])
        found = (masks[k].shape[1], masks[k].shape[0])
        if found != size:
            masks[k] = resized_to(folder / files[k][0], masks[k], size)
            resized = f"{found[0]}x{found[1]}"
    if resized:
        warn(f"masks of {resized} px: resized to the video's {size[0]}x{size[1]} px.")
    points = _points(people, bodies, intrinsics)
    inverted, covered = _judged(masks, points, warn)
    return MaskUse(tuple(files), inverted, not covered or bool(missing))


def mask_names(source: Path) -> list[str]:
    """Returns names of the images in a folder, or the numbers of the masks in an
    `.npz`.

    **Raises:** `InputError`, naming the file, if it is neither.
    """
    if source.is_dir():
        return [path.name for path in list_images(source)]
    if source.suffix != ".npz":
        raise InputError(f"{source}: neither a folder of mask images nor an .npz.")
    return [str(k) for k in range(len(_stack(source)))]


def read_named(source: Path, name: str) -> Bool[np.ndarray, "y x"]:
    """Returns one of the masks that `mask_names` lists.

    **Raises:** `InputError`, naming the file, if it is no image.
    """
    return read_mask(source / name) if source.is_dir() else _stack(source)[int(name)]


@functools.lru_cache(maxsize=1)
def _stack(path: Path) -> Bool[np.ndarray, "t y x"]:
    """Returns the masks of an `.npz`: `masks` (t, y, x), or the only array in it;
    several people's masks (t, h, y, x) become one.

    **Raises:** `InputError`, naming the file, if there is no such array.
    """
    archive = read_npz(path)
    names = archive.names
    name = "masks" if "masks" in names or len(names) != 1 else names[0]
    if name not in names:
        raise InputError(f"{path}: arrays {', '.join(names)}, expected `masks`.")
    stack = archive.raw(name)
    if stack.ndim not in (3, 4) or stack.dtype.kind not in "biuf":
        raise InputError(
            f"{path}: `{name}` {stack.dtype}{stack.shape}, expected numbers (frames, "
            "height, width) or (frames, people, height, width)."
        )
    if stack.dtype.kind != "b":
        stack = stack > (0 if stack.dtype.kind == "u" else 0.5)
    found = np.asarray(stack)
    return np.asarray(found.any(axis=1)) if found.ndim == 4 else found


def read_mask(path: Path) -> Bool[np.ndarray, "y x"]:
    """Returns where a mask is not zero; in a lossy format, where it is bright. An image
    of one colour with a varying alpha channel is read by that channel.

    **Raises:** `InputError`, naming the file, if it is no image.
    """
    image = read_image(path, cv2.IMREAD_UNCHANGED)
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
    """Returns the mask resized to `size` (width, height; px).

    **Raises:** `InputError`, naming the file, if its aspect ratio is another.
    """
    height, width = mask.shape
    if abs(np.log(width / height * size[1] / size[0])) > ASPECT_TOLERANCE:
        raise InputError(
            f"{path}: {width}x{height} px, but the video is {size[0]}x{size[1]} px."
        )
    found = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    return found > 0


def _by_frame(
    folder: Path, names: list[str], num_frames: int, images: tuple[str, ...], warn: Warn
) -> tuple[list[tuple[str, ...]], set[int]]:
    """Returns names of the masks of each frame, and the frames without a mask of their
    own, which use the nearest ones before and after."""
    if len(names) == num_frames:
        return [(name,) for name in names], set()
    count = f"{len(names)} masks, but the video has {num_frames} frames"
    if not names or len(names) > num_frames:
        raise InputError(f"{folder}: {count}.")
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
        raise InputError(f"{folder}: {count}, and {error}.") from None
    of_frame = {frame: name for name, frame in frames.items()}
    own = np.array(sorted(of_frame))
    if len(own) == own[-1] - own[0] + 1 and not set(names) <= set(images):
        raise InputError(
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
    """Returns image points of each person in each frame: u px, v px, 1 or 0 if
    missing."""
    if people is not None:
        sure = people.confidence > MIN_CONFIDENCE
        present = sure if sure.any() else people.confidence > 0
        return np.concatenate([people.uv, present[..., None].astype(float)], axis=-1)
    if bodies is None:
        return None
    place = bodies.trans[:, :, None] + _PELVIS_POINTS_M
    uv = project_points(intrinsics, place.reshape(-1, 3)).reshape(*place.shape[:3], 2)
    present = np.broadcast_to(bodies.present[..., None], uv.shape[:3])
    return np.concatenate([uv, present[..., None].astype(float)], axis=-1)


def _judged(
    masks: dict[int, np.ndarray], points: np.ndarray | None, warn: Warn
) -> tuple[bool, bool]:
    """Returns whether masks are inverted, and whether they cover the people after that
    is corrected."""
    area = float(np.median([mask.mean() for mask in masks.values()]))
    border = float(np.median([_on_border(mask) for mask in masks.values()]))
    within = _within(masks, points)
    least = within.min(initial=1.0)
    inverted = bool(
        border > _MAX_BORDER_SHARE
        and area > _MAX_AREA_SHARE
        and least < _MIN_COVERED_SHARE
    )
    if not len(within):
        inverted = border > _MAX_BORDER_SHARE and _MAX_AREA_SHARE < area < 1
    if inverted:
        what = "they touch nearly all of its border"
        if len(within):
            what = f"no more than {100 * least:.0f} % of a person's points"
        warn(f"masks: {100 * area:.0f} % of the image, and {what}: taken as inverted.")
        within, area = 1 - within, 1 - area
    if area > _MAX_MASKED_SHARE:
        warn(f"masks: {100 * area:.0f} % of the image: little is left to follow.")
    most = within.max(initial=0.0)
    if len(within) and most < _MIN_COVERED_SHARE:
        what = "nothing" if area == 0 else f"{100 * most:.0f} % of people's points"
        warn(
            f"masks: cover {what}: of another video? People's keypoints are masked "
            "beside them."
        )
        return inverted, False
    return inverted, True


def _within(masks: dict[int, np.ndarray], points: np.ndarray | None) -> np.ndarray:
    """Returns for each person with enough points the share of them within the masks."""
    if points is None:
        return np.zeros(0)
    count, hit = np.zeros(len(points)), np.zeros(len(points))
    for k, mask in masks.items():
        near = 2 * max(1, round(_MARGIN * max(mask.shape))) + 1
        wide = cv2.dilate(mask.astype(np.uint8), np.ones((near, near), np.uint8))
        height, width = mask.shape
        if mask.mean() > _MAX_AREA_SHARE:
            wide = mask.astype(np.uint8)
        u, v = np.round(points[:, k, :, 0]), np.round(points[:, k, :, 1])
        inside = (points[:, k, :, 2] > 0) & (u >= 0) & (v >= 0)
        inside &= (u < width) & (v < height)
        at = np.where(inside, v, 0).astype(int), np.where(inside, u, 0).astype(int)
        count += inside.sum(axis=1)
        hit += (inside & (wide[at] > 0)).sum(axis=1)
    enough = count >= _MIN_POINTS
    return hit[enough] / count[enough]


def _on_border(mask: np.ndarray) -> float:
    edges = (mask[0], mask[-1], mask[:, 0], mask[:, -1])
    return float(np.concatenate(edges).mean())
