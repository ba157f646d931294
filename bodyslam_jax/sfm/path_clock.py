"""Converts a given camera path to the clock of the video, by tracks.

Where the times of a path are not those of the video, each reading of them (`PathClock`)
is tried with its best offset (`path_offset`), and the reading that fits best is taken;
one that fits no better than another is rejected. Lost frames are steps of the offset,
and a guessed focal length is corrected with the clock.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io.camera.path import at_times, usual_step
from bodyslam_jax.sfm.given_path import (
    MIN_TESTED_OBSERVATIONS,
    MIN_VIEWS,
    PathTest,
    is_worse,
    mean_cost,
)
from bodyslam_jax.sfm.path_offset import (
    MAX_OFFSETS,
    MAX_WHOLE_RATE_ERROR,
    SIGNIFICANCE_SIGMAS,
    ClockOffset,
    OffsetSearch,
    best_offset,
)
from bodyslam_jax.types import CameraPath, Intrinsics, PathClock, Tracks

_LOCAL_FRAMES = 15
"""Number of frames before and after the given time within which other offsets of a path
on the video's own clock are tried."""
_MIN_EXPECTED_SHARE = 0.95
"""Least share of the expected fit at which no other reading of the times is tried."""
_MAX_ASSUMED_RATE_ERROR = 0.05
"""Largest relative difference of rates at which a tracker may have assumed another
frame rate than the video's without any part of the path showing it."""
_LOST_PENALTY = 0.02
"""Least decrease of the cost by a step of the offset, as a share of it."""
_PIECE_FRAMES = 10
"""Length, in frames, of the pieces of tracks between which steps of the offset are
sought."""
_FOCAL_FACTORS = (0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.35, 1.5)
"""Factors on a guessed focal length with which a path is tried: fields of view from 31
to 70 degrees around the guess of 45 degrees."""


@dataclasses.dataclass(frozen=True)
class Placed:
    """A path whose poses are on the clock of the video's frames."""

    path: CameraPath
    intrinsics: Intrinsics
    """Intrinsics, with the focal length that fits the path if it was a guess."""
    warnings: tuple[str, ...]


def place_in_time(
    path: CameraPath,
    tracks: Tracks,
    intrinsics: Intrinsics,
    timestamps: Float[np.ndarray, " t"],
) -> Placed:
    """Converts the poses of a path to the clock of the video, by the tracks.

    A path on the video's own clock is kept, unless another offset fits significantly
    better. For any other path the offset, and lost frames in between, are estimated
    from the tracks.

    Args:
        timestamps: times of the frames, s.

    **Raises:** `InputError` if the clock is not the video's and its offset cannot be
    found.
    """
    if path.poses is None or not path.clocks or len(timestamps) < MIN_VIEWS:
        return Placed(path, intrinsics, ())
    test = PathTest(tracks, intrinsics, len(timestamps))
    most = int(test.used.sum())
    given = path.clocks[0]
    if most < MIN_TESTED_OBSERVATIONS:
        if given.is_videos:
            return Placed(path, intrinsics, ())
        raise InputError(
            f"camera path: its clock is not the video's ({given.name}), and {most} "
            f"observations of background points, expected {MIN_TESTED_OBSERVATIONS} or "
            "more, do not tell the offset: give its times in seconds from the video's "
            "first frame."
        )
    warnings: list[str] = []
    search = OffsetSearch(test, path.poses, timestamps)
    if intrinsics.is_guess:
        search, intrinsics, text = _with_best_focal(search, path, tracks, intrinsics)
        warnings += text
    found = _best_clock(search, path.clocks)
    if found is None:
        raise InputError(
            f"camera path: its clock is not the video's ({given.name}), and no offset "
            "leaves points to compare it with: give its times in seconds from the "
            "video's first frame."
        )
    placed = search.path(found.times, path)
    fit = search.test.fit(placed.T_WC, placed.known)
    if not given.is_videos and not fit.convinces:
        raise InputError(
            f"camera path: its clock is not the video's ({given.name}), and no offset "
            f"explains the images: {100 * fit.share:.0f} % of the points fit at best, "
            f"with its first pose at {found.times[0]:.2f} s, expected "
            f"{100 * fit.doubtful:.0f} % or more: poses of another video, from world "
            "to camera, with other axes, or another focal length?"
        )
    if found.is_given:
        return Placed(path, intrinsics, tuple(warnings))
    found, range_, same = search.equally_good(found)
    placed = search.path(found.times, path)
    fit = search.test.fit(placed.T_WC, placed.known)
    rate = 1 / search.period
    if range_ is not None:
        between = (
            f"first poses between {range_[0]:.2f} and {range_[1]:.2f} s fit the images "
            "equally well"
        )
        if not same and not given.is_videos:
            raise InputError(
                f"camera path: its clock is not the video's ({given.name}), and "
                f"{between} but give different paths: give its times in seconds from "
                "the video's first frame."
            )
        if not same or given.is_videos:
            return Placed(path, intrinsics, tuple(warnings))
        warnings.append(f"camera path: {between} and give the same path.")
    first = found.times[0] - timestamps[0]
    text = (
        f"camera path: {found.clock.name}; the tracks put its first pose at "
        f"{found.times[0]:.3f} ± {found.sigma:.3f} s (frame {first * rate:.1f}), where "
        f"{100 * fit.share:.0f} % of the points fit ({100 * fit.expected:.0f} % are "
        "expected)"
    )
    if given.is_videos:
        before = search.test.fit(path.T_WC, path.known)
        text += f" and not at {given.times[0]:.3f} s, where {100 * before.share:.0f} %"
    warnings.append(text + ".")
    if found.lost:
        where = ", ".join(f"{k} before {s:.2f} s" for s, k in found.lost[:4])
        warnings.append(f"camera path: frames without a pose were lost: {where}.")
    said = given.is_videos and placed.known.sum() == path.known.sum()
    if not placed.known.all() and not said:
        count = f"{int(placed.known.sum())} of {len(timestamps)}"
        warnings.append(f"camera path: poses for {count} frames.")
    return Placed(placed, intrinsics, tuple(warnings))


def _best_clock(
    search: OffsetSearch, clocks: tuple[PathClock, ...]
) -> ClockOffset | None:
    """Returns the clock and offset that fit best; the given one if none fits better.

    Other clocks than the first are tried only if that one does not fit as expected, or
    if its rate is nearly, but not exactly, that of the frames.
    """
    given, kept, found = clocks[0], None, []
    if given.is_videos:
        kept = ClockOffset(given, given.times, 0.0, is_given=True)
        offsets = np.arange(-_LOCAL_FRAMES, _LOCAL_FRAMES + 1) * search.period
        near = best_offset(search, given, offsets)
        found.append(kept)
        if near is not None:
            shift = abs(near.times[0] - given.times[0])
            if shift > max(SIGNIFICANCE_SIGMAS * near.sigma, search.period / 4):
                found.append(near)
    else:
        found.append(best_offset(search, given, search.offsets(given.times)))
    best = _best_of(search, found)
    rate = abs(usual_step(given.times) / search.period - 1)
    if (
        best is None
        or MAX_WHOLE_RATE_ERROR < rate < _MAX_ASSUMED_RATE_ERROR
        or not _fits_as_expected(search, best)
    ):
        others = clocks if given.is_videos else clocks[1:]
        others = [c for c in others if len(search.offsets(c.times))]
        found = [
            best,
            *(best_offset(search, c, search.offsets(c.times)) for c in others),
        ]
        best = _best_of(search, found)
    if best is not None and not (best.is_given and _fits_as_expected(search, best)):
        best = _best_of(search, [best, _with_lost_frames(search, best)])
    if kept is not None and best is not None and not best.is_given:
        # The given times of a path are kept, unless others convince by themselves.
        fit = search.test.fit(*at_times(best.times, search.poses, search.timestamps))
        return best if fit.convinces else kept
    return best


def _best_of(
    search: OffsetSearch, found: list[ClockOffset | None]
) -> ClockOffset | None:
    """Returns the first clock that no later one fits significantly better than."""
    best, cost = None, np.zeros((0, 2))
    for one in found:
        if one is None:
            continue
        its = search.costs(one.times)
        if best is None or is_worse(cost, its):
            best, cost = one, its
    return best


def _fits_as_expected(search: OffsetSearch, found: ClockOffset) -> bool:
    """Returns True if as many points fit as with a correct path."""
    fit = search.test.fit(*at_times(found.times, search.poses, search.timestamps))
    return fit.is_tested and fit.share >= _MIN_EXPECTED_SHARE * fit.expected


def _with_lost_frames(search: OffsetSearch, found: ClockOffset) -> ClockOffset | None:
    """Returns the offset with a step at each run of frames that have no pose and were
    not numbered; `None` if there is no such step.

    Each block of time prefers an offset, which is tested by pieces of tracks within it,
    as no offset explains a track across a step. The increasing series of offsets of
    least cost is found by dynamic programming, and then the frame of each step.
    """
    period, start = search.period, search.timestamps[0]
    # A path with lost frames was made from this video: it begins and ends within it.
    first = np.floor((found.times[0] - start) / period + 1e-3)
    times = found.times - first * period
    missing = search.timestamps[-1] - times[-1]
    most = min(int(round(missing / period)), MAX_OFFSETS)
    if most < 1:
        return None
    steps = np.arange(most + 1)
    pieces = search.test.in_pieces(_PIECE_FRAMES)
    short = OffsetSearch(pieces, search.poses, search.timestamps)
    profile = short.profile(times, steps * period)
    num = profile[..., 1].max(0)
    mean = profile[..., 0] / np.maximum(profile[..., 1], 1)
    unseen = profile[..., 1] < 0.5 * num
    # Blocks in which an offset has no poses get the median cost: no preference.
    seen = np.where(unseen, np.nan, mean)
    usual = np.array([np.nanmedian(c) if np.isfinite(c).any() else 0.0 for c in seen.T])
    cost = np.where(unseen, usual, mean) * num
    penalty = _LOST_PENALTY * np.median(cost, axis=0).sum() + 1e-9
    total, back = cost[:, 0], []
    for b in range(1, cost.shape[1]):
        # Either a step from the best smaller offset, with a penalty, or none.
        best = np.minimum.accumulate(total)
        at = np.maximum.accumulate(np.where(total <= best, np.arange(len(total)), 0))
        jumps = best + penalty < total
        back.append(np.where(jumps, at, np.arange(len(total))))
        total = np.where(jumps, best + penalty, total) + cost[:, b]
    chosen = [int(np.argmin(total))]
    for before in reversed(back):
        chosen.append(int(before[chosen[-1]]))
    offset = steps[np.array(chosen[::-1])]
    ends = np.flatnonzero(np.diff(offset))
    if not len(ends):
        return None
    times = times + offset[0] * period
    # The pose at which each step lies, and its number of frames: by whole tracks.
    counts = offset[ends + 1] - offset[ends]
    before = np.cumsum(counts) - counts
    at = (ends + 1) * _PIECE_FRAMES - offset[0] - before
    at = np.clip(at, 1, len(times) - 1)

    def stepped(at: np.ndarray, counts: np.ndarray) -> Float[np.ndarray, " n"]:
        after = np.arange(len(times))[:, None] >= at
        return times + period * (after * counts).sum(1)

    # First the pose, then also the number of frames; last by all views near the step.
    rounds = ((2 * _PIECE_FRAMES, 0), (3, 2), (3, 1))
    for turn, (reach, change) in enumerate(rounds):
        for k in range(len(at)):
            near = search
            if turn == len(rounds) - 1:
                middle = (stepped(at, counts)[at[k]] - start) / period
                away = _PIECE_FRAMES + counts[k]
                test = search.test.around(middle - away, middle + _PIECE_FRAMES)
                near = OffsetSearch(test, search.poses, search.timestamps)
            one = np.arange(len(at)) == k
            tries = [
                (np.clip(at + move * one, 1, len(times) - 1), counts + more * one)
                for more in range(-min(change, counts[k] - 1), change + 1)
                for move in range(-reach, reach + 1)
            ]
            costs = [
                mean_cost(near.costs(stepped(*pair), bridged=False)) for pair in tries
            ]
            at, counts = tries[int(np.argmin(costs))]
    moved = stepped(at, counts)
    lost = tuple((float(moved[n]), int(counts[at == n].sum())) for n in np.unique(at))
    return dataclasses.replace(found, times=moved, is_given=False, lost=lost)


def _with_best_focal(
    search: OffsetSearch, path: CameraPath, tracks: Tracks, guess: Intrinsics
) -> tuple[OffsetSearch, Intrinsics, list[str]]:
    """Corrects a guessed focal length by the one with which the path fits best."""
    assert path.poses is not None
    clock = path.clocks[0]
    tries: list[tuple[float, float, OffsetSearch, Intrinsics]] = []
    for factor in _FOCAL_FACTORS:
        params = guess.params.copy()
        params[:2] *= factor
        camera = dataclasses.replace(guess, params=params)
        test = PathTest(tracks, camera, len(search.timestamps))
        other = OffsetSearch(test, path.poses, search.timestamps)
        offsets = np.zeros(1) if clock.is_videos else search.offsets(clock.times)
        profile = other.profile(clock.times, offsets)
        count = profile[..., 1].sum(1)
        mean = profile[..., 0].sum(1) / np.maximum(count, 1)
        mean[count < max(MIN_TESTED_OBSERVATIONS, 0.3 * count.max())] = np.inf
        tries.append((float(mean.min()), abs(factor - 1), other, camera))
    best = min(tries, key=lambda one: one[:2])
    same = next(one for one in tries if one[1] == 0.0)
    if best is same or best[0] > 0.9 * same[0]:
        return search, guess, []
    text = (
        f"the camera path fits the images with a focal length of about "
        f"{best[3].params[0]:.0f} px, not with the guess of {guess.params[0]:.0f} px."
    )
    return best[2], best[3], [text]
