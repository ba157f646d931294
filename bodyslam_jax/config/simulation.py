"""Settings of simulated sequences and of experiments."""

import dataclasses
from typing import Literal


@dataclasses.dataclass(frozen=True)
class Simulation:
    """A simulated sequence: walkers, camera and measurements."""

    sequence: Literal["E1", "E2", "E3", "M1", "M2", "M3", "M4", "D1", "D2", "D3"] = "M2"
    """Name of the sequence: easy (E), medium (M) or difficult (D), by camera speed."""
    family: Literal["room", "follow"] = "room"
    """`room`: the camera stays within about a metre and turns; `follow`: it follows the
    person."""
    length: int | None = None
    """Number of frames at 30 fps. Without it, that of the sequence, 600 to 1000."""
    seed: int | None = None
    """Random seed. Without it, that of the sequence."""
    motion: str | None = None
    """Motion data that the walkers use (CMU archive, AMASS, BVH). Without it, the clips
    of the package. `other`: recordings of the package in which the first person does
    something else than walk."""
    noise: Literal["none", "low", "real"] = "real"
    """Level of errors of all measurements, unless set individually below."""
    keypoint_noise: Literal["none", "low", "real"] | None = None
    """Errors of the keypoints."""
    body_noise: Literal["none", "low", "real"] | None = None
    """Errors of the regressed bodies."""
    track_noise: Literal["none", "low", "real"] | None = None
    """Errors of the tracked points."""
    keypoint_errors: float = 1.0
    """Factor on the size of keypoint errors."""
    body_errors: float = 1.0
    """Factor on the correlated errors of regressed postures and orientations."""
    body_jitter: float = 1.0
    """Factor on the frame-to-frame change of these errors (accelerations)."""
    outliers: float | None = None
    """Share of keypoints that are outliers, 0 to 1. Without it, that of the noise
    level."""
    exchanged: float | None = None
    """Share of frames in which left and right of arms or legs are exchanged, 0 to 1.
    Without it, that of the noise level."""
    feet_and_face: bool = True
    """Whether keypoints include the feet and face of BODY_25, beside the other 15."""
    detector_bias: float = 0.0
    """0: keypoints are SMPL's joints; 1: hips, neck and shoulders as defined by
    COCO."""
    people: int = 1
    """Number of walkers, 1 to 3; the camera films the first."""
    hiding: bool = False
    """Whether furniture occludes the camera's view for some of the time."""
    render: bool = False
    """Whether a video is rendered."""
    exposure: float = 0.008
    """Exposure time of a rendered image, s, which gives motion blur."""
    readout: float = 0.0
    """Delay of the last row of a rendered image after the first, s (rolling
    shutter)."""


@dataclasses.dataclass(frozen=True)
class Experiment:
    """Data that an experiment runs on."""

    sequences: tuple[
        Literal["E1", "E2", "E3", "M1", "M2", "M3", "M4", "D1", "D2", "D3"], ...
    ] = ()
    """Simulated sequences. Without them, those of the experiment."""
    family: Literal["room", "follow", "both"] | None = None
    """Family of the simulated sequences. Without it, that of the experiment."""
    frames: int | None = None
    """Number of frames of each sequence at 30 fps. Without it, that of the sequence,
    600 to 1000."""
    noise: Literal["none", "low", "real"] = "real"
    """Errors of all measurements."""
    motion: str | None = None
    """Motion data that walkers use (CMU archive, AMASS, BVH). Without it, the clips of
    the package. `other`: recordings of the package in which the first person does
    something else than walk; sits, climbs, jumps, dribbles, waves, and the like."""
    seed: int | None = None
    """Random seed, combined with the sequence's name. Without it, the name alone."""
    motion_models: tuple[str, ...] = ()
    """Weights of other motion models that `ablation` compares, such as models with more
    or fewer past frames."""
