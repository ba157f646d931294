"""What the stages hand on: cameras up to scale, and the graph's optimum."""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax.initialisation import ScaleStart
from bodyslam_jax.sequence import Tracks


@dataclasses.dataclass(frozen=True)
class Cameras:
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
    elsewhere: Float[np.ndarray, "l 3 3"]
    """Information on `places` from other sightings, px² per squared unit of the map."""
    places: Float[np.ndarray, "l 3"]
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
class Joint:
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
