"""What goes in: one checked description of a video and all that is known about it.

Plain NumPy, no JAX. A `Sequence` is what the readers make and what the pipeline
takes; every array is finite, every index is in range, missing means a flag or a
confidence of zero, never NaN.
"""

import dataclasses
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8


@dataclasses.dataclass(frozen=True)
class Intrinsics:
    """A calibrated camera: OpenCV's model, with pixel (0, 0) a pixel's centre."""

    params: Float[np.ndarray, " i"]
    """`fx fy cx cy` (px), then `k1 k2 p1 p2` if distorted: 4 or 8 numbers."""
    width: int
    height: int
    is_guess: bool = False
    """Whether the focal length was guessed, so that the graph should refine it."""
    focal_sigma: float | None = None
    """Standard deviation of the focal length, px, where somebody who knows it roughly
    gave it: it is refined within that. `None` for a calibration, which is held, and for
    a guess, whose standard deviation is a setting."""

    @property
    def is_refined(self) -> bool:
        """Whether the focal length is a variable of the estimate."""
        return self.is_guess or self.focal_sigma is not None


@dataclasses.dataclass(frozen=True)
class Keypoints:
    """Detected keypoints of `h` people in `t` frames, in BODY_25 order."""

    uv: Float[np.ndarray, "h t 25 2"]
    """Pixels; 0 where there is none."""
    confidence: Float[np.ndarray, "h t 25"]
    """0 is missing; larger is surer. Detectors do not agree on what 1 means."""
    depth: Float[np.ndarray, "h t 25"] | None = None
    """How far behind the middle of the hips a network takes them to be, m; 0 where it
    says nothing. Coarse: it tells which limb is in front."""


@dataclasses.dataclass(frozen=True)
class Bodies:
    """Given bodies of `h` people in the camera frame, per frame."""

    present: Bool[np.ndarray, "h t"]
    poses: Float[np.ndarray, "h t 72"]
    """Axis-angle, rad, root first; the root turns the body into the camera frame."""
    shapes: Float[np.ndarray, "h t 10"]
    """SMPL β."""
    trans: Float[np.ndarray, "h t 3"]
    """m: the pelvis joint is at `J_0(β) + trans` in the camera frame."""
    shapes_regressed: bool = True
    """Whether β is a network's guess, drawn to the mean, not measured or optimised."""


@dataclasses.dataclass(frozen=True)
class Tracks:
    """Static points followed through the video: one row per observation."""

    frame: Int[np.ndarray, " m"]
    landmark: Int[np.ndarray, " m"]
    """Index of the point, 0 to `num_landmarks - 1`."""
    uv: Float[np.ndarray, "m 2"]
    """px"""
    warnings: tuple[str, ...] = ()
    """What was left out while following them."""


@dataclasses.dataclass(frozen=True)
class CameraPath:
    """Camera poses that came with a video."""

    T_WC: Float[np.ndarray, "t 4 4"]
    """Camera to world; identity where not known."""
    known: Bool[np.ndarray, " t"]
    metric: bool
    """Whether translations are in metres; else their unit is arbitrary."""


@dataclasses.dataclass(frozen=True)
class Seen:
    """Everybody whom a detector found in `t` frames, also who is not estimated: `n`
    times somebody. They move, so that nothing of them belongs in the map."""

    frame: Int[np.ndarray, " n"]
    points: Float[np.ndarray, "n 25 3"]
    """BODY_25: u px, v px, confidence."""
    silhouettes: UInt8[np.ndarray, "t y x8"] | None = None
    """Where people are at every fourth pixel of every fourth row, eight bits to a
    byte, as `np.packbits` has them."""


@dataclasses.dataclass(frozen=True)
class MaskUse:
    """How given masks are used, where they are not simply one for each frame."""

    files: tuple[tuple[str, ...], ...]
    """For each frame of the video the names of its masks, which are put together."""
    inverted: bool = False
    """Whether zero is person."""
    with_keypoints: bool = False
    """Whether people's keypoints are masked, too."""


@dataclasses.dataclass(frozen=True)
class Sequence:
    """One input: `t` frames and whatever is known about them."""

    name: str
    frames: Path | None
    """Video file or folder of images; `None` if only tracks are given."""
    timestamps: Float[np.ndarray, " t"]
    """s"""
    intrinsics: Intrinsics
    keypoints: Keypoints | None = None
    bodies: Bodies | None = None
    tracks: Tracks | None = None
    masks: Path | None = None
    """Folder of person masks, one image per frame of the video, whose order they have;
    non-zero is person."""
    mask_use: MaskUse | None = None
    """Where masks are used in another way."""
    picks: Int[np.ndarray, " t"] | None = None
    """Which frames of the video these are, if not all: its rate varied."""
    groundtruth: Path | None = None
    camera_path: CameraPath | None = None
    seen: Seen | None = None
    """All people in the images, for their masks."""
    warnings: tuple[str, ...] = ()
    """What was guessed or dropped while reading, for the report."""

    @property
    def num_frames(self) -> int:
        return len(self.timestamps)

    @property
    def fps(self) -> float:
        """Mean frame rate, 1/s."""
        t = self.timestamps
        return float((len(t) - 1) / (t[-1] - t[0])) if len(t) > 1 else 30.0
