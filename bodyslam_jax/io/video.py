"""Video file or folder of images -> frames, one at a time, and when they were taken.

Frames are also written as image files, under the names that camera files refer to.

A film of 24 frames/s in a file of 30, or of 30 in one of 60, holds frames twice; to a
motion model people then stop and start many times a second. A frame is a repeat if it
hardly differs from the one before while neighbouring frames differ much more. Videos of
a still scene, and videos whose encoder drops small changes, therefore have no repeats.
"""

import dataclasses
import logging
import re
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.geometry.arrays import runs
from bodyslam_jax.io.budget import check_pixels
from bodyslam_jax.io.images import read_image
from bodyslam_jax.types import DEFAULT_FPS, Sequence

_log = logging.getLogger(__name__)
IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp")
_VIDEO_SUFFIXES = """
mp4 mov m4v qt avi mkv webm mpg mpeg mpe m1v m2v mpv mts m2ts m2t ts mod tod vob 3gp
3g2 3gpp wmv asf flv f4v gif ogv ogm ogg divx xvid dv mxf mjpg mjpeg y4m nut rm rmvb
insv lrv h264 264 avc h265 265 hevc av1 ivf amv dav"""
VIDEO_SUFFIXES = tuple(f".{name}" for name in _VIDEO_SUFFIXES.split())
"""Suffixes of files that FFmpeg, by which OpenCV reads, takes for videos; in either
case."""
_MIN_SIDE_PX = 16
"""Least side of an image, px; smaller images have no features to track, and BRISK's
pyramid fails below 6."""
_MIN_PIXEL_ASPECT = 0.2
"""Least width of a pixel over its height; below it, or above its inverse, the
container's value is taken for a mistake."""
_QUARTER_SIZE, _MIN_LARGE_SIDE_PX = cv2.IMREAD_REDUCED_GRAYSCALE_4, 1000
_MAX_JITTER = 0.25
"""Largest spread of frame intervals of a fixed rate, relative to their median."""
_JPEG_QUALITY = 95
"""Quality of JPEG files, 0 to 100."""
_NUM_SAMPLES = 320
"""Number of samples along the longer side of the images that are compared."""
_BLOCK_SAMPLES = 16
"""Number of samples along a side of the blocks whose mean change is taken."""
_MIN_MOTION = 2.0
"""Least mean change of the blocks that change most that counts as motion, grey
levels."""
_MAX_REPEAT_RATIO = 0.15
"""Largest change of a repeated frame relative to that of its neighbours."""
_NUM_NEIGHBOURS = 10
"""Number of neighbours on each side."""
_MAX_CONVERSION_REPEATS = 4
"""Largest number of consecutive repeats that a conversion makes; more are a freeze, or
people who stand still."""
_MIN_REPEATS = 2
"""Least number of repeats in a video; a single one may be chance."""
_MAX_CLOCK_DEVIATION = 0.8
"""Largest deviation of a regular conversion from an even clock, frames."""
T = TypeVar("T")


class Repeats:
    """Collects the change from each image to the next, of a video read once."""

    def __init__(self) -> None:
        self.last: np.ndarray | None = None
        self.most: list[float] = []
        self.typical: list[float] = []

    def look(self, image: UInt8[np.ndarray, "y x *c"] | None) -> None:
        """Adds the next image, or `None` for one that cannot be decoded."""
        now = None
        if image is not None:
            step = max(1, max(image.shape[:2]) // _NUM_SAMPLES)
            plane = (
                image[::step, ::step, 1] if image.ndim == 3 else image[::step, ::step]
            )
            now = np.ascontiguousarray(plane)
        if self.most or self.last is not None:
            most, typical = _change(self.last, now)
            self.most.append(most)
            self.typical.append(typical)
        elif now is None:
            self.most.append(np.inf)
            self.typical.append(np.inf)
        self.last = now

    def repeated(self) -> Bool[np.ndarray, " t"]:
        """Returns which frames repeat the one before."""
        return repeated(np.asarray(self.most), np.asarray(self.typical))


@dataclasses.dataclass(frozen=True)
class Footage:
    """Size and frame times of a video, found by decoding all of it."""

    path: Path
    timestamps: Float[np.ndarray, " t"]
    """s, from 0, increasing"""
    width: int
    height: int
    warnings: tuple[str, ...] = ()
    num_read: int = 0
    """Number of all frames in the file, also of those that are left out."""
    picks: Int[np.ndarray, " t"] | None = None
    """Indices of the frames that are used; `None` for all."""
    pixel_aspect: float = 1.0
    """Width of a pixel over its height, from the container; 1 if that has none."""


def look_at(path: Path, fps: float | None = None) -> Footage:
    """Counts and times the frames of a video file or a folder of images.

    The number of frames in a video's header is often wrong, so every frame is visited.
    Sizes are those after the rotation that the file asks for.

    Args:
        fps: of a folder of images (1/s), 30 if not given; a video brings its own times.

    **Raises:** `InputError`, naming the file, if it is not a readable video.
    """
    footage = _look_at_images(path, fps) if path.is_dir() else _look_at_video(path)
    if min(footage.width, footage.height) < _MIN_SIDE_PX:
        raise InputError(
            f"{path}: images of {footage.width}x{footage.height} px are too small; "
            f"expected at least {_MIN_SIDE_PX}x{_MIN_SIDE_PX}."
        )
    return footage


def frames(
    source: Sequence | Path, *, gray: bool = False
) -> Iterator[UInt8[np.ndarray, "y x *c"]]:
    """Yields the images of a sequence in order: BGR, or gray; one in memory at a time.

    Of a `Sequence` only the frames it uses, of a file or folder all.

    **Raises:** `InputError` if the sequence has no images or one cannot be read.
    """
    path = source.frames if isinstance(source, Sequence) else source
    if path is None:
        raise InputError(f"{getattr(source, 'name', source)}: has no video or images.")
    picks = source.picks if isinstance(source, Sequence) else None
    images = _read_images(path, gray) if path.is_dir() else _read_video(path, gray)
    yield from images if picks is None else picked(images, picks)


def picked(items: Iterable[T], picks: Int[np.ndarray, " t"]) -> Iterator[T]:
    """Yields the `items` at the indices `picks`, which increase."""
    wanted = set(picks.tolist())
    return (item for k, item in enumerate(items) if k in wanted)


def _read_video(path: Path, gray: bool) -> Iterator[np.ndarray]:
    capture = open_video(path)
    try:
        while True:
            ok, image = capture.read()
            if not ok:
                break
            yield cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if gray else image
    finally:
        capture.release()


def list_images(folder: Path) -> list[Path]:
    """Returns images of a folder in the order of the numbers in their names."""
    found = [p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES]
    return sorted((p for p in found if not p.name.startswith(".")), key=natural_key)


def natural_key(path: Path) -> list[tuple[int, int | str]]:
    """Returns a key that sorts `frame_10` after `frame_9`."""
    parts = re.split(r"(\d+)", path.name)
    return [(0, int(p)) if p.isdigit() else (1, p) for p in parts]


def open_video(path: Path) -> cv2.VideoCapture:
    """Returns the video, opened, after a look at its header; the caller releases it.

    **Raises:** `InputError`, naming the file, if it is no video or is of absurd size.
    """
    if not path.is_file():
        found = "not a file" if path.exists() else "no such file"
        raise InputError(f"{path}: {found}, expected a video.")
    # FFmpeg only: OpenCV's other backends take `a.txt` for a pattern of image names.
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    if not capture.isOpened():
        raise InputError(f"{path}: not a video that OpenCV can read.")
    width, height = (
        round(capture.get(p))
        for p in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)
    )
    if width and height:  # some containers tell it with the first frame only
        check_pixels(path, width, height)
    return capture


def _look_at_video(path: Path) -> Footage:
    capture = open_video(path)
    try:
        ok, image = capture.read()
        if not ok:
            raise InputError(f"{path}: a video without a readable frame.")
        nominal = float(capture.get(cv2.CAP_PROP_FPS))
        announced = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        aspect = _pixel_aspect(capture)
        times = [float(capture.get(cv2.CAP_PROP_POS_MSEC)) / 1000]
        repeats = Repeats()
        repeats.look(image)
        while capture.grab():
            times.append(float(capture.get(cv2.CAP_PROP_POS_MSEC)) / 1000)
            ok, next_image = capture.retrieve()
            repeats.look(next_image if ok else None)
    finally:
        capture.release()
    stamps, picks, warnings = _timed(path, np.asarray(times), nominal, repeats)
    # Containers are often wrong by a frame or two; by more, the file is damaged.
    if announced > len(times) + max(2, 0.02 * announced):
        warnings += (f"{path.name}: {announced} frames announced, {len(times)} read.",)
    size = (image.shape[1], image.shape[0])
    return Footage(path, stamps, *size, warnings, len(times), picks, aspect)


def _pixel_aspect(capture: cv2.VideoCapture) -> float:
    """Returns the width of a pixel over its height, of the images as they are read."""
    across, along = (
        capture.get(p) for p in (cv2.CAP_PROP_SAR_NUM, cv2.CAP_PROP_SAR_DEN)
    )
    if not (
        across > 0
        and along > 0
        and _MIN_PIXEL_ASPECT < across / along < 1 / _MIN_PIXEL_ASPECT
    ):
        return 1.0
    turned = round(capture.get(cv2.CAP_PROP_ORIENTATION_META)) % 180 == 90
    return along / across if turned else across / along


def _timed(
    path: Path, times: Float[np.ndarray, " n"], nominal: float, repeats: Repeats
) -> tuple[Float[np.ndarray, " t"], Int[np.ndarray, " t"] | None, tuple[str, ...]]:
    """Returns `resampled`, without the frames that only repeat the one before."""
    again = repeats.repeated()
    if not again.any():
        return resampled(path, times, nominal)
    step = np.diff(times)
    if not np.isfinite(times).all() or (step <= 0).any():
        times, _, warnings = resampled(path, times, nominal)
    else:
        times, warnings = times - times[0], ()
    stamps, picks = without_repeats(times, again)
    fps = (len(stamps) - 1) / (stamps[-1] - stamps[0]) if len(stamps) > 1 else nominal
    return stamps, picks, (*warnings, repeats_warning(path.name, again, fps))


def resampled(
    path: Path, times: Float[np.ndarray, " n"], nominal: float
) -> tuple[Float[np.ndarray, " t"], Int[np.ndarray, " t"] | None, tuple[str, ...]]:
    """Returns times of the frames that are used (s, from 0), their indices, and
    warnings.

    Where the rate varies, the frames nearest to the ticks of a clock of the median rate
    are used, which thins out denser parts. No frame is repeated: gaps stay, with their
    true times. Times that do not increase are replaced by the nominal rate (1/s).
    """
    step = np.diff(times)
    if len(times) == 1:
        return np.zeros(1), None, ()
    if not np.isfinite(times).all() or (step <= 0).any():
        if not 1 <= nominal <= 1000:
            nominal = DEFAULT_FPS
        warning = f"{path.name}: times do not increase; {nominal:g} frames/s taken."
        return np.arange(len(times)) / nominal, None, (warning,)
    median = float(np.median(step))
    times = times - times[0]
    if np.abs(step - median).max() <= _MAX_JITTER * median:
        return times, None, ()
    ticks = np.arange(0.0, times[-1] + 0.5 * median, median)
    after = np.clip(np.searchsorted(times, ticks), 1, len(times) - 1)
    nearest = after - (ticks - times[after - 1] < times[after] - ticks)
    picks = np.unique(nearest)
    slow, fast = 1 / step.max(), 1 / step.min()
    text = f"{path.name}: variable frame rate, {slow:.3g} to {fast:.3g} frames/s; "
    if len(picks) == len(times):
        return times, None, (text + "all frames used, each at its own time.",)
    text += f"resampled to {1 / median:.3g}, {len(picks)} of {len(times)} frames used."
    return times[picks], picks, (text,)


def at_rate(footage: Footage, fps: float) -> Footage:
    """Returns all frames of a video file, one every 1/`fps` s, in place of the file's
    times."""
    times = np.arange(footage.num_read) / fps
    kept = tuple(w for w in footage.warnings if "announced" in w)
    return dataclasses.replace(footage, timestamps=times, picks=None, warnings=kept)


def _look_at_images(folder: Path, fps: float | None) -> Footage:
    images = list_images(folder)
    if not images:
        raise InputError(f"{folder}: no images ({' '.join(IMAGE_SUFFIXES)}).")
    height, width = _read_image(images[0], gray=True).shape
    warnings: tuple[str, ...] = ()
    if fps is None:
        fps = DEFAULT_FPS
        warnings = (f"{folder.name}: frame rate not given, 30 frames/s assumed.",)
    times = np.arange(len(images)) / fps
    repeats = Repeats()
    for path in images:
        # A quarter of the size is decoded in a fraction of the time.
        flag = (
            _QUARTER_SIZE
            if max(width, height) > _MIN_LARGE_SIDE_PX
            else cv2.IMREAD_GRAYSCALE
        )
        repeats.look(read_image(path, flag))
    stamps, picks, more = _timed(folder, times, fps, repeats)
    return Footage(
        folder, stamps, width, height, (*warnings, *more), len(images), picks
    )


def _read_images(folder: Path, gray: bool) -> Iterator[np.ndarray]:
    size = None
    for path in list_images(folder):
        image = _read_image(path, gray)
        size = size or image.shape
        if image.shape != size:
            found, expected = _size(image.shape), _size(size)
            raise InputError(f"{path}: {found}, but the first image is {expected}.")
        yield image


def _read_image(path: Path, gray: bool) -> np.ndarray:
    return read_image(path, cv2.IMREAD_GRAYSCALE if gray else cv2.IMREAD_COLOR)


def _size(shape: tuple[int, ...]) -> str:
    return f"{shape[1]}x{shape[0]} px"


def frame_name(frame: int) -> str:
    """Returns the name of a frame's image, counted from 0."""
    return f"frame_{frame:06d}.jpg"


def extract_frames(
    video: Path,
    timestamps: Float[np.ndarray, " t"],
    chosen: Int[np.ndarray, " n"],
    folder: Path,
) -> list[str]:
    """Writes frames of a result into a folder and returns their names.

    Images of a folder are copied, under their own names. Of a video the frames at those
    times are written as `frame_000000.jpg`, numbered as in the result.

    Args:
        timestamps: of all frames of the result, s from the first frame of the video.
        chosen: which of them are written, increasing.

    **Raises:** `InputError`, naming the video, if it is another one.
    """
    rate = (len(timestamps) - 1) / max(np.ptp(timestamps), 1e-9)
    times = look_at(video, rate).timestamps
    files = list_images(video) if video.is_dir() else None
    if len(times) == len(timestamps):
        at = np.arange(len(times))
    else:
        at = np.abs(times[:, None] - timestamps).argmin(axis=0)
        away = np.abs(times[at] - timestamps).max()
        if away > 0.5 / rate or len(np.unique(at)) < len(at):
            raise InputError(
                f"{video}: {len(times)} frames in {times[-1]:.2f} s, expected the "
                f"run's {len(timestamps)}, to {timestamps[-1]:.2f} s: another video."
            )
    folder.mkdir(parents=True, exist_ok=True)
    at = at[chosen]
    if files is not None:
        for k in at:
            shutil.copyfile(files[k], folder / files[k].name)
        return [files[k].name for k in at]
    names = [frame_name(int(k)) for k in chosen]
    images = picked(frames(video), at)
    for name, image in zip(names, images, strict=True):
        _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
        (folder / name).write_bytes(data.tobytes())
    return names


def repeated(
    most: Float[np.ndarray, " n"], typical: Float[np.ndarray, " n"]
) -> Bool[np.ndarray, " t"]:
    """Returns which of n + 1 frames repeat the one before.

    Args:
        most: change (grey levels) from each frame to the next where most changes: of a
            person, if the camera stands.
        typical: change of the median block: not small only if the camera moves.
    """
    found = np.zeros(len(most) + 1, dtype=bool)
    for k, change in enumerate(most):
        near = most[max(0, k - _NUM_NEIGHBOURS) : k + _NUM_NEIGHBOURS + 1]
        near = np.sort(near[np.isfinite(near)])
        usual = np.median(near[len(near) // 2 :]) if len(near) else 0.0
        found[k + 1] = usual >= _MIN_MOTION and change < _MAX_REPEAT_RATIO * usual
    for run in runs(found):
        first, last = run.start, run.stop - 1
        # What moves goes on just before and after; people stop little by little.
        sides = [first - 2, last]  # changes into the frame before, and after the last
        sides = [k for k in sides if 0 <= k < len(most)]
        moves = typical if last - first + 1 > _MAX_CONVERSION_REPEATS else most
        if not sides or min(moves[k] for k in sides) < _MIN_MOTION:
            found[first : last + 1] = False
    if found.sum() < _MIN_REPEATS:
        found[:] = False
    return found


def without_repeats(
    times: Float[np.ndarray, " t"], found: Bool[np.ndarray, " t"]
) -> tuple[Float[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """Returns times (s) and indices of the frames that are new.

    Where new frames come as regularly as a conversion gives them, they were taken at
    equal times; otherwise each keeps the time at which it was shown first.
    """
    picks = np.flatnonzero(~found)
    kept = times[picks]
    if len(picks) < 3:
        return kept, picks
    even = np.linspace(picks[0], picks[-1], len(picks))
    if np.abs(even - picks).max() <= _MAX_CLOCK_DEVIATION:
        kept = np.linspace(kept[0], kept[-1], len(kept))
    return kept, picks


def repeats_warning(name: str, found: Bool[np.ndarray, " t"], fps: float) -> str:
    return (
        f"{name}: {found.sum()} of {len(found)} frames only repeat the one before, as "
        f"after a conversion of the frame rate: left out, {fps:.4g} frames/s remain."
    )


def _change(a: np.ndarray | None, b: np.ndarray | None) -> tuple[float, float]:
    if a is None or b is None or a.shape != b.shape:
        return np.inf, np.inf
    size = max(1, a.shape[1] // _BLOCK_SAMPLES), max(1, a.shape[0] // _BLOCK_SAMPLES)
    blocks = cv2.resize(
        cv2.absdiff(a, b).astype(np.float32), size, interpolation=cv2.INTER_AREA
    )
    return float(np.quantile(blocks, 0.98)), float(np.median(blocks))
