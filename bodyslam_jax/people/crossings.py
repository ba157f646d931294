"""Cuts tracklets where a detector switched from one person to another.

Where two people overlap in the image, a detector often finds only the one in front, and
the tracklet of the one behind continues with the other's keypoints: neither position
nor size changes. The colours of the clothes do, by more than their measured noise, and
tracklets are cut there. The pieces are assigned to people afterwards, all together
(`linking`), which also rejoins a piece that nobody else explains.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from bodyslam_jax.tracking.appearance import difference, mean_look
from bodyslam_jax.tracking.tracker import Tracklet

_WINDOW_S = 0.33
"""Time before and after a change over which colours are averaged. Slow changes, such as
those of light, are small over twice this time."""
_MIN_DESCRIPTORS = 5
"""Least number of descriptors on each side of a cut."""
_MIN_COLOUR_CHANGE = 10.0
"""Difference of colours (`appearance.difference`) below which nothing is cut."""
_MIN_CHANGE_SIGMAS = 2.5
"""Least change of colours in standard deviations. Exchanged people had 3.6; the largest
of each of 26 tracklets of one person was 0.6 to 3.0."""
_MIN_COLOUR_SIGMA = 2.0
"""Standard deviation of colours in addition to that within both windows."""
_MAX_OWN_SIDE_RATIO = 0.5
"""Ratio of the distances of a frame's colours from those of its own and of the other
side up to which the frame belongs to its side."""


def cut(tracklet: Tracklet) -> list[Tracklet]:
    """Returns the pieces of a tracklet between abrupt changes of clothes; the tracklet
    itself if there is none.

    Frames at a cut whose colours are unknown, or could belong to either side, are in no
    piece.
    """
    known = [k for k, look in enumerate(tracklet.looks) if np.isfinite(look).any()]
    if len(known) < 2 * _MIN_DESCRIPTORS:
        return [tracklet]
    looks = np.stack([tracklet.looks[k] for k in known])
    window = max(_MIN_DESCRIPTORS, round(_WINDOW_S * tracklet.fps))
    stretches = _stretches(looks, 0, len(known), window)
    starts = [0, *(known[first] for first, _ in stretches[1:])]
    stops = [*(known[last - 1] + 1 for _, last in stretches[:-1]), len(tracklet.frames)]
    return [part(tracklet, i, j) for i, j in zip(starts, stops, strict=True)]


def part(tracklet: Tracklet, start: int, stop: int) -> Tracklet:
    """Returns the detections with indices `start` to `stop` (exclusive), with the
    velocity at their end."""
    return chosen(tracklet, list(range(start, stop)))


def chosen(tracklet: Tracklet, indices: list[int]) -> Tracklet:
    """Returns the detections with these indices, in order of time."""
    if len(indices) == len(tracklet.frames):
        return tracklet
    rows = (
        (tracklet.frames[i], tracklet.points[i], tracklet.looks[i]) for i in indices
    )
    frame, points, look = next(rows)
    piece = dataclasses.replace(tracklet, frames=[frame], points=[points], looks=[look])
    for row in rows:
        piece.extend(*row)
    return piece


def _stretches(
    looks: Float[np.ndarray, "n d"], first: int, last: int, window: int
) -> list[tuple[int, int]]:
    """Returns index ranges within `first` to `last` (exclusive) without an abrupt
    change, found by binary segmentation."""
    places = range(first + _MIN_DESCRIPTORS, last - _MIN_DESCRIPTORS + 1)
    ratios = [
        _change(looks[max(first, k - window) : k], looks[k : min(last, k + window)])
        for k in places
    ]
    if not ratios or max(ratios) < _MIN_CHANGE_SIGMAS:
        return [(first, last)]
    k = places[int(np.argmax(ratios))]
    before = mean_look(looks[max(first, k - window) : k])
    after = mean_look(looks[k : min(last, k + window)])
    stop, start = k, k
    while stop - first > 1 and not _is_of(looks[stop - 1], before, after):
        stop -= 1
    while last - start > 1 and not _is_of(looks[start], after, before):
        start += 1
    return [
        *_stretches(looks, first, stop, window),
        *_stretches(looks, start, last, window),
    ]


def _change(before: Float[np.ndarray, "n d"], after: Float[np.ndarray, "m d"]) -> float:
    """Returns the difference of the mean colours of two windows, in standard
    deviations; 0 if it is small or unknown."""
    one, other = mean_look(before), mean_look(after)
    apart = difference(one, other)
    if not apart >= _MIN_COLOUR_CHANGE:
        return 0.0
    variance = _MIN_COLOUR_SIGMA**2 + _scatter(before, one) + _scatter(after, other)
    return apart / float(np.sqrt(variance))


def _scatter(looks: Float[np.ndarray, "n d"], mean: Float[np.ndarray, " d"]) -> float:
    """Returns the mean square difference of descriptors from their mean. It is not
    divided by their number, as errors of successive frames are correlated."""
    return float(np.nanmean([difference(look, mean) ** 2 for look in looks]))


def _is_of(look: np.ndarray, own: np.ndarray, other: np.ndarray) -> bool:
    return difference(look, own) <= _MAX_OWN_SIDE_RATIO * difference(look, other)
