"""Bodies as the readers give them, one row each, in no order; and what they know of
the video that the bodies are in."""

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
    """`m` bodies in the camera frame."""

    frame: Int[np.ndarray, " m"]
    person: Int[np.ndarray, " m"]
    """Any number that is the same for the same person."""
    poses: Float[np.ndarray, "m 72"]
    """Axis-angle, rad, root first."""
    betas: Float[np.ndarray, "m 10"]
    trans: Float[np.ndarray, "m 3"]
    """m: the pelvis is at `J_0(β) + trans`."""
    shapes_regressed: bool = True
    """As in `Bodies`."""


@dataclasses.dataclass(frozen=True)
class Video:
    """What readers of bodies are told of the video."""

    camera: Intrinsics
    num_frames: int | None = None
    """None if only the file can say."""
    fps: float | None = None
    """1/s; None if not known"""
    times: Float[np.ndarray, " t"] | None = None
    """s, of every frame; None if not known"""
    images: tuple[str, ...] = ()
    """Names of the frames, if it is a folder of images."""
    config: Association = Association()
    warn: Warn = _log.warning

    def frames_in(self, seconds: float) -> int:
        """At least 1; by the common rate of 30/s if the video's is not known."""
        return max(1, round(seconds * (self.fps or 30.0)))
