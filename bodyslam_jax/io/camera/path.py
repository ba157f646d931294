"""Given camera poses -> a pose for each frame of the video.

Trajectories are read and written in the format of the TUM RGB-D benchmark (Sturm et
al., IROS 2012). A line is `timestamp tx ty tz qx qy qz qw`: s, m, camera to world; `#`
starts a comment.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.io.camera import arkit
from bodyslam_jax.io.camera.colmap import read_poses
from bodyslam_jax.io.declared import MAX_MAGNITUDE, MAX_QUATERNION_ERROR
from bodyslam_jax.io.files import read_lines
from bodyslam_jax.io.frame_index import InvalidContent, Warn, frames_of_names
from bodyslam_jax.types import CameraPath, PathClock

_MIN_POSES = 2
"""Least number of frames with a pose."""
MAX_GAP_S = 0.5
"""Longest time between poses across which frames are interpolated, s."""
_TIME_TOLERANCE_FRAMES = 0.05
"""Largest difference of the times of a pose and of its frame, in frames: times of some
files are whole milliseconds."""
_UNITS = (
    ("seconds", 1.0),
    ("milliseconds", 1e-3),
    ("microseconds", 1e-6),
    ("nanoseconds", 1e-9),
)
"""Units of timestamps, and how many seconds each is."""
_MIN_STEP_S, _MAX_STEP_S = 1e-3, 2.0
"""Range of times between poses, s: trackers give at most 1000 poses a second, and
keyframes at least every other second."""
_MIN_UNIX_TIME_S = 1e8
"""Time, s, beyond which times count from 1970."""
_FRAME_NUMBER_STEPS = 1, 100
"""Range of the steps of whole numbers that may be those of frames."""
_MIN_MILLISECOND_STEP = 4
"""Step from which whole numbers that span more than the video are milliseconds: 4 ms
are 250 poses a second."""
_FRAME_STRIDES = (1, 2, 3, 4, 5, 6, 8, 10, 15)
"""Values of k for a pose of every k-th frame."""
_MAX_LINE_CHARACTERS = 1000
"""Number of characters of a line that are read: eight numbers have some two hundred."""
_MAX_NUMBER = 1e19
"""Largest number: a time in nanoseconds since 1970 has 19 digits; positions are far
smaller."""


def read_camera_path(
    path: Path,
    *,
    timestamps: Float[np.ndarray, " t"],
    metric: bool,
    images: tuple[str, ...] = (),
    warn: Warn,
) -> CameraPath:
    """Reads a TUM trajectory, COLMAP's images, nerfstudio's transforms.json, or the
    poses that Stray Scanner or Record3D recorded, which are in metres.

    A trajectory with as many poses as the video has frames is taken frame by frame, any
    other is interpolated at the frames' `timestamps` (s). Images are matched to frames
    by the numbers in their names. Where the times may be on another clock than the
    video's, their possible readings are kept for `sfm.place_in_time`.

    Args:
        metric: whether the poses are in metres.
        images: names of the video's frames, if it is a folder of images.

    **Raises:** `InputError`, naming the file, if it is none of these or belongs to
    another video.
    """
    if not path.exists():
        raise InputError(f"{path}: no such file, expected a camera path.")
    if path.is_dir():
        names = ("images.bin", "images.txt", "transforms.json", *arkit.PATH_FILES)
        inside = [path / n for n in names]
        path = next((p for p in inside if p.exists()), inside[0])
        if not path.exists():
            raise InputError(f"{path.parent}: no {', '.join(names)} in this folder.")
    if arkit.is_path(path):
        metric = True
        times, poses = arkit.read_arkit_poses(path)
        of_frames = False
    elif path.suffix in (".bin", ".json") or path.name == "images.txt":
        names, poses = read_poses(path)
        try:
            frames = frames_of_names(
                names,
                what="poses",
                num_frames=len(timestamps),
                images=images,
                complete=False,
                warn=warn,
            )
        except InvalidContent as error:
            raise InputError(f"{path}: {error}.") from None
        at = np.array([frames[name] for name in names])
        order = np.argsort(at)
        twice = at[order][1:][np.diff(at[order]) == 0]
        if len(twice):
            raise InputError(
                f"{path}: two poses or more of frame {twice[0]}, expected one of each."
            )
        times, poses, of_frames = timestamps[at[order]], poses[order], True
    else:
        times, poses = read_tum(path)
        of_frames = False
    if len(times) < _MIN_POSES:
        raise InputError(f"{path}: one pose, expected {_MIN_POSES} or more.")
    clocks = _clocks(times, timestamps, of_frames)
    if of_frames:
        T_WC = np.tile(np.eye(4), (len(timestamps), 1, 1))
        known = np.isin(timestamps, times)
        T_WC[known] = poses
    else:
        T_WC, known = at_times(clocks[0].times, poses, timestamps)
    if clocks[0].is_videos and known.sum() < _MIN_POSES:
        raise InputError(
            f"{path}: poses for {known.sum()} of the video's {len(timestamps)} frames, "
            f"expected {_MIN_POSES} or more: of another video, or another clock?"
        )
    if clocks[0].is_videos and not known.all():
        warn(f"{path.name}: poses for {known.sum()} of {len(timestamps)} frames.")
    return CameraPath(T_WC, known, metric, poses, clocks)


def _clocks(
    times: Float[np.ndarray, " n"],
    timestamps: Float[np.ndarray, " t"],
    of_frames: bool,
) -> tuple[PathClock, ...]:
    """Returns the possible readings of a path's times, the likeliest first.

    Args:
        timestamps: of the video's frames, s.
        of_frames: whether the times are those of frames that the file names.
    """
    count, num_frames = len(times), len(timestamps)
    if of_frames:
        return (PathClock("poses of frames by number", times, True),)
    period = usual_step(timestamps)
    end = timestamps[-1]
    step = usual_step(times)
    starts = times - times[0] + timestamps[0]
    found = []
    within = times[0] > timestamps[0] - period and times[-1] < end + period
    # From 0 on but too short: as likely counted from its own first pose.
    from_zero = abs(times[0]) < 1e-6 and times[-1] < end - 1.5 * period
    if count == num_frames:
        found.append(PathClock("a pose for each frame", timestamps.copy(), True))
    elif within and step < _MAX_STEP_S and not from_zero:
        found.append(PathClock("times in seconds", times, True))
    whole = bool((times == np.round(times)).all())
    if whole and _FRAME_NUMBER_STEPS[0] <= step <= _FRAME_NUMBER_STEPS[1]:
        numbered = (times - times[0]) * period
        if times[-1] < num_frames:
            at = np.interp(times, np.arange(num_frames), timestamps)
            name = "frame numbers"
            if times[0] == 0 and times[-1] < num_frames - 1.5:
                found.append(PathClock(f"{name} from 0", at, False))
            else:
                found.append(PathClock(name, at, True))
        elif step < _MIN_MILLISECOND_STEP or times[-1] - times[0] < 1.1 * num_frames:
            name = "frame numbers of another count"
            found.append(PathClock(name, numbered + timestamps[0], False))
    overlapping = step < _MAX_STEP_S and times[0] < end and times[-1] > timestamps[0]
    if overlapping and not from_zero and not (whole and step >= 1):
        found.append(PathClock("times in seconds", times, True))
    for name, unit in _UNITS:
        if _MIN_STEP_S <= step * unit < _MAX_STEP_S:
            unix = times[0] * unit > _MIN_UNIX_TIME_S
            what = f"Unix time in {name}" if unix else f"times in {name}"
            what += " from 0" if times[0] == 0 else " on a clock of their own"
            scaled = starts[0] + (starts - starts[0]) * unit
            found.append(PathClock(what, scaled, False))
    # Of a clock that assumed another frame rate: a pose for every k-th frame.
    for k in _FRAME_STRIDES:
        if step > 0 and (times[-1] - times[0]) / step * k <= 1.1 * num_frames:
            scaled = starts[0] + (times - times[0]) / step * k * period
            what = f"a pose every {k} frames" if k > 1 else "a pose for each frame"
            found.append(PathClock(f"{what} from an unknown one on", scaled, False))
    if not found:
        found.append(PathClock("times in seconds", times, True))
    return tuple(found)


def at_times(
    times: Float[np.ndarray, " n"],
    poses: Float[np.ndarray, "n 4 4"],
    timestamps: Float[np.ndarray, " t"],
) -> tuple[Float[np.ndarray, "t 4 4"], Bool[np.ndarray, " t"]]:
    """Returns poses (camera to world) at the frames' `timestamps`, interpolated between
    those at `times` (s, increasing), and the frames that have one.

    A frame has none before the first pose, after the last, and where neighbouring poses
    lie further apart than `MAX_GAP_S`, unless it is at one of them.
    """
    T_WC = np.tile(np.eye(4), (len(timestamps), 1, 1))
    after = np.clip(np.searchsorted(times, timestamps), 1, len(times) - 1)
    gap = times[after] - times[after - 1]
    near = np.minimum(
        np.abs(timestamps - times[after - 1]), np.abs(timestamps - times[after])
    )
    same = _TIME_TOLERANCE_FRAMES * usual_step(timestamps)
    inside = (timestamps >= times[0] - same) & (timestamps <= times[-1] + same)
    known = inside & ((gap <= MAX_GAP_S) | (near <= same))
    if not known.any():
        return T_WC, known
    at = np.clip(timestamps[known], times[0], times[-1])
    T_WC[known, :3, :3] = so3.interpolate_path(times, poses[:, :3, :3], at)
    for axis in range(3):
        T_WC[known, axis, 3] = np.interp(at, times, poses[:, axis, 3])
    return T_WC, known


def usual_step(times: Float[np.ndarray, " n"]) -> float:
    """Returns the step of increasing times without their gaps, in their unit; 0 for one
    time.

    It is the mean of the steps up to 1.5 times the median, because times may be
    rounded.
    """
    steps = np.diff(times)
    if not len(steps):
        return 0.0
    return float(steps[steps <= 1.5 * np.median(steps)].mean())


def read_tum(path: Path) -> tuple[Float[np.ndarray, " t"], Float[np.ndarray, "t 4 4"]]:
    """Timestamps (s) and poses (camera to world, m) of a TUM trajectory, sorted.

    **Raises:** `InputError` naming the file, what was found and what was expected.
    """
    rows = []
    lines = read_lines(path, "a TUM trajectory")
    for number, line in enumerate(lines, 1):
        # No more than is needed to see that a line is too long.
        words = line[:_MAX_LINE_CHARACTERS].partition("#")[0].replace(",", " ").split()
        if not words:
            continue
        try:
            row = [float(word) for word in words]
        except ValueError:
            row = []
        # A time, a position and a quaternion.
        if len(row) != 8 or not all(abs(x) <= _MAX_NUMBER for x in row):
            raise InputError(
                f"{path}, line {number}: {line.strip()[:60]!r}, not eight numbers "
                "`timestamp tx ty tz qx qy qz qw`."
            )
        rows.append(row)
    if not rows:
        raise InputError(f"{path}: no pose in it; expected TUM lines of eight numbers.")
    table = np.array(rows)
    table = table[np.argsort(table[:, 0], kind="stable")]
    if np.any(np.diff(table[:, 0]) <= 0):
        raise InputError(f"{path}: two poses have the same timestamp.")
    length = np.linalg.norm(table[:, 4:], axis=1)
    if np.any(abs(length - 1) > MAX_QUATERNION_ERROR):
        worst = float(length[np.argmax(abs(length - 1))])
        raise InputError(f"{path}: a quaternion of length {worst:.3g}, not 1.")
    if np.abs(table[:, 1:4]).max() > MAX_MAGNITUDE:
        raise InputError(
            f"{path}: a camera {np.abs(table[:, 1:4]).max():.3g} m away, expected at "
            f"most {MAX_MAGNITUDE:g}."
        )
    T_WC = np.tile(np.eye(4), (len(table), 1, 1))
    T_WC[:, :3, :3] = so3.from_quaternion(table[:, 4:])
    T_WC[:, :3, 3] = table[:, 1:4]
    return table[:, 0], T_WC


def write_tum(
    path: Path, timestamps: Float[np.ndarray, " t"], T_WC: Float[np.ndarray, "t 4 4"]
) -> None:
    """Writes timestamps (s) and poses (camera to world, m) as a TUM trajectory."""
    xyzw = so3.quaternion(so3.log(T_WC[:, :3, :3]))
    np.savetxt(
        path,
        np.column_stack([timestamps, T_WC[:, :3, 3], xyzw]),
        fmt="%.9f",
        header="timestamp tx ty tz qx qy qz qw (camera to world)",
    )
