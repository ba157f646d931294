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


@dataclasses.dataclass(frozen=True)
class SfmResult:
    """The up-to-scale reconstruction after bundle adjustment."""

    kind: str
    """`moving`, `rotation` (no parallax) or `static`."""
    T_WC: Float[np.ndarray, "t 4 4"]
    registered: Bool[np.ndarray, " t"]
    """Frames that were located; the poses of others are filled in."""
    landmarks: Float[np.ndarray, "l 3"]
    tracks: Tracks
    """Observations of `landmarks`."""
    keep: Bool[np.ndarray, " m"]
    """Observations that fit."""
    prior_information: Float[np.ndarray, "l 3 3"]
    """Information on `prior_mean` from other sightings, px² per squared unit of the
    map."""
    prior_mean: Float[np.ndarray, "l 3"]
    """Where all sightings of the same point place each landmark."""
    pixel_sigma: float
    """Robust standard deviation of those, px."""
    intrinsics: Float[np.ndarray, " i"]
    focal_sigma: float
    """Standard deviation of a focal length that was found, px; NaN if it was not."""
    costs: tuple[float, float]
    """Before and after bundle adjustment."""
    warnings: tuple[str, ...]
    path: Float[np.ndarray, "t 4 4"] | None = None
    """Poses T_WC that were given with the video, in the map's unit and world; identity
    where not known."""
    path_known: Bool[np.ndarray, " t"] | None = None
    path_scale: float = float("nan")
    """m per unit of the map, as that path has it; NaN if it is not metric."""
    zoom: Float[np.ndarray, " t"] | None = None
    """Logarithm of each frame's focal length over that of `intrinsics`, which is that
    of the images with the zoom undone; None where the camera does not zoom."""

    @property
    def focal(self) -> float:
        """px"""
        return float(self.intrinsics[0])

    @property
    def within(self) -> Bool[np.ndarray, " t"]:
        """Frames of the shot that was looked at, from the first that is located to the
        last. Nothing ties others, as beyond a cut, to it."""
        frames = np.arange(len(self.registered))
        located = np.flatnonzero(self.registered)
        if self.kind == "failed" or not len(located):
            return np.ones(len(frames), bool)
        return (frames >= located[0]) & (frames <= located[-1])


@dataclasses.dataclass(frozen=True)
class ScaleStart:
    """The first guess of s, in closed form: its cues, weighted by their errors."""

    motion: float = 1.0
    """From how people move; 1 if that says nothing."""
    motion_error: float = float("inf")
    """Its standard error; infinite if people's motion says nothing."""
    ground: float = 1.0
    """From where they stand on the map's ground."""
    ground_error: float = float("inf")
    """Its standard error; infinite if no ground is seen under the feet."""
    path: float = 1.0
    """From a camera path that is known in metres."""
    path_error: float = float("inf")
    """Its standard error; infinite without one."""

    @property
    def _weights(self) -> Float[np.ndarray, " 3"]:
        errors = [self.motion_error, self.ground_error, self.path_error]
        return np.array(errors) ** -2.0

    def without_motion(self) -> "ScaleStart":
        """The same without the cue of people's motion."""
        return dataclasses.replace(self, motion=1.0, motion_error=float("inf"))

    @property
    def value(self) -> float:
        """s; 1 if no cue says anything, so that the map stays in its own unit."""
        weight = self._weights
        if not weight.any():
            return 1.0
        cues = [self.motion, self.ground, self.path]
        return float(weight @ cues / weight.sum())

    @property
    def standard_error(self) -> float:
        """Infinite if no cue says anything."""
        total = self._weights.sum()
        return float(total**-0.5) if total else float("inf")


@dataclasses.dataclass(frozen=True)
class JointEstimate:
    """The graph's optimum."""

    scale: float
    start: ScaleStart
    """What motion and ground said of the scale by themselves."""
    scale_sigma: float
    """Standard deviation of `scale`; NaN if it was not computed or not estimated."""
    shape_covariance: Float[np.ndarray, "h 10 10"]
    unobserved: tuple[str, ...]
    """What the measurements do not determine, a line each."""
    cameras: Float[np.ndarray, "t 4 4"]
    roots: Float[np.ndarray, "h t 4 4"]
    poses: Float[np.ndarray, "h t 23 3"]
    shapes: Float[np.ndarray, "h 10"]
    landmarks: Float[np.ndarray, "l 3"]
    intrinsics: Float[np.ndarray, " i"]
    present: Bool[np.ndarray, "h t"]
    status: str
    stages: tuple[dict, ...]


@dataclasses.dataclass(frozen=True)
class Result:
    """An estimate (or a ground truth) for `t` frames, `h` people, `l` landmarks."""

    timestamps: Float[np.ndarray, " t"]
    """s"""
    T_WC: Float[np.ndarray, "t 4 4"]
    """Camera to world, m."""
    scale: float
    """Metres per unit of the up-to-scale reconstruction."""
    intrinsics: Float[np.ndarray, " i"]
    """`fx fy cx cy` px, then `k1 k2 p1 p2` if distorted."""
    landmarks: Float[np.ndarray, "l 3"]
    """m, world."""
    poses: Float[np.ndarray, "h t 72"]
    """Axis-angle, rad; the root turns the body into the world frame."""
    trans: Float[np.ndarray, "h t 3"]
    """m: pelvis joint minus `J_0(β)`."""
    betas: Float[np.ndarray, "h 10"]
    joints: Float[np.ndarray, "h t 24 3"]
    """m, world."""
    present: Bool[np.ndarray, "h t"]
    """Whether the person is there; rows where not are finite fill, not estimates."""
    summary: dict = dataclasses.field(default_factory=dict)
    """What goes to `summary.json`."""

    @property
    def located(self) -> Bool[np.ndarray, " t"]:
        """Frames whose camera is an estimate: `frames_used` of the summary, first and
        last, if it says so. Beyond a cut poses are finite fill."""
        frames = np.arange(len(self.timestamps))
        used = self.summary.get("frames_used")
        if not (isinstance(used, list) and len(used) == 2):
            return np.ones(len(frames), bool)
        return (frames >= used[0]) & (frames <= used[1])
