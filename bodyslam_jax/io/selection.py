"""The frames of a video that a sequence uses: an interval of time, and no repeats."""

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from bodyslam_jax.config import Known
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.types import DetectedPeople, Sequence, Tracks

_TIME_TOLERANCE_S = 1e-6
"""Time by which a frame may be outside the interval, s."""


def in_interval(
    name: str, timestamps: Float[np.ndarray, " t"], known: Known
) -> Int[np.ndarray, " k"] | None:
    """Returns indices of the frames from `known.start` to `known.end` (s); `None` for
    all.

    **Raises:** `InputError`, naming the video, if there is no frame in the interval.
    """
    if known.start is None and known.end is None:
        return None
    start = 0.0 if known.start is None else known.start
    end = np.inf if known.end is None else known.end
    inside = (timestamps >= start - _TIME_TOLERANCE_S) & (
        timestamps <= end + _TIME_TOLERANCE_S
    )
    (chosen,) = np.nonzero(inside)
    if not len(chosen):
        raise InputError(
            f"{name}: no frame between {start:g} and {end:g} s, the video is "
            f"{timestamps[-1]:.2f} s long."
        )
    return chosen


def times_of_all_frames(
    timestamps: Float[np.ndarray, " t"],
    picks: Int[np.ndarray, " t"] | None,
    num_frames: int,
) -> Float[np.ndarray, " n"]:
    """Returns times (s) of all frames of a video, of which `timestamps` are those of
    `picks`.

    Frames that are left out get interpolated times.
    """
    if picks is None:
        return timestamps
    return np.interp(np.arange(num_frames), picks, timestamps)


def select_frames(sequence: Sequence, picks: Int[np.ndarray, " t"]) -> Sequence:
    """Returns the data that were read for all frames of a video, for the frames
    `picks`.

    `sequence.timestamps` are already those of `picks`.
    """
    path, tracks, detected = (
        sequence.camera_path,
        sequence.tracks,
        sequence.detected,
    )
    if path is not None:
        path = dataclasses.replace(path, T_WC=path.T_WC[picks], known=path.known[picks])
    if tracks is not None:
        kept = np.isin(tracks.frame, picks)
        _, landmark = np.unique(tracks.landmark[kept], return_inverse=True)
        frame = np.searchsorted(picks, tracks.frame[kept])
        tracks = Tracks(frame, landmark.astype(np.int64), tracks.uv[kept])
    if detected is not None:
        kept = np.isin(detected.frame, picks)
        frame = np.searchsorted(picks, detected.frame[kept])
        detected = DetectedPeople(frame, detected.keypoints[kept])
    return dataclasses.replace(
        sequence,
        keypoints=_cut(sequence.keypoints, picks),
        bodies=_cut(sequence.bodies, picks),
        tracks=tracks,
        detected=detected,
        picks=picks,
        camera_path=path,
    )


def _cut(people, picks: Int[np.ndarray, " t"]):
    """Returns keypoints or bodies, whose arrays have the axes (h, t, ...), at some
    frames."""
    if people is None:
        return None
    arrays = {k: v for k, v in vars(people).items() if isinstance(v, np.ndarray)}
    return dataclasses.replace(people, **{k: v[:, picks] for k, v in arrays.items()})
