"""Every setting, one frozen class per stage; no JAX here, so that `--help` is quick.

The command line and `config.yaml` are generated from these classes.
"""

import dataclasses
from typing import Literal


@dataclasses.dataclass(frozen=True)
class GraphWeights:
    """What each measurement is trusted to: standard deviations, and losses in them.

    The defaults are inverse covariances of what is measured, with errors that last
    taken for what they are. `GraphWeights.paper()` has the paper's λ's.
    """

    pixel_sigma: float = 1.0
    """Static points, px."""
    landmark_loss: float = 1.5
    """Cauchy scale, in `pixel_sigma`."""
    keypoint_sigma: float | None = None
    """Keypoints of confidence 1, px; divided by the confidence. Without it, the
    detector's usual error in metres of the body, as it appears at its distance."""
    keypoint_inflation: float = 3.0
    """Factor on the detector's usual error at 30 fps; grows with the root of the frame
    rate. Errors last for about 0.15 s: taken for independent, keypoints stretch the
    body by some per cent."""
    keypoint_loss: float = 3.0
    """Geman-McClure scale, in `keypoint_sigma` (Bogo et al.: 100 px)."""
    motion_inflation: float = 1.0
    """Factor on the motion model's own standard deviation, 1."""
    step_error: float = 0.05
    """Error that all of a person's steps share, as a share of them: people differ, and
    postures are wrong for seconds. Without it steps would outvote the body's size."""
    fitted_step_error: float = 0.25
    """The same where bodies are fitted to keypoints: one view hardly shows legs that
    swing towards it, and steps come out short."""
    motion_sigma: float | None = None
    """Instead of the motion model's own covariance, m a frame."""
    motion_correlation: float = 0.8
    """Of the motion model's errors in successive frames."""
    posture_sigma: float = 0.18
    """Regressed joint rotations, stationary, rad per axis."""
    posture_correlation: float = 0.96
    """Of their errors in successive frames at 30 fps."""
    posture_predicted: bool = False
    """Whether postures are held to the motion model's prediction instead."""
    shape_sigma: float = 0.4
    """Regressed β; one measurement a person, as the regressor errs alike in all."""
    shape_each_frame: bool = False
    """Whether each frame counts as a measurement of β of its own."""
    orientation_sigma: float | None = None
    """Predicted turns of the person, rad a frame; none without it."""
    root_sigma: float | None = 0.12
    """Regressed orientation, stationary, rad per axis; not used without it."""
    root_correlation: float = 0.96
    """Of its errors in successive frames at 30 fps."""
    root_direction: float = 0.015
    """Regressed place of the person across the line of sight, of the distance; used
    where there are no keypoints. Errors last as those of orientation do."""
    root_depth: float = 0.07
    """The same along the line of sight."""
    root_turning: float | None = 0.015
    """Change of the person's turning in a frame of 1/30 s, rad; free without it."""
    root_smoothness: float | None = 0.02
    """Change of the pelvis' step in a frame of 1/30 s, m; free without it. Real ones
    are of 0.006 m; held to that, a camera that goes with the person would be thought to
    move less, and the world to be smaller."""
    ground_sigma: float | None = 0.04
    """How far the map's ground may be from what people stand on, m: one error for the
    whole sequence. Without it, people need not stand on anything."""

    @classmethod
    def paper(cls) -> "GraphWeights":
        """λ_lm = 64/b² with b = 2.25 px, λ_mm = 100, λ_posture = λ_shape = 1.

        Its joint weight is read as confidence squared (SMPLify), in px^-2; the scale
        of its Cauchy loss is not stated.
        """
        return cls(
            pixel_sigma=2.25 / 8,
            landmark_loss=1.0,
            keypoint_sigma=1.0,
            keypoint_loss=100.0,
            step_error=0.0,
            fitted_step_error=0.0,
            motion_sigma=0.1,
            motion_correlation=0.0,
            posture_sigma=1.0,
            posture_correlation=0.0,
            posture_predicted=True,
            shape_sigma=1.0,
            shape_each_frame=True,
            root_sigma=None,
            root_turning=None,
            root_smoothness=None,
            ground_sigma=None,
        )


@dataclasses.dataclass(frozen=True)
class PeopleFit:
    """Bodies from keypoints, and the cleaning of bodies that a regressor gave."""

    min_keypoints: int = 6
    """Keypoints that a frame must have for its body to be fitted."""
    max_gap: float = 0.3
    """Gaps up to this long are filled from the frames around them, s."""
    start_interval: float = 0.1
    """Distance of the frames that are fitted from many starts, s."""
    max_steps: int = 30
    """Gauss-Newton steps over all frames at most."""
    robust_scale: float = 4.0
    """Scale of the robust loss on keypoints, in their standard deviations."""
    correlation_time: float = 0.15
    """Keypoint errors stay the same for about this long, s."""
    detector_bias: float = 0.0
    """0: keypoints are SMPL's joints; 1: hips, neck and shoulders as COCO has them."""
    limit_sigma: float = 0.05
    """Softness of the joints' limits, rad."""
    upright_sigma: float = 0.4
    """How far bodies lean towards or from the camera, sine of the angle."""
    shape_frames: float = 3.0
    """Frames' worth of evidence on shape in a whole clip: keypoint bias is the same in
    all frames, so they do not add up."""
    motion_scale: float = 2.0
    """How much less predictable than in the motion data people move."""
    depth_jitter: float = 0.005
    """Change of the depth's change from frame to frame at 30 fps, m."""
    position_jitter: float = 0.015
    """The same across the line of sight, m; a shaking camera is in it."""
    turn_jitter: float = 0.03
    """The same for the orientation, rad."""
    depth_error: float = 0.05
    """Error of a regressor's depth, as a share of it."""
    regressor_shape_gain: float | None = None
    """Factor on the β of given bodies, whatever their source. Without it 1.2 for a
    regressor's, which are drawn to the mean, and 1 where β was measured or optimised
    (AMASS, SLAHMR, or `bodies.npz` that says so by `shapes_regressed`)."""


@dataclasses.dataclass(frozen=True)
class MotionTraining:
    """How a motion model is trained; `MotionTraining.paper()` is section 3.4."""

    network: Literal["metric", "paper"] = "metric"
    """Metric joint positions over a window, or the paper's network on joint angles."""
    past: int = 16
    """Frames before the predicted one that a window holds."""
    future: int = 1
    """1 if displacement may depend on the posture of the frame it leads to, else 0."""
    width: tuple[int, ...] = (320, 256, 256)
    """Units of the hidden layers."""
    members: int = 1
    """Networks of which displacement is the mean."""
    seed: int = 0
    """Initial weights and every random choice follow from it."""
    epochs: int = 80
    """Each has as many windows as the data have 120 Hz starting points."""
    validate_every: int = 1
    """Epochs from one look at the validation subjects to the next."""
    segments: int = 128
    """Segments in a batch; each is of another person, speed and noise level."""
    steps: int = 16
    """Successive windows of a segment."""
    learning_rate: float = 1.5e-3
    """Adam's at the start; falls to nothing along a cosine if `decay`."""
    decay: bool = True
    """Whether the learning rate falls."""
    weight_decay: float = 1e-4
    """AdamW's."""
    clip: float | None = 1.0
    """Largest entry of a gradient; not limited without it."""
    averaging: float = 0.998
    """Share that the running mean of weights, which is kept, has of itself; 0: none."""
    slope_weight: float = 2.0
    """Penalty on the squared bias of displacement per noise level: bias is scale."""
    segment_weight: float = 0.5
    """Penalty on the mean error over a segment, beside that of single steps."""
    drift_deg: float = 10.0
    """Largest standard deviation of the slow error of joint angles, degrees."""
    white_deg: float = 0.6
    """Largest standard deviation of the white error of joint angles, degrees."""
    root_drift: float = 1.0
    """Largest error of the root's rotation as a share of the joints'."""
    clean_share: float = 0.3
    """Share of segments without slow errors."""
    shape_sigma: float = 1.0
    """Standard deviation of each component of β."""
    strides: tuple[int, ...] = (3, 4, 4, 4, 5)
    """Steps through 120 Hz data, one drawn per segment: 4 is real speed."""
    run_weight: float = 2.0
    """How often a window of running is drawn beside one of walking: runs are few."""
    other_weight: float = 0.15
    """The same for all other motion, most of which is slow; 0 leaves it out."""
    mirror: bool = True
    """Whether half of the segments are mirrored."""
    sliding: bool = True
    """Whether windows may overlap; the paper's do not."""

    @staticmethod
    def paper() -> "MotionTraining":
        """Section 3.4 of the paper: two frames of exact joint angles, plain Adam."""
        return MotionTraining(
            network="paper",
            past=2,
            width=(1024,),
            epochs=100,
            learning_rate=1e-3,
            segments=4096,
            steps=1,
            decay=False,
            weight_decay=0.0,
            clip=None,
            averaging=0.0,
            drift_deg=0.0,
            white_deg=0.0,
            root_drift=0.0,
            clean_share=0.0,
            strides=(4,),
            run_weight=1.0,
            other_weight=0.0,
            mirror=False,
            sliding=False,
        )


@dataclasses.dataclass(frozen=True)
class Detect:
    """Finding people and keypoints in the images, for who has no keypoints."""

    detector: str | None = None
    """YOLOX of one's own, an ONNX file; by default YOLOX-S, fetched once."""
    pose: str | None = None
    """RTMPose of one's own, an ONNX file; by default DWPose-L 384x288, fetched once."""
    min_score: float = 0.5
    """Score of people that are looked at."""
    max_overlap: float = 0.45
    """Overlap of two boxes above which they are the same person."""
    max_people: int = 4
    """The largest ones in an image that are looked at."""


@dataclasses.dataclass(frozen=True)
class Association:
    """Which detections in successive frames are the same person."""

    max_people: int = 8
    """People kept, those that fill most of the video first."""
    min_duration: float = 0.4
    """Time that a person must be seen for, s."""
    max_gap: float = 0.7
    """Time that a person may be unseen and still be recognised, s."""


@dataclasses.dataclass(frozen=True)
class Tracking:
    """Points followed through the video (BRISK, KLT, RANSAC)."""

    num_points: int = 200
    """Points followed at any time."""
    threshold: int = 20
    """BRISK's smallest contrast of a corner, grey levels."""
    octaves: int = 3
    """BRISK's pyramid, octaves."""
    cells: int = 8
    """Cells along the longer side of the image, over which points are spread."""
    window: int = 21
    """Side of the window that is followed, px."""
    max_epipolar: float = 1.5
    """Distance from the epipolar line beyond which a point is dropped, px."""
    keyframe_gap: int = 10
    """Frames over which a point must fit one rigid motion."""
    person_margin: float = 0.06
    """Width added around people's keypoints, of the person's height."""


@dataclasses.dataclass(frozen=True)
class Structure:
    """Cameras and map up to scale, from tracks (structure from motion)."""

    max_error: float = 2.0
    """Reprojection error beyond which an observation is an outlier, px."""
    min_angle: float = 0.5
    """Smallest angle between the rays of a point, degrees; less is tried where cameras
    cannot be located with it."""
    max_first_pairs: int = 4
    """Pairs of frames that are tried for the start."""
    keyframe_motion: float = 0.03
    """Motion of points between keyframes, of the image's longer side."""
    static_motion: float = 0.6
    """Motion of points below which the camera stands still, px."""
    rotation_error: float = 1.0
    """Error of a pure rotation below which there is no parallax to use, px."""
    min_baseline: float = 0.08
    """Extent of the path below which a camera only turns, of the distance of points."""
    join_tracks: bool = True
    """Whether tracks that turn out to be of one point become one landmark."""
    landmark_span: int = 90
    """Frames that a landmark of the graph may span: longer tracks are several. A step
    of the solver costs as much as the square of that."""
    min_shared: int = 12
    """Points that two successive frames must share, or there is a cut."""
    focal_sigma: float = 0.2
    """How wrong a guessed focal length may be: standard deviation, of the guess."""
    focal_accuracy: float = 0.08
    """Standard deviation, of the focal length, above which the guess is kept."""
    focal_runs: float = 30.0
    """Observations of a track that count for one, as its errors last."""


@dataclasses.dataclass(frozen=True)
class Simulation:
    """A simulated sequence: who walks where, who films it, what is measured."""

    sequence: Literal["E1", "E2", "E3", "M1", "M2", "M3", "M4", "D1", "D2", "D3"] = "M2"
    """Easy, medium or difficult: how fast the camera moves, turns and shakes."""
    family: Literal["room", "follow"] = "room"
    """The camera stays within about a metre and turns, or it goes with the person."""
    length: int | None = None
    """Frames at 30 fps; without it the sequence's own, 600 to 1000."""
    seed: int | None = None
    """Everything random follows from it; without it the sequence's own."""
    motion: str | None = None
    """Motion to walk with (CMU archive, AMASS, BVH); without it the clips that ship."""
    noise: Literal["none", "low", "real"] = "real"
    """Errors of all measurements, unless set apart below."""
    keypoint_noise: Literal["none", "low", "real"] | None = None
    """Errors of the keypoints."""
    body_noise: Literal["none", "low", "real"] | None = None
    """Errors of the regressed bodies."""
    track_noise: Literal["none", "low", "real"] | None = None
    """Errors of the tracked points."""
    feet_and_face: bool = True
    """Whether keypoints have BODY_25's feet and face, or the 15 others only."""
    detector_bias: float = 0.0
    """0: keypoints are SMPL's joints; 1: hips, neck and shoulders as COCO has them."""
    render: bool = False
    """Whether a video is rendered."""


@dataclasses.dataclass(frozen=True)
class Config:
    """Settings of a whole run, one class per stage."""

    body_model: str | None = None
    """Body model file or folder; without it the default body or the one found."""
    motion_model: str | None = None
    """Motion model's weights; without them the ones that ship."""
    people: bool = True
    """Whether people are estimated; if not, cameras and map stay without a unit."""
    detect: bool = False
    """Whether people's keypoints are looked for in the images, if none are given."""
    offline: bool = False
    """Whether the network is never used: models must be there already."""
    overlay: bool = True
    """Whether `overlay.webm` is written."""
    uncertainty: bool = True
    """Whether standard deviations, and what is not determined, are worked out."""
    detection: Detect = Detect()
    association: Association = Association()
    tracking: Tracking = Tracking()
    structure: Structure = Structure()
    people_fit: PeopleFit = PeopleFit()
    weights: GraphWeights = GraphWeights()
    solver: Literal["structured", "adam"] = "structured"
    """Second order, or the paper's 200 + 100 first-order steps."""
    motion_coupling: Literal["frozen", "refreshed", "displacement", "full"] = (
        "refreshed"
    )
    """How predicted motion follows the estimate: made once; anew after each step; or
    with its derivative too, of displacements or of all that is predicted."""
    smoothing_hz: float | None = 6.0
    """People's motion faster than this is taken for noise in the result, Hz; nothing
    is smoothed without it."""

    @classmethod
    def paper(cls) -> "Config":
        """Weights and schedule of section 3.6 of the paper."""
        return cls(
            weights=GraphWeights.paper(),
            people_fit=PeopleFit(regressor_shape_gain=1.0),
            solver="adam",
            smoothing_hz=None,
        )


@dataclasses.dataclass(frozen=True)
class Experiment:
    """What an experiment runs on; its own choice where nothing is said."""

    sequences: tuple[
        Literal["E1", "E2", "E3", "M1", "M2", "M3", "M4", "D1", "D2", "D3"], ...
    ] = ()
    """Simulated sequences; without them the experiment's own."""
    family: Literal["room", "follow", "both"] | None = None
    """Of the simulated sequences; without it the experiment's own."""
    frames: int | None = None
    """Frames of each at 30 fps; without it the sequence's own, 600 to 1000."""
    noise: Literal["none", "low", "real"] = "real"
    """Errors of all measurements."""
    motion: str | None = None
    """Motion to walk with (CMU archive, AMASS, BVH); without it the clips that ship."""
    seed: int | None = None
    """Everything random follows from it; without it the sequence's own."""
    motion_models: tuple[str, ...] = ()
    """Other motion models' weights to compare with, for `ablation`."""
