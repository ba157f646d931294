"""Resamples results to other timestamps: positions linearly, rotations on the
geodesic.

`pad_frames` pads trajectories to equal shapes, so that they share compiled programs and
can be stacked. Padding is masked: errors equal those of the unpadded trajectories up to
rounding.
"""

import dataclasses
from typing import Any, Literal

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.evaluation.errors import Trajectories
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.types import DEFAULT_FPS, Result

_MAX_FILLED_FRAMES = 101
"""Number of steps that a gap in the timestamps is divided into at most."""
_TIMESTAMP_ROUNDING_FRAMES = 1e-3
"""Rounding of timestamps in files, in frame intervals."""
_MIN_BUCKET_FRAMES = 64
_BUCKET_GROWTH_FACTOR = 4


@dataclasses.dataclass(frozen=True)
class Samples:
    """Cameras and people of an estimate or a truth at `t` times, as NumPy arrays."""

    T_WC: Float[np.ndarray, "t 4 4"]
    """Camera to world, m."""
    camera_valid: Bool[np.ndarray, " t"]
    joints: Float[np.ndarray, "h t 24 3"]
    """Joints, m, world frame."""
    present: Bool[np.ndarray, "h t"]
    feet: Float[np.ndarray, "h t f 3"]
    """Points of the feet, m, world frame."""
    available: Bool[np.ndarray, " t"]
    """Times at which there was a frame, or two to interpolate between."""

    def cut(self, frames: slice, people: list[int] | None = None) -> "Samples":
        """Returns a range of frames, and, if given, some people in that order."""
        everybody = list(range(len(self.present)))
        who = everybody if people is None else people
        return Samples(
            self.T_WC[frames],
            self.camera_valid[frames],
            self.joints[who][:, frames],
            self.present[who][:, frames],
            self.feet[who][:, frames],
            self.available[frames],
        )

    def trajectories(self, fps: float, num_frames: int | None = None) -> Trajectories:
        """Returns the samples as JAX arrays, padded with masked frames up to
        `num_frames`; `fps` is in 1/s."""
        arrays = (self.T_WC, self.camera_valid, self.joints, self.present, self.feet)
        if num_frames is not None:
            arrays = padded_frames(arrays, num_frames)
        T_WC, camera_valid, joints, present, feet = map(jnp.asarray, arrays)
        return Trajectories(T_WC, camera_valid, joints, present, feet, jnp.asarray(fps))


def samples_of(result: Result, feet: Float[np.ndarray, "h t f 3"]) -> Samples:
    """Returns a result at its own timestamps, with the given points of the feet (m)."""
    has_camera = bool(result.summary.get("has_camera", True))
    every = np.ones(len(result.timestamps), bool)
    camera = result.located & has_camera
    return Samples(result.T_WC, camera, result.joints, result.present, feet, every)


def interval_of(times: Float[np.ndarray, " t"]) -> float:
    """Returns the median time between frames, s; 1/30 for a single frame."""
    return float(np.median(np.diff(times))) if len(times) > 1 else 1 / DEFAULT_FPS


def without_holes(times: Float[np.ndarray, " t"]) -> Float[np.ndarray, " u"]:
    """Returns the timestamps (s), with times added where frames are missing, at most
    100 per gap.

    The added frames are masked, so that no difference is taken across a gap.
    """
    interval = interval_of(times)
    count = lambda gap: min(max(round(gap / interval), 1), _MAX_FILLED_FRAMES)
    filled = [
        np.linspace(a, b, count(b - a), endpoint=False)
        for a, b in zip(times[:-1], times[1:], strict=True)
    ]
    return np.concatenate([*filled, times[-1:]])


@dataclasses.dataclass(frozen=True)
class Brackets:
    """The two frames that enclose each of `u` times."""

    before: Int[np.ndarray, " u"]
    after: Int[np.ndarray, " u"]
    weight: Float[np.ndarray, " u"]
    """Weight of `after`, 0 to 1. It is strictly between 0 and 1 only where frames are
    interpolated, which is never across a gap of more than one and a half frames."""
    available: Bool[np.ndarray, " u"]
    """Whether there are frames to interpolate, or one within half a frame."""


def bracket(times: Float[np.ndarray, " t"], at: Float[np.ndarray, " u"]) -> Brackets:
    """Finds the frames (at `times`, s) that enclose each time of `at` (s)."""
    interval = interval_of(times)
    after = np.clip(np.searchsorted(times, at), min(1, len(times) - 1), len(times) - 1)
    before = np.maximum(after - 1, 0)
    gap = np.maximum(times[after] - times[before], 1e-12)
    weight = np.clip((at - times[before]) / gap, 0, 1)
    nearest = np.round(weight)
    blend = (abs(weight - nearest) > _TIMESTAMP_ROUNDING_FRAMES) & (
        gap <= 1.5 * interval
    )
    distance = np.minimum(abs(at - times[before]), abs(at - times[after]))
    # Half an interval, and rounding.
    available = blend | (distance <= 0.5001 * interval)
    return Brackets(before, after, np.where(blend, weight, nearest), available)


def interpolate_poses(
    T: Float[np.ndarray, "t 4 4"], between: Brackets
) -> Float[np.ndarray, "u 4 4"]:
    """Interpolates poses between frames: centres linearly, rotations on the
    geodesic."""
    weight = between.weight
    w = weight[:, None, None]
    found = (1 - w) * T[between.before] + w * T[between.after]
    # Values that are not finite stay NaN.
    blend = (weight > 0) & (weight < 1) & np.isfinite(found).all(axis=(1, 2))
    if blend.any():
        rotation = T[:, :3, :3]
        start, end = rotation[between.before[blend]], rotation[between.after[blend]]
        found[blend, :3, :3] = so3.interpolate(start, end, weight[blend])
    return found


def resample(
    samples: Samples, times: Float[np.ndarray, " t"], at: Float[np.ndarray, " u"]
) -> Samples:
    """Returns the samples, given at `times` (s), at the times `at` (s).

    **Raises:** `InputError` if there is no frame.
    """
    if not len(times):
        raise InputError("A result without frames cannot be evaluated.")
    between = bracket(times, at)
    before, after, weight = between.before, between.after, between.weight

    def positions(x: np.ndarray) -> np.ndarray:
        w = weight[:, None, None]
        return (1 - w) * x[:, before] + w * x[:, after]

    def flags(x: np.ndarray) -> np.ndarray:
        both = (x[..., before] | (weight == 1)) & (x[..., after] | (weight == 0))
        return both & between.available

    return Samples(
        interpolate_poses(samples.T_WC, between),
        flags(samples.camera_valid),
        positions(samples.joints),
        flags(samples.present),
        positions(samples.feet),
        between.available,
    )


def bucket(num_frames: int) -> int:
    """Returns the length to pad to: 64, 256, 1024, ...

    Compiling takes seconds, evaluating masked frames milliseconds: hence few buckets.
    """
    size = _MIN_BUCKET_FRAMES
    while size < num_frames:
        size *= _BUCKET_GROWTH_FACTOR
    return size


def pad_frames(trajectories: Trajectories, num_frames: int) -> Trajectories:
    """Returns the trajectories with masked frames appended, up to `num_frames`."""
    t = trajectories
    if num_frames == t.T_WC.shape[0]:
        return t
    T_WC, camera_valid, joints, present, feet = map(
        jnp.asarray,
        padded_frames(
            (t.T_WC, t.camera_valid, t.joints, t.present, t.feet), num_frames
        ),
    )
    return Trajectories(T_WC, camera_valid, joints, present, feet, t.fps)


def padded_frames(arrays: tuple[Any, ...], num_frames: int) -> tuple[Any, ...]:
    """Returns the arrays of `Trajectories`, `T_WC` to `feet`, with masked frames
    appended."""
    T_WC, camera_valid, joints, present, feet = arrays
    missing = num_frames - len(T_WC)
    return (
        _pad(T_WC, 0, missing, "edge"),
        _pad(camera_valid, 0, missing),
        _pad(joints, 1, missing, "edge"),
        _pad(present, 1, missing),
        _pad(feet, 1, missing, "edge"),
    )


def pad_people(trajectories: Trajectories, num_people: int) -> Trajectories:
    """Returns the trajectories with people appended who are never present, up to
    `num_people`.

    The errors of these are NaN, and means over people leave them out.
    """
    missing = num_people - trajectories.present.shape[0]
    if not missing:
        return trajectories
    return Trajectories(
        trajectories.T_WC,
        trajectories.camera_valid,
        jnp.asarray(_pad(trajectories.joints, 0, missing)),
        jnp.asarray(_pad(trajectories.present, 0, missing)),
        jnp.asarray(_pad(trajectories.feet, 0, missing)),
        trajectories.fps,
    )


def to_bucket(trajectories: Trajectories) -> Trajectories:
    """Returns the trajectories padded by `pad_frames` to the length `bucket`."""
    return pad_frames(trajectories, bucket(trajectories.T_WC.shape[0]))


def _pad(
    x: Any, axis: int, missing: int, mode: Literal["constant", "edge"] = "constant"
) -> Any:
    widths = [(0, missing * (i == axis)) for i in range(x.ndim)]
    if isinstance(x, jax.core.Tracer):
        return jnp.pad(x, widths, mode)
    # NumPy is used because `jnp.pad` would be compiled for each shape.
    return np.pad(np.asarray(x), widths, mode)
