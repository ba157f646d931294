"""Converts a given camera path to the clock of the video, by tracks.

Where the times of a path are not those of the video, each reading of them (`PathClock`)
is tried with its best offset (`path_offset`), and the reading that fits best is taken;
one that fits no better than another is rejected. A guessed focal length is corrected
with the clock.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io.camera.path import at_times, usual_step
from bodyslam_jax.sfm.given_path import (
    MIN_EXPECTED_SHARE,
    MIN_TESTED_OBSERVATIONS,
    MIN_VIEWS,
    PathTest,
    is_worse,
)
from bodyslam_jax.sfm.path_offset import (
    MAX_WHOLE_RATE_ERROR,
    SIGNIFICANCE_SIGMAS,
    ClockOffset,
    OffsetSearch,
    best_offset,
    enough_observations,
)
from bodyslam_jax.types import CameraPath, Intrinsics, PathClock, Tracks

_LOCAL_FRAMES = 15
"""Number of frames before and after the given time within which other offsets of a path
on the video's own clock are tried."""
_MAX_ASSUMED_RATE_ERROR = 0.05
"""Largest relative difference of rates at which a tracker may have assumed another
frame rate than the video's without any part of the path showing it."""
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
    better. For any other path the offset is estimated from the tracks.

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
            "to camera, with other axes or another focal length, or poses left out "
            "and not numbered?"
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
    return fit.is_tested and fit.share >= MIN_EXPECTED_SHARE * fit.expected


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
        mean[count < enough_observations(count)] = np.inf
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
