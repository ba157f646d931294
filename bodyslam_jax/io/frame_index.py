"""Names of images, or of files about them -> frames of the video.

Tools count from 0, from 1 or from where a longer video was cut, and some leave out the
images in which they found nobody. Where the names are ambiguous, the likeliest reading
is taken, with a warning.
"""

import re
from collections.abc import Callable, Iterable, Sequence

from bodyslam_jax.io.budget import last_frame_problem
from bodyslam_jax.io.video import IMAGE_SUFFIXES

Warn = Callable[[str], None]
"""Function that is called with a line for the report: what was guessed or left out."""

_SUFFIX = re.compile(
    r"(_keypoints)?\.json$|(" + "|".join(map(re.escape, IMAGE_SUFFIXES)) + r")$", re.I
)


_MAX_DIGITS = 255
"""Largest number of digits in a name: file systems allow no longer names."""


class InvalidContent(ValueError):
    """An error in a file's content; whoever catches it adds the file's name."""


def frames_of_names(
    names: Iterable[str],
    *,
    what: str,
    num_frames: int | None,
    images: Sequence[str] = (),
    complete: bool,
    warn: Warn,
) -> dict[str, int]:
    """Returns the index of the video's frame for each image name in a file.

    Args:
        names: names of all images that the file lists, with or without people.
        what: what the names number, for messages.
        num_frames: number of frames of the video; None if it is not known.
        images: names of the video's frames, if the video is a folder of images.
        complete: whether the file also lists images without people.

    **Raises:** `InvalidContent` if a name has no number, two mean the same frame, or
    the video is another one.
    """
    names = list(dict.fromkeys(names))
    if not names:
        return {}
    stems = [_stem(name) for name in names]
    place = {_stem(image): k for k, image in enumerate(images)}
    if all(stem in place for stem in stems):
        frames = [place[stem] for stem in stems]
    else:
        numbers = _numbers(stems)
        if numbers is None:
            bare = next(n for n in names if not re.search(r"\d", _stem(n)))
            raise InvalidContent(f"no frame number in the name {bare}")
        _refuse_two_of_one(names, numbers)
        frames = _by_image(numbers, list(place), what, warn)
        if frames is None:
            first = _first(numbers, num_frames, what, complete, warn)
            frames = [n - first for n in numbers]
    _refuse_two_of_one(names, frames)
    return dict(zip(names, frames, strict=True))


def gap_among(images: Sequence[str]) -> str | None:
    """Returns a warning if the numbers in the names of a video's images have gaps.

    With gaps at more than one image in ten, images were thinned on purpose: no warning.
    """
    numbers = _numbers([_stem(name) for name in images]) or []
    steps = [b - a for a, b in zip(numbers, numbers[1:])]
    if not steps or min(steps) < 1:
        return None
    # Numbers that are times are never quite even.
    usual = sorted(steps)[(len(steps) - 1) // 2]
    wide = [k for k, step in enumerate(steps) if step >= 2 * usual]
    if not 0 < len(wide) <= max(1, len(steps) // 10):
        return None
    return (
        f"images: none between {images[wide[0]]} and {images[wide[0] + 1]}"
        + (f", and {len(wide) - 1} more such gaps" if len(wide) > 1 else "")
        + "; taken as if each followed the last by one frame."
    )


def _stem(name: str) -> str:
    """Returns the name without folders and known suffixes; other dots belong to it."""
    return _SUFFIX.sub("", re.split(r"[/\\]", name)[-1])


def _numbers(stems: list[str]) -> list[int] | None:
    """Returns for each name the last of its numbers that differs between the names.

    For example 12 for `000012_cam1`, if another name is `000013_cam1`. None if a name
    has no number.
    """
    groups = [re.findall(r"\d+", stem) for stem in stems]
    if not all(groups):
        return None
    if len({re.sub(r"\d+", "#", stem) for stem in stems}) == 1:
        for column in reversed(list(zip(*groups, strict=True))):
            found = [_number(digits) for digits in column]
            if len(set(found)) == len(found):
                return found
    return [_number(g[-1]) for g in groups]


def _number(digits: str) -> int:
    if len(digits) > _MAX_DIGITS:
        raise InvalidContent(f"a number of {len(digits)} digits in a name")
    return int(digits)


def _refuse_two_of_one(names: list[str], numbers: list[int]) -> None:
    first: dict[int, str] = {}
    for name, number in zip(names, numbers, strict=True):
        if number in first:
            raise InvalidContent(
                f"{first[number]} and {name} are both of frame {number}"
            )
        first[number] = name


def _by_image(
    numbers: list[int], images: list[str], what: str, warn: Warn
) -> list[int] | None:
    """Returns frames by the numbers of the images themselves; `None` if those are
    others."""
    of_images = (_numbers(images) if images else None) or []
    place = {n: k for k, n in enumerate(of_images)}
    if len(place) < len(of_images) or not all(n in place for n in numbers):
        return None
    frames = [place[n] for n in numbers]
    if frames != numbers and max(numbers) < len(images):
        warn(
            f"{what} numbered {min(numbers)} to {max(numbers)}: taken as the numbers "
            f"of the images, which begin at {of_images[0]}."
        )
    return frames


def _first(
    numbers: list[int], num_frames: int | None, what: str, complete: bool, warn: Warn
) -> int:
    """Returns the number of frame 0."""
    first, last = min(numbers), max(numbers)
    unbroken = len(set(numbers)) == last - first + 1
    if num_frames is None:
        # Counted from the first if none is missing, as of a cut-out.
        span = last - first if unbroken and complete else last
        if problem := last_frame_problem(span, len(numbers), what):
            raise InvalidContent(problem)
        num_frames = len(numbers) if complete and unbroken else last + 1
    if unbroken and len(numbers) == num_frames:
        return first  # also a cut-out of a longer video
    if first >= 1 and last == num_frames:
        return 1
    if last >= num_frames:
        raise InvalidContent(
            f"{what} of frames {first} to {last}, but the video has {num_frames} frames"
        )
    if first == 0:
        if complete and unbroken:
            warn(
                f"{what} numbered 0 to {last} for {num_frames} frames: taken as "
                f"counted from 0, the first {len(numbers)}; but the tool, which writes "
                "every frame, may have been given every n-th frame only."
            )
        return 0
    # A tool that lists every image would have listed number 0, unless files have been
    # deleted, as gaps in the numbers show.
    zero = 1 if complete and unbroken and first == 1 else 0
    warn(
        f"{what} numbered {first} to {last} for {num_frames} frames: taken as counted "
        f"from {zero}."
    )
    return zero
