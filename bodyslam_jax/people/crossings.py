"""Tracklets cut where a detector went over from one person to another.

Where two people overlap in the image, a detector often finds only the one in front, and
a tracklet of the one behind goes on with the other's keypoints: neither position nor
size changes. The colours of the clothes do, from before to after, by more than their
measured noise. Tracklets are cut there; whose piece is whose is decided afterwards, for
all pieces together (`linking`), which also rejoins a piece that nobody else explains.
"""

import numpy as np
from jaxtyping import Float

from bodyslam_jax.people.appearance import difference, mean_look
from bodyslam_jax.people.tracking import Tracklet

_WINDOW = 0.33
"""s: time before and after a change over which colours are averaged. A slow change, as
of the light, is small over twice this time."""
_FEWEST = 5
"""Least number of descriptors on each side of a cut."""
_LEAST_CHANGE = 10.0
"""Difference of colours (`appearance.difference`) below which nothing is cut."""
_LEAST_RATIO = 2.5
"""Least change of colours in standard deviations. Exchanged people had 3.6; the
largest of each of 26 tracklets of one person was 0.6 to 3.0."""
_FLOOR = 2.0
"""Standard deviation of colours beyond that within both windows."""
_CLEARLY = 0.5
"""Distance of a frame's colours from those of its own side, of the distance from those
of the other side, up to which the frame belongs to its side."""


def cut(tracklet: Tracklet, fps: float) -> list[Tracklet]:
    """Pieces of a tracklet between abrupt changes of clothes; itself if none changes.

    Frames at a cut whose colours are unknown or could be of either side are in no
    piece.
    """
    known = [k for k, look in enumerate(tracklet.looks) if np.isfinite(look).any()]
    if len(known) < 2 * _FEWEST:
        return [tracklet]
    looks = np.stack([tracklet.looks[k] for k in known])
    window = max(_FEWEST, round(_WINDOW * fps))
    stretches = _stretches(looks, 0, len(known), window)
    starts = [0, *(known[first] for first, _ in stretches[1:])]
    stops = [*(known[last - 1] + 1 for _, last in stretches[:-1]), len(tracklet.frames)]
    return [part(tracklet, i, j, fps) for i, j in zip(starts, stops, strict=True)]


def part(tracklet: Tracklet, start: int, stop: int, fps: float) -> Tracklet:
    """The detections of indices `start` to `stop` (exclusive), with the velocity at
    their end."""
    return chosen(tracklet, list(range(start, stop)), fps)


def chosen(tracklet: Tracklet, indices: list[int], fps: float) -> Tracklet:
    """The detections of these indices, in order of time."""
    if len(indices) == len(tracklet.frames):
        return tracklet
    rows = (
        (tracklet.frames[i], tracklet.points[i], tracklet.looks[i]) for i in indices
    )
    frame, points, look = next(rows)
    piece = Tracklet(tracklet.number, [frame], [points], [look])
    for row in rows:
        piece.extend(*row, fps)
    return piece


def _stretches(
    looks: Float[np.ndarray, "n d"], first: int, last: int, window: int
) -> list[tuple[int, int]]:
    """Index ranges within `first` to `last` (exclusive) without an abrupt change, found
    by binary segmentation."""
    places = range(first + _FEWEST, last - _FEWEST + 1)
    ratios = [
        _change(looks[max(first, k - window) : k], looks[k : min(last, k + window)])
        for k in places
    ]
    if not ratios or max(ratios) < _LEAST_RATIO:
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
    """Difference of the mean colours of two windows, in standard deviations; 0 if it is
    small or unknown."""
    one, other = mean_look(before), mean_look(after)
    apart = difference(one, other)
    if not apart >= _LEAST_CHANGE:
        return 0.0
    variance = _FLOOR**2 + _scatter(before, one) + _scatter(after, other)
    return apart / float(np.sqrt(variance))


def _scatter(looks: Float[np.ndarray, "n d"], mean: Float[np.ndarray, " d"]) -> float:
    """Mean square difference of descriptors from their mean. It is not divided by their
    number, as errors of successive frames are alike."""
    return float(np.nanmean([difference(look, mean) ** 2 for look in looks]))


def _is_of(look: np.ndarray, own: np.ndarray, other: np.ndarray) -> bool:
    return difference(look, own) <= _CLEARLY * difference(look, other)
