"""The data that the stages hand on, from the input to the result. Plain NumPy, no JAX.

Readers make a `Sequence`, structure from motion a `SfmResult`, the joint optimisation a
`JointEstimate`, and the pipeline a `Result`. Every array is finite and every index in
range; what is missing has a flag or a confidence of zero, never NaN.

Frames: W world, C camera (x right, y down, z forward), H body root. `T_WC` maps points
from C to W. Axes: `t` frames, `h` people, `l` landmarks, `m` observations.
"""

import dataclasses
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

DEFAULT_FPS = 30.0
"""Frame rate of inputs that do not tell theirs, 1/s: that of most cameras, and of the
motion model."""


def mean_rate(timestamps: Float[np.ndarray, " t"]) -> float:
    """Returns the mean frame rate, 1/s; `DEFAULT_FPS` for a single frame."""
    if len(timestamps) < 2:
        return DEFAULT_FPS
    return float((len(timestamps) - 1) / (timestamps[-1] - timestamps[0]))


@dataclasses.dataclass(frozen=True)
class Intrinsics:
    """A camera in OpenCV's model; pixel (0, 0) is the centre of the top-left pixel."""

    params: Float[np.ndarray, " i"]
    """`fx fy cx cy` (px), then `k1 k2 p1 p2` if distorted: 4 or 8 numbers."""
    width: int
    """px"""
    height: int
    """px"""
    is_guess: bool = False
    """Whether the focal length was guessed; it is refined then."""
    focal_sigma: float | None = None
    """Standard deviation, px, of a focal length that the user gave; it is refined with
    this as its prior. `None` for a calibration, which is kept constant, and for a
    guess, whose standard deviation is a setting."""

    @property
    def is_refined(self) -> bool:
        """Returns True if the focal length is a variable of the optimisation."""
        return self.is_guess or self.focal_sigma is not None


@dataclasses.dataclass(frozen=True)
class Keypoints:
    """Detected keypoints of `h` people in `t` frames, in BODY_25 order."""

    uv: Float[np.ndarray, "h t 25 2"]
    """px; 0 where the keypoint is missing."""
    confidence: Float[np.ndarray, "h t 25"]
    """0 where the keypoint is missing; else positive. The scale is the detector's."""
    definition: str = "unknown"
    """What the detector calls a hip or a knee: a name in
    `body.KEYPOINT_DEFINITIONS`."""


@dataclasses.dataclass(frozen=True)
class Bodies:
    """Bodies of `h` people that were regressed or given, in each frame's camera."""

    present: Bool[np.ndarray, "h t"]
    """Where there is a body; the other arrays are 0 elsewhere."""
    poses: Float[np.ndarray, "h t 72"]
    """SMPL's joint rotations, axis-angle, rad; the first is `R_CH` of the root."""
    shapes: Float[np.ndarray, "h t 10"]
    """SMPL β."""
    trans: Float[np.ndarray, "h t 3"]
    """m; the pelvis joint is at `J_0(β) + trans` in C."""
    shapes_regressed: bool = True
    """Whether β was regressed by a network, and so is biased towards the mean shape;
    false if it was measured or optimised."""
    gender: str | None = None
    """Gender of the body model that β belongs to, `female`, `male` or `neutral`; `None`
    if the file does not tell, or if people have several."""


@dataclasses.dataclass(frozen=True)
class Tracks:
    """Points of the static scene tracked through the video, one row per observation."""

    frame: Int[np.ndarray, " m"]
    """Index of the frame, 0 to t - 1."""
    landmark: Int[np.ndarray, " m"]
    """Index of the point, 0 to l - 1."""
    uv: Float[np.ndarray, "m 2"]
    """px"""
    warnings: tuple[str, ...] = ()
    """What was left out while tracking, for the report."""


@dataclasses.dataclass(frozen=True)
class PathClock:
    """One reading of the times of a camera path."""

    name: str
    """What the times of the file are, for messages."""
    times: Float[np.ndarray, " n"]
    """Of the poses, s, increasing; on the video's clock up to an offset."""
    is_videos: bool
    """Whether the clock is the video's, so that the offset is 0."""


@dataclasses.dataclass(frozen=True)
class CameraPath:
    """Camera poses that were given with a video."""

    T_WC: Float[np.ndarray, "t 4 4"]
    """Camera to world, in m if `metric`; identity where not known."""
    known: Bool[np.ndarray, " t"]
    """Frames whose pose was given."""
    metric: bool
    """Whether translations are in metres; else their unit is arbitrary."""
    poses: Float[np.ndarray, "n 4 4"] | None = None
    """All poses of the file, as `T_WC`; `None` if their times are settled."""
    clocks: tuple[PathClock, ...] = ()
    """Readings of the times of `poses`, the likeliest first."""


@dataclasses.dataclass(frozen=True)
class DetectedPeople:
    """Everybody whom a detector found, one row per person and frame (`n` rows).

    It includes people who are not estimated: they move, and are kept out of the map.
    """

    frame: Int[np.ndarray, " n"]
    """Index of the frame, 0 to t - 1."""
    keypoints: Float[np.ndarray, "n 25 3"]
    """BODY_25: u px, v px, confidence."""
    silhouettes: UInt8[np.ndarray, "t y x8"] | None = None
    """Masks of people at every fourth pixel of every fourth row, eight pixels to a byte
    (`np.packbits`)."""


@dataclasses.dataclass(frozen=True)
class MaskUse:
    """How a folder of masks is used, if not as one mask per frame."""

    files: tuple[tuple[str, ...], ...]
    """For each frame of the video the names of its masks, whose union is taken."""
    inverted: bool = False
    """Whether zero marks people."""
    with_keypoints: bool = False
    """Whether regions around people's keypoints are masked, too."""


@dataclasses.dataclass(frozen=True)
class Sequence:
    """One input: `t` frames and all measurements in them."""

    name: str
    """Of the folder or file, for messages."""
    frames: Path | None
    """Video file or folder of images; `None` if only tracks are given."""
    timestamps: Float[np.ndarray, " t"]
    """s, increasing."""
    intrinsics: Intrinsics
    """Of all frames."""
    keypoints: Keypoints | None = None
    """Of the people who are estimated, in the order of `bodies`."""
    bodies: Bodies | None = None
    """Given or regressed bodies of the same people."""
    tracks: Tracks | None = None
    """Given point tracks; without them points are tracked in the images."""
    masks: Path | None = None
    """Folder of person masks, one image per frame of the video, in the same order;
    non-zero is person."""
    mask_use: MaskUse | None = None
    """How the masks are used, if in another way."""
    picks: Int[np.ndarray, " t"] | None = None
    """Indices of these frames in the video; `None` if all of it is used."""
    groundtruth: Path | None = None
    """Folder of the true camera and bodies, which the estimate does not use."""
    camera_path: CameraPath | None = None
    """Given camera poses."""
    detected: DetectedPeople | None = None
    """All people in the images, who are kept out of the map."""
    warnings: tuple[str, ...] = ()
    """What was guessed or left out while reading, for the report."""
    contradictions: tuple[str, ...] = ()
    """Parts of the input that contradict each other, a line each, which make the result
    doubtful."""

    @property
    def num_frames(self) -> int:
        return len(self.timestamps)

    @property
    def fps(self) -> float:
        """Mean frame rate, 1/s."""
        return mean_rate(self.timestamps)


@dataclasses.dataclass(frozen=True)
class SfmResult:
    """The reconstruction by structure from motion, after bundle adjustment.

    The unit of its map is arbitrary: *map units* below.
    """

    kind: str
    """Camera motion: `moving`, `rotation` (no parallax), `static` or `failed`."""
    T_WC: Float[np.ndarray, "t 4 4"]
    """Camera to world, map units."""
    registered: Bool[np.ndarray, " t"]
    """Frames whose pose was estimated; the poses of others are interpolated."""
    landmarks: Float[np.ndarray, "l 3"]
    """W, map units."""
    tracks: Tracks
    """Observations of `landmarks`."""
    keep: Bool[np.ndarray, " m"]
    """Inliers among `tracks`."""
    prior_information: Float[np.ndarray, "l 3 3"]
    """Information on `prior_mean`, from observations of the same point that are not in
    `tracks`, px² per squared map unit."""
    prior_mean: Float[np.ndarray, "l 3"]
    """Position of each landmark by all observations of the same point, W, map
    units."""
    pixel_sigma: float
    """Robust standard deviation of the inliers' reprojection errors, px."""
    intrinsics: Float[np.ndarray, " i"]
    """`fx fy cx cy` (px), then `k1 k2 p1 p2` if distorted."""
    focal_sigma: float
    """Standard deviation of an estimated focal length, px; NaN if it was held."""
    costs: tuple[float, float]
    """Cost before and after bundle adjustment."""
    warnings: tuple[str, ...]
    """What was guessed or left out, for the report."""
    path: Float[np.ndarray, "t 4 4"] | None = None
    """Poses T_WC that were given with the video, in the world and unit of the map;
    identity where not known."""
    path_known: Bool[np.ndarray, " t"] | None = None
    """Frames whose pose was given."""
    path_scale: float = float("nan")
    """m per map unit by the given path; NaN if that is not metric."""
    zoom: Float[np.ndarray, " t"] | None = None
    """Logarithm of each frame's focal length relative to that of `intrinsics`, which
    describe the images with the zoom undone; `None` if the camera does not zoom."""
    from_tracks: Float[np.ndarray, "3 2"] | None = None
    """fx, cx and cy of a camera whose focal length was given, as the tracks alone have
    them, and their standard deviations, px; `None` if that was not computed."""
    wander: float = float("nan")
    """How far points of the background move, px, where the camera is said to stand
    still; NaN elsewhere."""

    @property
    def focal(self) -> float:
        """Returns fx, px."""
        return float(self.intrinsics[0])

    @property
    def within(self) -> Bool[np.ndarray, " t"]:
        """Returns the frames from the first to the last registered one; others, such as
        those after a cut, share no points with the map."""
        frames = np.arange(len(self.registered))
        located = np.flatnonzero(self.registered)
        if self.kind == "failed" or not len(located):
            return np.ones(len(frames), bool)
        return (frames >= located[0]) & (frames <= located[-1])


@dataclasses.dataclass(frozen=True)
class ScaleStart:
    """Initial scale s (m per map unit): the mean of its cues, weighted by their inverse
    variances. A cue that is absent is 1 with an infinite standard error."""

    motion: float = 1.0
    """From the motion model's prediction of people's displacement."""
    motion_error: float = float("inf")
    """Standard error of `motion`."""
    ground: float = 1.0
    """From the height of people's feet above the ground plane of the map."""
    ground_error: float = float("inf")
    """Standard error of `ground`."""
    path: float = 1.0
    """From a given camera path in metres."""
    path_error: float = float("inf")
    """Standard error of `path`."""
    climbing: bool = False
    """Whether those who determine `ground` stand at different heights over it."""

    @property
    def _weights(self) -> Float[np.ndarray, " 3"]:
        errors = [self.motion_error, self.ground_error, self.path_error]
        return np.array(errors) ** -2.0

    @property
    def by_climbers(self) -> float:
        """Returns the relative error of `ground` where it is the best cue and of
        people who stand at different heights; else NaN."""
        errors = [self.motion_error / self.motion, self.path_error / self.path]
        error = self.ground_error / self.ground
        return error if self.climbing and error < min(errors) else float("nan")

    def without_motion(self) -> "ScaleStart":
        """Returns the start without the cue of people's motion."""
        return dataclasses.replace(self, motion=1.0, motion_error=float("inf"))

    @property
    def value(self) -> float:
        """Returns s; 1 without any cue, so that the map keeps its own unit."""
        weight = self._weights
        if not weight.any():
            return 1.0
        cues = [self.motion, self.ground, self.path]
        return float(weight @ cues / weight.sum())

    @property
    def standard_error(self) -> float:
        """Returns the standard error of `value`; infinite without any cue."""
        total = self._weights.sum()
        return float(total**-0.5) if total else float("inf")


@dataclasses.dataclass(frozen=True)
class OwnVariable:
    """A variable that a user added to the joint problem, at its optimum."""

    name: str
    value: tuple[float, ...]
    sigma: tuple[float, ...]
    """Standard deviation of each coordinate; NaN if it was not computed."""
    given: tuple[float, ...]
    """The mean of its prior."""
    given_sigma: tuple[float, ...]
    """The standard deviation of its prior; `inf` without one."""


@dataclasses.dataclass(frozen=True)
class OwnFactor:
    """How a factor that a user added to the joint problem fits its optimum."""

    name: str
    """Of its term, as in `Problem.names`."""
    residuals: int
    """Number of whitened residuals that are not missing."""
    cost: float
    """Its share of the negative log-likelihood."""
    rms: float
    """Root mean square of its whitened residuals, those of a robust loss weighed by it:
    1 where its sigmas are right."""


@dataclasses.dataclass(frozen=True)
class JointEstimate:
    """The optimum of the factor graph: cameras, people, landmarks and scale."""

    scale: float
    """m per map unit."""
    start: ScaleStart
    """The initial scale and its cues."""
    scale_sigma: float
    """Standard deviation of `scale`; NaN if it was not computed or not estimated."""
    shape_covariance: Float[np.ndarray, "h 10 10"]
    """Marginal covariance of each person's β; NaN if it was not computed."""
    unobserved: tuple[str, ...]
    """What the measurements do not determine, a line each, for the report."""
    cameras: Float[np.ndarray, "t 4 4"]
    """T_WC, map units."""
    roots: Float[np.ndarray, "h t 4 4"]
    """T_CH of each person's root; the translation is the pelvis joint, m."""
    poses: Float[np.ndarray, "h t 23 3"]
    """Rotations of the joints but the root, axis-angle, rad."""
    shapes: Float[np.ndarray, "h 10"]
    """SMPL β."""
    landmarks: Float[np.ndarray, "l 3"]
    """W, map units."""
    intrinsics: Float[np.ndarray, " i"]
    """`fx fy cx cy` (px), then `k1 k2 p1 p2` if distorted."""
    present: Bool[np.ndarray, "h t"]
    """Frames in which the person is estimated."""
    status: str
    """Of the solver, as in `solver.Solution.status`."""
    stages: tuple[dict, ...]
    """Costs, iterations and durations of each stage, for the summary."""
    contacts: Float[np.ndarray, "h t 4"] | None = None
    """Probability that left toe, left heel, right toe, right heel stand; `None` if it
    was not estimated."""
    on_floor: Bool[np.ndarray, " h"] | None = None
    """People whom the estimate holds on one plane before a camera that does not move;
    `None` where there is no such plane."""
    above_ground: Float[np.ndarray, "h t 3"] | None = None
    """Upward vector, in the world, from the ground to what each person stands on, m;
    `None` if everybody stands on the ground itself."""
    statures: Float[np.ndarray, "h 4"] | None = None
    """Stature that was given, its standard deviation, the stature had it not been
    given, and the standard deviation of that, m; NaN for people of whom none was given.
    `None` where none was, or uncertainty was not computed."""
    own_variables: tuple[OwnVariable, ...] = ()
    own_factors: tuple[OwnFactor, ...] = ()
    """Terms that a user added (`run(..., factors=, variables=)`)."""
    root_covariance: Float[np.ndarray, "h t 3 3"] | None = None
    """Marginal covariance of each pelvis joint in the world, which the first camera
    fixes, m²; 0 where the person is absent. `None` if it was not computed."""


@dataclasses.dataclass(frozen=True)
class Result:
    """An estimate or a ground truth: `t` frames, `h` people, `l` landmarks, in the
    metric world, of an estimate with y up."""

    timestamps: Float[np.ndarray, " t"]
    """s"""
    T_WC: Float[np.ndarray, "t 4 4"]
    """Camera to world, m."""
    scale: float
    """m per unit of the map of structure from motion."""
    intrinsics: Float[np.ndarray, " i"]
    """`fx fy cx cy` (px), then `k1 k2 p1 p2` if distorted."""
    landmarks: Float[np.ndarray, "l 3"]
    """W, m."""
    poses: Float[np.ndarray, "h t 72"]
    """SMPL's joint rotations, axis-angle, rad; the first is `R_WH` of the root."""
    trans: Float[np.ndarray, "h t 3"]
    """m; the pelvis joint is at `J_0(β) + trans` in W."""
    betas: Float[np.ndarray, "h 10"]
    """SMPL β."""
    joints: Float[np.ndarray, "h t 24 3"]
    """W, m."""
    present: Bool[np.ndarray, "h t"]
    """Frames in which the person is known; elsewhere the arrays hold finite fill."""
    summary: dict = dataclasses.field(default_factory=dict)
    """Content of `summary.json`."""
    joint_sigma: Float[np.ndarray, "h t 24"] | None = None
    """Expected error (RMS distance) of each joint within the body, m, larger for limbs
    that were hidden; 0 where the person is absent. `None` for a truth."""
    root_sigma: Float[np.ndarray, "h t 3"] | None = None
    """Standard deviation of each coordinate of the pelvis joint in W, m: of x and z
    relative to the first camera and its heading, of y relative to the floor; 0 where
    the person is absent. `None` for a truth, and where it was not computed or nothing
    determines the scale."""

    @property
    def fps(self) -> float:
        """Mean frame rate, 1/s; 30 for a single frame."""
        return mean_rate(self.timestamps)

    @property
    def located(self) -> Bool[np.ndarray, " t"]:
        """Returns the frames whose camera was estimated: from the first to the last of
        `frames_used` in the summary, if it has them. Other poses are finite fill."""
        frames = np.arange(len(self.timestamps))
        used = self.summary.get("frames_used")
        if not (isinstance(used, list) and len(used) == 2):
            return np.ones(len(frames), bool)
        return (frames >= used[0]) & (frames <= used[1])

    def export(
        self,
        path: Path | str,
        to: str | tuple[str, ...] | None = None,
        up: str = "y",
        person: int | tuple[int, ...] | None = None,
        **more: Any,
    ) -> list[Path]:
        """Writes the result for other programs, in the formats `to` or the one that the
        suffix of `path` names; all options are those of `export.formats.export`."""
        return _use("export")(self, Path(path), to, up, person, **more)

    def view(self, run: Path | str | None = None, **more: Any) -> Any:
        """Shows the result in 3D in a notebook, with images of the video if its run
        folder is given. All options are those of `view.notebook_scene`."""
        return _use("view")(self, None if run is None else Path(run), **more)


def _use(name: str) -> Callable[..., Any]:
    """Returns the function that the package has registered for a method of `Result`.

    The packages that write and show results are above this module, which imports none
    of them.
    """
    return sys.modules[__name__.partition(".")[0]].USES_OF_RESULTS[name]
