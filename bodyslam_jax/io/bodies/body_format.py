"""A format of regressed bodies: its base class, and how the formats are found.

A regressor sees a crop, and converts the body's size in it to a distance with a focal
length of its own. For the true camera the distance has to be converted by the ratio of
focal lengths (`parts.refocused`): of the file's, or else of the tool's default, which
each format names in `focal` with the place in the tool's public code.
"""

import abc
import math
from typing import ClassVar

import numpy as np

from bodyslam_jax.io.bodies.parts import Rows, Video, middle, refocused
from bodyslam_jax.io.formats import Format, Source, formats
from bodyslam_jax.types import Intrinsics

GROUP = "bodyslam_jax.body_formats"
"""Entry points of this group are formats of other packages."""
_FOCAL_TOLERANCE = 0.02
"""Relative difference of focal lengths from which there is a warning."""


def diagonal(camera: Intrinsics) -> float:
    """Returns the length of the image's diagonal, px."""
    return math.hypot(camera.width, camera.height)


class BodyFormat(Format):
    """A tool's files of regressed bodies.

    `Source.content` is a dictionary of arrays, from `.npz`, `.npy` or a pickle, which
    `safe_pickle` reads without running what is in it. Positions follow one convention,
    `pelvis = J_0(β) + trans`; for tools with another one, J_0 is approximated by the
    pelvis of the mean body (SMPL's or SMPL-X's). SMPL-X's β have another basis than
    SMPL's and are left out.
    """

    layout: ClassVar[tuple[str, ...] | None] = None
    """Names of the arrays by which `recognises` tells the format from others."""
    by_entry: ClassVar[bool] = False
    """True if each entry of the file, such as a person, is a dictionary of these
    arrays; otherwise the file itself is."""

    def recognises(self, source: Source) -> bool:
        data = source.content
        if self.layout is None or not isinstance(data, dict) or not data:
            return False
        entries = list(data.values()) if self.by_entry else [data]
        wanted = set(self.layout)
        return all(isinstance(e, dict) and wanted <= set(e) for e in entries)

    @abc.abstractmethod
    def read(self, source: Source, video: Video) -> Rows:
        """Returns the bodies of a file that `recognises` accepts.

        **Raises:** `InvalidContent`, or any error that a damaged file causes; the
        caller adds the file's name to it.
        """

    def focal(self, camera: Intrinsics) -> float | None:
        """Returns the focal length (px) that the tool assumes for images of the
        camera's size, where its file has none; `None` for tools that need none."""
        return None

    def refocused(self, trans: np.ndarray, video: Video) -> np.ndarray:
        """Returns positions (m, 3; m) in the video's camera of bodies that the tool
        put in a camera of its default focal length, with the principal point in the
        middle of the image. There is a warning if the video's camera has another
        focal length."""
        focal, actual = self.focal(video.camera), float(video.camera.params[0])
        assert focal is not None, f"{self.name} has no default focal length"
        if abs(focal / actual - 1) > _FOCAL_TOLERANCE:
            video.warn(
                f"bodies of {self.name}: no focal length in the file, its default of "
                f"{focal:.0f} px taken; the camera has {actual:.0f} px, so distances "
                f"are times {actual / focal:.3g}."
            )
        focals = np.full(len(trans), focal)
        return refocused(trans, focals, middle(video.camera), video.camera)


def body_formats() -> list[BodyFormat]:
    """Returns all body formats, of this package and of others."""
    package = "bodyslam_jax.io.bodies.formats"
    # The class is abstract, which a type of classes may not be for the checker.
    return formats(BodyFormat, package, GROUP)  # pyright: ignore
