"""What is simulated, and what experiments run on."""

import dataclasses
from typing import Literal


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
    keypoint_errors: float = 1.0
    """Factor on the size of keypoints' errors."""
    body_errors: float = 1.0
    """Factor on errors of regressed postures and orientations that last."""
    body_jitter: float = 1.0
    """Factor on how much these errors change from frame to frame (accelerations)."""
    outliers: float | None = None
    """Share of keypoints that lie somewhere else; without it that of the errors."""
    exchanged: float | None = None
    """Share of frames in which left and right of arms or legs are exchanged; without it
    that of the errors."""
    feet_and_face: bool = True
    """Whether keypoints have BODY_25's feet and face, or the 15 others only."""
    detector_bias: float = 0.0
    """0: keypoints are SMPL's joints; 1: hips, neck and shoulders as COCO has them."""
    people: int = 1
    """Walkers in the scene, 1 to 3; the camera is on the first."""
    hiding: bool = False
    """Whether furniture stands in the way of the camera's view for some of the time."""
    render: bool = False
    """Whether a video is rendered."""
    exposure: float = 0.008
    """Of a rendered image, s; what moves meanwhile is blurred."""
    readout: float = 0.0
    """By how much the last row of a rendered image is later than the first, s."""


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
    """Everything random follows from it and the sequence's name; without it from the
    name alone."""
    motion_models: tuple[str, ...] = ()
    """Other motion models' weights to compare with, such as of models that see more
    past frames or fewer, for `ablation`."""
