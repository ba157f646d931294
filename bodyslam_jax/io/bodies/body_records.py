"""The table of bodies that readers make, and what they need to know of the video."""

import dataclasses
import logging

import numpy as np
from jaxtyping import Float, Int

from bodyslam_jax.config import Association
from bodyslam_jax.io.frame_index import Warn
from bodyslam_jax.types import Intrinsics

_log = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True)
class Rows:
    """`m` bodies in the camera frame, in any order."""

    frame: Int[np.ndarray, " m"]
    person: Int[np.ndarray, " m"]
    """Number of each body's person, in any order."""
    poses: Float[np.ndarray, "m 72"]
    """SMPL's joint rotations, axis-angle, rad; the first is `R_CH` of the root."""
    betas: Float[np.ndarray, "m 10"]
    """SMPL β."""
    trans: Float[np.ndarray, "m 3"]
    """Translation, m: the pelvis is at `J_0(β) + trans`."""
    shapes_regressed: bool = True
    """As in `Bodies`."""


@dataclasses.dataclass(frozen=True)
class Video:
    """The video that a file of bodies is read for."""

    camera: Intrinsics
    num_frames: int | None = None
    """Number of frames; `None` if it is that of the file."""
    fps: float | None = None
    """Frame rate, 1/s; `None` if unknown."""
    times: Float[np.ndarray, " t"] | None = None
    """Time of every frame, s; `None` if unknown."""
    images: tuple[str, ...] = ()
    """Names of the frames, if the video is a folder of images."""
    config: Association = Association()
    warn: Warn = _log.warning

    def frames_in(self, seconds: float) -> int:
        """Returns the number of frames in so many seconds, at least 1; at 30/s if the
        video's rate is not known."""
        return max(1, round(seconds * (self.fps or 30.0)))
