"""The budget of inputs: largest sizes of everything that is opened.

Readers ask `current()`; whoever knows the user's settings opens a block with
`granted(config.limits)`. Outside of one the defaults of `config.Limits` hold.
"""

import contextlib
import contextvars
from collections.abc import Iterator
from pathlib import Path

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.config.run import Limits

MAX_DEPTH = 64
"""Levels of nesting in JSON and YAML: formats that are read have 8 at most."""
MAX_ELEMENTS = 20_000_000
"""Values in JSON: an hour of 30 frames/s with three people of 133 keypoints is 130
million bytes of `.npz`, but as JSON a tree of gigabytes in memory."""
MAX_YAML_BYTES = 200_000
"""Size of a YAML file: settings and calibrations have some thousand bytes, and the
parser, which is written in Python, reads some 50,000 a second."""
MAX_MARKUP_BYTES = 1_000_000
"""Size of a TOML or XML file: calibrations of a hundred cameras have 100,000 bytes."""
MAX_PIXELS = 100_000_000
"""Pixels of one image: three times those of 8K video."""
MAX_MEMBERS = 100_000
"""Largest number of files within an archive."""
MAX_PEOPLE = 1000
"""Largest number of people in one frame: they are compared in pairs."""
MAX_SPARSITY = 100
"""Ratio of the last number to the count of observations above which numbers are no
frame numbers, but times for example."""

_limits: contextvars.ContextVar[Limits] = contextvars.ContextVar(
    "limits", default=Limits()
)


def current() -> Limits:
    """Returns the limits in force."""
    return _limits.get()


@contextlib.contextmanager
def granted(limits: Limits) -> Iterator[None]:
    """Applies these limits within the block."""
    token = _limits.set(limits)
    try:
        yield
    finally:
        _limits.reset(token)


def check_bytes(path: Path, size: int, what: str = "") -> None:
    """Refuses what is larger than the budget, before it is read or unpacked.

    **Raises:** `InputError`, naming the file and the option that allows more.
    """
    most = current().bytes
    if size > most:
        raise InputError(
            f"{path}: {what}{size / 1e9:.3g} GB, expected at most {most / 1e9:.3g} GB "
            "(--limits.input-gigabytes allows more)."
        )


def check_pixels(path: Path, width: int, height: int) -> None:
    """Refuses an image, or a video's frames, of an absurd size before it is decoded.

    **Raises:** `InputError`, naming the file.
    """
    if not (0 < width and 0 < height and width * height <= MAX_PIXELS):
        raise InputError(
            f"{path}: images of {width}x{height} px by its header, expected at most "
            f"{MAX_PIXELS / 1e6:.0f} million pixels."
        )


def last_frame_problem(last: int, observed: int, what: str) -> str | None:
    """Returns the reason why `last` cannot be the number of a frame where no video
    bounds it; `None` if it can.

    Args:
        observed: number of frames, or of images, that the file tells something of.
        what: what the numbers are of, for the message.
    """
    if last >= current().frames:
        return (
            f"{what} of frame {last}, expected less than {current().frames} without a "
            "video (--limits.frames allows more)"
        )
    if last > MAX_SPARSITY * (observed + 10):
        return (
            f"{what} of frame {last}, but of {observed} frames only: no frame numbers"
        )
    return None
