"""The record of a running video, and the result that is made of it at the end.

For every frame it keeps the time, the pose relative to a frame of the window, people's
keypoints and, for a last offline pass, the points (2.5 kB); for the frames of the
window, as they leave it: camera, roots and postures. No image is kept. Without points
it takes half a kilobyte a frame, and one more for each person.
"""

import dataclasses
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Int

from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.graph import CHUNK
from bodyslam_jax.online.loops import NO_CORRECTION, Correction
from bodyslam_jax.online.window import SCALE_WALK, Solved
from bodyslam_jax.online.window_content import Measured, between
from bodyslam_jax.types import (
    Intrinsics,
    JointEstimate,
    Keypoints,
    ScaleStart,
    Sequence,
    SfmResult,
    Tracks,
)

_MAX_FILLED_S = 1.0
"""Longest gap in which the result has frames that were dropped, s."""
_MAX_INTERPOLATED_S = 0.35
"""Longest time between two looks for people in which keypoints are interpolated, s:
two and a half times that for which their errors persist."""
_MAX_LANDMARKS = 20_000
"""Largest number of landmarks in the result."""


@dataclasses.dataclass(frozen=True)
class Seen:
    """A frame of the video."""

    time: float
    """s"""
    map: int
    """Number of its map; -1 before the first map."""
    slot: int
    """Number of the window's frame that it is or follows."""
    since: Float[np.ndarray, "4 4"]
    """Transform from its camera to that of the window's frame, map units."""
    located: bool
    people: dict[int, Float[np.ndarray, "25 3"]]
    points: tuple[np.ndarray, np.ndarray] | None = None
    """Numbers and positions (px) of points of the scene, if they are kept."""
    looked: bool = True
    """True if people were looked for."""
    dropped: bool = False
    """True of a frame that was not used, and is interpolated in the result."""


@dataclasses.dataclass(frozen=True)
class Slot:
    """A frame of the window as it left it."""

    time: float
    T_WC: Float[np.ndarray, "4 4"]
    """Camera to map, map units."""
    located: bool
    people: dict[int, tuple[np.ndarray, np.ndarray, np.ndarray]]
    """T_CH, θ and contacts."""


@dataclasses.dataclass
class Counts:
    """Counts of events, for the warnings of the result."""

    frames: int = 0
    """Number of frames that were used."""
    looks: int = 0
    """Number of frames in which people were looked for."""
    late: int = 0
    """Number of frames whose time is not after that of the one before."""
    lost: int = 0
    """How often the camera could not be located in the map."""
    relocated: int = 0
    skipped: int = 0
    """Number of frames that were not passed to the window."""

    def notes(self) -> list[str]:
        """Returns warnings about the result, one line each."""
        notes = []
        if self.late:
            notes.append(f"{self.late} frames came late or twice and were not used")
        if self.lost:
            notes.append(
                f"the camera was lost {self.lost} times and found again "
                f"{self.relocated} times"
            )
        if self.skipped:
            notes.append(
                f"{self.skipped} frames were not in the graph: the machine was slow"
            )
        return notes


class Record:
    """The frames, and the state of the maps that they are in."""

    def __init__(self) -> None:
        self.frames: list[Seen] = []
        self.slots: dict[tuple[int, int], Slot] = {}
        """Frames of the window, by map and number."""
        self.scales: dict[int, list[tuple[int, float, float]]] = {}
        """By map: number of a frame, and s and its standard deviation there."""
        self.landmarks: dict[tuple[int, int], tuple[int, np.ndarray]] = {}
        """By map and track: a frame that observed it, and its position, map units."""
        self.shapes: dict[int, np.ndarray] = {}
        self.shape_covariances: dict[int, np.ndarray] = {}
        self.fixed: dict[int, str] = {}
        """Motion of the camera, `static` or `rotation`, by map; only of maps whose
        camera is fixed."""
        self.joins: dict[int, tuple[tuple[int, int], np.ndarray]] = {}
        """By map that continues another one, whose camera began to move: map and slot
        of a frame of the other one, and the pose of the first camera relative to that
        frame's, m."""
        self.corrections: dict[int, Correction] = {}
        """By map: the drift that loops told."""
        self.pixel_sigma = 0.7

    def keep(self, number: int, solved: Solved, corrected: Solved) -> None:
        """Keeps the frames of a window of map `number`; they replace those of an
        earlier window. s is that of the map without drift (`corrected`)."""
        first = solved.first
        # Copies: a row of an array would keep all of it.
        for k in range(CHUNK, len(solved.times)):
            people = {
                person: (
                    solved.roots[h, k].copy(),
                    solved.poses[h, k].copy(),
                    solved.contacts[h, k].copy(),
                )
                for h, person in enumerate(solved.people)
                if person is not None and solved.present[h, k]
            }
            self.slots[number, first + k] = Slot(
                float(solved.times[k]),
                solved.T_WC[k].copy(),
                bool(solved.located[k]),
                people,
            )
        for h, person in enumerate(solved.people):
            if person is not None and solved.present[h].any():
                self.shapes[person] = solved.shapes[h]
                self.shape_covariances[person] = solved.shape_covariance[h]
        sigma = float("nan") if solved.fixed else corrected.scale_sigma
        told = first + len(solved.times) - 1, corrected.scale, sigma
        self.scales.setdefault(number, []).append(told)
        for track, place in solved.landmarks.items():
            if len(self.landmarks) < _MAX_LANDMARKS:
                self.landmarks[number, track] = told[0], place.copy()

    def join(self, number: int, frames: int) -> None:
        """Removes the last so many frames from the map that has them and ends it there,
        so that map `number` can begin with them."""
        first = self.frames[len(self.frames) - frames]
        del self.frames[len(self.frames) - frames :]
        self.joins[number] = (first.map, first.slot), first.since
        # The next slot is kept, as frames lie between two.
        for of, slot in list(self.slots):
            if of == first.map and slot > first.slot + 1:
                del self.slots[of, slot]

    def measured(
        self, intrinsics: Intrinsics, name: str, warnings: tuple[str, ...]
    ) -> Sequence:
        """Returns all recorded measurements as the input of an offline run: the
        keypoints of everybody who was seen, and the points if they were kept."""
        persons = sorted({person for frame in self.frames for person in frame.people})
        times = np.array([frame.time for frame in self.frames])
        return Sequence(
            name=name,
            frames=None,
            timestamps=times - times[0],
            intrinsics=intrinsics,
            keypoints=_keypoints(self.frames, persons),
            tracks=_tracks(self),
            warnings=warnings,
        )

    def pass_over(self, number: int, slot: int, measured: Measured) -> None:
        """Keeps the camera of a frame that is not passed to the window."""
        given = measured.time, measured.T_WC, measured.located, {}
        self.slots[number, slot] = Slot(*given)


@dataclasses.dataclass(frozen=True)
class _Path:
    """Frames of the windows of all maps in one metric world."""

    T_WC: dict[tuple[int, int], Float[np.ndarray, "4 4"]]
    """Camera poses by map and frame of the window, m."""
    scale: dict[tuple[int, int], float]
    """m per map unit, by map and frame of the window, as the window had it there."""


def smoothed_scales(
    told: list[tuple[int, float, float]], fps: float
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, " n"], float]:
    """Returns s of each window that estimated it, smoothed over all windows (Rauch,
    Tung, Striebel, 1965), and the standard deviation of the last; s = 1 and NaN if none
    did.

    s is a random walk between windows, as in `window`.
    """
    known = [row for row in told if np.isfinite(row[2])]
    if not known:
        return np.array([0]), np.ones(1), float("nan")
    frame, scale, sigma = (np.array(x) for x in zip(*known, strict=True))
    found = scale.astype(float).copy()
    for i in range(len(found) - 2, -1, -1):
        walked = (SCALE_WALK * scale[i]) ** 2 * (frame[i + 1] - frame[i]) / fps
        gain = sigma[i] ** 2 / (sigma[i] ** 2 + walked)
        found[i] += gain * (found[i + 1] - found[i])
    return frame, found, float(sigma[-1])


def parts_of(
    record: Record,
    intrinsics: Intrinsics,
    name: str,
    fps: float,
    warnings: tuple[str, ...],
    rate: float,
) -> tuple[Sequence, SfmResult, JointEstimate]:
    """Returns all frames as the stages of an offline run pass them on: measurements,
    cameras, and the joint estimate.

    Where frames were left out, the result has frames at even times (`evenly`): what
    judges it takes differences of consecutive frames.

    **Arguments:** `fps`: rate of the window's frames, 1/s; `rate`: that of the source.
    """
    path = _path(record, fps)
    frames, kept = evenly(record, rate)
    moving = [number for number in record.scales if number not in record.fixed]
    told = record.scales[max(moving)] if moving else []
    _, scales, sigma = smoothed_scales(told, fps)
    scale = float(scales[-1])
    T_WC, located = _cameras(frames, record, path)
    persons = sorted({p for slot in record.slots.values() for p in slot.people})
    roots, poses, present, contacts = (
        x[:, kept] for x in _people(frames, record, path, persons, T_WC)
    )
    points = _keypoints(frames, persons)
    if points is not None:
        points = Keypoints(points.uv[:, kept], points.confidence[:, kept])
    times = np.array([frame.time for frame in frames])[kept]
    cameras, located = T_WC[kept], located[kept]
    cameras[:, :3, 3] /= scale
    landmarks = np.array(
        [
            _placed(record, path, (number, slot), place)
            for (number, _), (slot, place) in record.landmarks.items()
            if (number, slot) in path.T_WC
        ]
    ).reshape(-1, 3)
    measured = Sequence(
        name=name,
        frames=None,
        timestamps=times - times[0],
        intrinsics=intrinsics,
        keypoints=points,
        warnings=warnings,
    )
    none = np.zeros(0, int)
    sfm = SfmResult(
        kind="moving" if moving else _kind_of_fixed(record),
        T_WC=cameras,
        registered=located,
        landmarks=landmarks / scale,
        tracks=Tracks(none, none, np.zeros((0, 2))),
        keep=np.zeros(0, bool),
        prior_information=np.zeros((len(landmarks), 3, 3)),
        prior_mean=landmarks / scale,
        pixel_sigma=record.pixel_sigma,
        intrinsics=np.asarray(intrinsics.params, float),
        focal_sigma=float("nan"),
        costs=(0.0, 0.0),
        warnings=(),
    )
    start = ScaleStart()
    if np.isfinite(sigma):
        start = ScaleStart(motion=scale, motion_error=sigma)
    joint = JointEstimate(
        scale=scale,
        start=start,
        scale_sigma=sigma if np.isfinite(sigma) or not moving else float("inf"),
        shape_covariance=np.array(
            [record.shape_covariances[p] for p in persons]
        ).reshape(-1, 10, 10),
        unobserved=(),
        cameras=cameras,
        roots=roots,
        poses=poses,
        shapes=np.array([record.shapes[p] for p in persons]).reshape(-1, 10),
        landmarks=landmarks / scale,
        intrinsics=np.asarray(intrinsics.params, float),
        present=present,
        status="converged",
        stages=(),
        contacts=contacts,
    )
    return measured, sfm, joint


def _kind_of_fixed(record: Record) -> str:
    """Returns the motion of a camera that began no map: `rotation` if it ever turned,
    else `static`."""
    return "rotation" if "rotation" in record.fixed.values() else "static"


def _path(record: Record, fps: float) -> _Path:
    """Returns the windows' frames in metres; frames that were not located are
    interpolated."""
    poses, scale_at = {}, {}
    end = np.eye(4)
    for number in sorted(record.scales):
        slots = sorted(k for n, k in record.slots if n == number)
        if not slots:
            continue
        frame, scales, _ = smoothed_scales(record.scales[number], fps)
        s = np.interp(slots, frame, scales)
        found = [record.slots[number, k] for k in slots]
        known = np.array([x.located for x in found])
        T = np.array([x.T_WC for x in found])
        if known.any():
            T = between(np.array(slots)[known], T[known], np.array(slots))
        loops = record.corrections.get(number, NO_CORRECTION)
        T, unit = loops.at(np.array(slots), T)
        steps = np.diff(T[:, :3, 3], axis=0) * s[1:, None]
        T[:, :3, 3] = T[0, :3, 3] * s[0] + np.concatenate(
            [np.zeros((1, 3)), np.cumsum(steps, axis=0)]
        )
        before, since = record.joins.get(number, ((number, 0), np.eye(4)))
        start = poses[before] @ since if before in poses else end
        into = start @ np.linalg.inv(T[0])
        for k, pose, value in zip(slots, T, s * unit, strict=True):
            poses[number, k] = into @ pose
            scale_at[number, k] = float(value)
        end = poses[number, slots[-1]]
    return _Path(poses, scale_at)


def evenly(record: Record, rate: float) -> tuple[list[Seen], Bool[np.ndarray, " t"]]:
    """Returns the frames, with those that were dropped and that the result has all the
    same, and which of them all the result has.

    These are all that were used if they have even times; else one in so many of the
    source's frames as were used on average, but none in a gap of more than a second.
    """
    times = np.array([frame.time for frame in record.frames])
    gaps = np.diff(times) * rate
    step = max(1, round(float(np.median(gaps)))) if len(gaps) else 1
    if not len(gaps) or np.abs(gaps - step).max() < 0.5:
        return record.frames, np.ones(len(times), bool)
    short = gaps[gaps <= _MAX_FILLED_S * rate]
    step = max(1, round(float(short.mean()))) if len(short) else step
    number = np.rint((times - times[0]) * rate).astype(int).tolist()
    frames, kept = [], []
    ends = [*number[1:], None]
    for frame, since, until in zip(record.frames, number, ends, strict=True):
        frames.append(frame)
        kept.append(since % step == 0)
        if until is None or until - since > _MAX_FILLED_S * rate:
            continue
        for n in range(since + step - since % step, until, step):
            slot, time = frame.slot, times[0] + n / rate
            while (at := record.slots.get((frame.map, slot + 1))) and at.time <= time:
                slot += 1
            none = np.eye(4), False, {}, None, False, True
            frames.append(Seen(time, frame.map, slot, *none))
            kept.append(True)
    return frames, np.array(kept, bool)


def _cameras(
    frames: list[Seen], record: Record, path: _Path
) -> tuple[Float[np.ndarray, "t 4 4"], Bool[np.ndarray, " t"]]:
    """Returns T_WC of every frame, m, and which were located, or are between two that
    were."""
    T_WC = np.tile(np.eye(4), (len(frames), 1, 1))
    located = np.zeros(len(frames), bool)
    for t, frame in enumerate(frames):
        at = path.T_WC.get((frame.map, frame.slot))
        if at is None or frame.dropped:
            continue
        since = frame.since.copy()
        since[:3, 3] *= path.scale[frame.map, frame.slot]
        T_WC[t] = at @ since
        located[t] = frame.located and record.slots[frame.map, frame.slot].located
    if located.any():
        times = np.array([frame.time for frame in frames])
        T_WC = between(times[located], T_WC[located], times)
    for t, frame in enumerate(frames):  # A dropped frame follows another frame.
        located[t] |= frame.dropped and located[t - 1]
    for t in range(len(frames) - 2, -1, -1):
        located[t] &= not frames[t].dropped or located[t + 1]
    return T_WC, located


def _placed(
    record: Record, path: _Path, key: tuple[int, int], place: Float[np.ndarray, " 3"]
) -> Float[np.ndarray, " 3"]:
    """Returns the position of a landmark in the metric world, m, relative to the
    window's frame that observed it."""
    T = record.slots[key].T_WC
    p_C = T[:3, :3].T @ (place - T[:3, 3]) * path.scale[key]
    return path.T_WC[key][:3, :3] @ p_C + path.T_WC[key][:3, 3]


def _keypoints(frames: list[Seen], persons: list[int]) -> Keypoints | None:
    """Returns the keypoints of all frames, interpolated where people were not looked
    for: errors of keypoints persist for longer, so that this adds no information."""
    if not persons:
        return None
    found = np.zeros((len(persons), len(frames), 25, 3))
    for t, frame in enumerate(frames):
        for h, person in enumerate(persons):
            found[h, t] = frame.people.get(person, 0.0)
    looked = [t for t, frame in enumerate(frames) if frame.looked]
    for a, b in pairwise(looked):
        duration = frames[b].time - frames[a].time
        if b == a + 1 or duration > _MAX_INTERPOLATED_S:
            continue
        both = np.minimum(found[:, a, :, 2:], found[:, b, :, 2:]) > 0
        for t in range(a + 1, b):
            share = (frames[t].time - frames[a].time) / duration
            mean = (1 - share) * found[:, a] + share * found[:, b]
            found[:, t] = np.where(both, mean, 0.0)
    return Keypoints(found[..., :2], found[..., 2])


def _tracks(record: Record) -> Tracks | None:
    """Returns the recorded points as tracks; `None` if none were kept."""
    kept = [
        (k, *frame.points)
        for k, frame in enumerate(record.frames)
        if frame.points is not None
    ]
    if not kept:
        return None
    frame = np.concatenate([np.full(len(ids), k) for k, ids, _ in kept])
    number = np.concatenate([ids for _, ids, _ in kept])
    uv = np.concatenate([pixels for _, _, pixels in kept]).astype(float)
    return Tracks(frame, np.unique(number, return_inverse=True)[1].reshape(-1), uv)


def _people(
    frames: list[Seen],
    record: Record,
    path: _Path,
    persons: list[int],
    T_WC: Float[np.ndarray, "t 4 4"],
) -> tuple[
    Float[np.ndarray, "h t 4 4"],
    Float[np.ndarray, "h t 23 3"],
    Bool[np.ndarray, "h t"],
    Float[np.ndarray, "h t 4"],
]:
    """Returns roots, postures, presence and contacts in every frame, interpolated
    between the frames of the windows."""
    shape = len(persons), len(frames)
    roots = np.tile(np.eye(4), (*shape, 1, 1))
    poses, present = np.zeros((*shape, 23, 3)), np.zeros(shape, bool)
    contacts = np.zeros((*shape, 4))
    for t, frame in enumerate(frames):
        pair = [(frame.map, frame.slot), (frame.map, frame.slot + 1)]
        a, b = (record.slots.get(key) for key in pair)
        if a is None:
            continue
        share = 0.0 if b is None else (frame.time - a.time) / (b.time - a.time)
        share = float(np.clip(share, 0.0, 1.0))
        for h, person in enumerate(persons):
            if person not in a.people:
                continue
            ends = [path.T_WC[pair[0]] @ a.people[person][0]]
            thetas, stands = [a.people[person][1]], [a.people[person][2]]
            if b is not None and person in b.people and pair[1] in path.T_WC:
                ends.append(path.T_WC[pair[1]] @ b.people[person][0])
                thetas.append(b.people[person][1])
                stands.append(b.people[person][2])
            elif share > 0.5:
                continue
            T_WH = between(np.arange(len(ends)), np.array(ends), np.array([share]))[0]
            turns = so3.exp(np.array([thetas[0], thetas[-1]]))
            found = so3.interpolate(turns[0], turns[1], np.full(23, share))
            roots[h, t] = np.linalg.inv(T_WC[t]) @ T_WH
            poses[h, t], present[h, t] = so3.log(found), True
            contacts[h, t] = stands[0] + share * (stands[-1] - stands[0])
    return roots, poses, present, contacts
