"""Links tracklets to people: re-identification after an occlusion or absence.

Tracklets are cut where their colours change (`crossings`), and a piece that ends is
joined to a later one that begins if position, size and colours of clothes agree. Of all
ways to join them, the one with the least total cost is chosen.
"""

from itertools import pairwise

import numpy as np
from scipy.optimize import linear_sum_assignment

from bodyslam_jax.people.crossings import chosen, cut, part
from bodyslam_jax.people.movenet import height
from bodyslam_jax.people.regions import behind
from bodyslam_jax.tracking.appearance import difference, mean_look
from bodyslam_jax.tracking.tracker import (
    LONG_GAP_FRAMES,
    MAX_SIZE_RATIO,
    Tracklet,
    displacement,
)

_SHORT_GAP_S = 1.0
"""Gap up to which the position in the image is compared."""
_GATE_HEIGHTS, _GATE_GROWTH_HEIGHTS_PER_S = 0.3, 1.2
"""Gate on the distance from the predicted position, relative to the person's height,
and its growth with time. Both are twice the tracker's or nearly so, as colours must
agree more closely (`benchmarks/video.md`)."""
_MAX_COLOUR_DIFFERENCE = 14.0
"""Difference of colours up to which a person after a long gap is the same."""
_MAX_NEARBY_COLOUR_DIFFERENCE = 22.0
"""The same after a short gap, where the position agrees too."""
_MAX_JUMP_HEIGHTS = 3.0
"""Distance, relative to the height, over which a detector may switch from one person to
another; beyond it somebody left and somebody else came."""
_MAX_LONG_GAP_SIZE_RATIO = 2.0
"""Ratio of sizes before and after a long gap from which it is somebody else."""
_END_FRAMES = 20
"""Number of frames at the end of a piece over which its size is averaged."""


def link(tracklets: list[Tracklet]) -> list[list[Tracklet]]:
    """Returns the people, each as a list of pieces in order of time.

    Successive pieces of one tracklet that belong to the same person are merged into the
    original tracklet, or its part from the first piece to the last.
    """
    tracklets = without_fragments(tracklets)
    pieces = [piece for t in tracklets for piece in cut(t)]
    if not pieces:
        return []
    gain = np.array([[join_cost(a, b) for b in pieces] for a in pieces]) - 1
    goes_on = {i for i, (a, b) in enumerate(pairwise(pieces)) if a.number == b.number}
    for i in goes_on:
        gain[i, i + 1] = _cost_to_go_on(pieces[i], pieces[i + 1]) - 1
    rows, columns = linear_sum_assignment(np.minimum(gain, 0))
    joined = gain[rows, columns] < 0
    after = dict(zip(rows[joined].tolist(), columns[joined].tolist(), strict=True))
    whole = {t.number: t for t in tracklets}
    people = []
    for i in sorted(set(range(len(pieces))) - set(after.values())):
        person = [pieces[i]]
        while i in after:
            j = after[i]
            if i in goes_on and j == i + 1:
                all_of_it = whole[pieces[i].number]
                start = all_of_it.frames.index(person[-1].frames[0])
                stop = all_of_it.frames.index(pieces[j].frames[-1]) + 1
                person[-1] = part(all_of_it, start, stop)
            else:
                person.append(pieces[j])
            i = j
        people.append(person)
    return people


def without_fragments(tracklets: list[Tracklet]) -> list[Tracklet]:
    """Returns the tracklets without detections that only a part of another person
    explains.

    After a gap a track continues with whoever is found near the expected position;
    these may be limbs of a person who is detected completely only later, when a new
    track is followed backwards. Such detections, mostly covered by a more confident one
    of another track, would be two people at one place at one time.
    """
    at: dict[int, list[tuple[int, np.ndarray]]] = {}
    for t in tracklets:
        for frame, points in zip(t.frames, t.points, strict=True):
            at.setdefault(frame, []).append((t.number, points))
    return [_without_fragments(t, at) for t in tracklets]


def _without_fragments(
    tracklet: Tracklet, at: dict[int, list[tuple[int, np.ndarray]]]
) -> Tracklet:
    kept = list(range(len(tracklet.frames)))
    ends = [
        i
        for i, (a, b) in enumerate(pairwise(tracklet.frames))
        if b - a > LONG_GAP_FRAMES
    ]
    for i in ends:
        for j in range(i + 1, len(tracklet.frames)):
            if (
                j > i + 1
                and tracklet.frames[j] - tracklet.frames[j - 1] > LONG_GAP_FRAMES
            ):
                break
            others = [
                points
                for number, points in at[tracklet.frames[j]]
                if number != tracklet.number
            ]
            if not _is_part(tracklet.points[j], others):
                break
            kept.remove(j)
    return chosen(tracklet, kept)


def _is_part(points: np.ndarray, others: list[np.ndarray]) -> bool:
    """Returns whether a detection is mostly covered by a more confident one."""
    if not others:
        return False
    every = np.stack([points, *others])
    return bool(behind(every, every[:, :, 2].mean(axis=1))[0])


def remarks(people: list[list[Tracklet]], fps: float, max_gap: float) -> list[str]:
    """Returns warnings about people re-identified after a gap of more than `max_gap`
    seconds, and about people who were not, although another was lost nearby just
    before."""
    found = []
    for number, pieces in enumerate(people):
        for a, b in pairwise(pieces):
            last, first = a.frames[-1], b.frames[0]
            if first - last > max_gap * fps:
                found.append(
                    f"person {number}: not seen from frame {last + 1} to {first - 1}; "
                    "taken for the same by clothes and size."
                )
        first = pieces[0]
        for other, others in enumerate(people):
            gap = (first.frames[0] - others[-1].frames[-1]) / fps
            if other == number or not 0 < gap <= max_gap:
                continue
            frame = first.frames[0]
            away = _apart(others[-1], first)
            if away > _MAX_JUMP_HEIGHTS:
                continue
            where = f"{away:.1f} of their height away"
            found.append(
                f"person {number} begins in frame {frame}, {gap:.2g} s after person "
                f"{other} was lost, {where}: taken for somebody else."
            )
    return found


def join_cost(a: Tracklet, b: Tracklet) -> float:
    """Returns the cost of joining two pieces: 0 where `b` certainly continues `a`, 1
    and more where it does not."""
    gap = b.frames[0] - a.frames[-1]
    if gap <= 0:
        return np.inf
    looks = difference(mean_look(np.stack(a.looks)), mean_look(np.stack(b.looks)))
    growth = abs(np.log(_size(a, last=True) / _size(b, last=False)))
    seconds = gap / a.fps
    growth /= np.log(
        _MAX_LONG_GAP_SIZE_RATIO if seconds > _SHORT_GAP_S else MAX_SIZE_RATIO
    )
    if seconds > _SHORT_GAP_S:
        clothes = looks / _MAX_COLOUR_DIFFERENCE if np.isfinite(looks) else np.inf
        return float(max(clothes, growth)) if max(clothes, growth) < 1 else np.inf
    place = _apart(a, b) / (_GATE_HEIGHTS + _GATE_GROWTH_HEIGHTS_PER_S * seconds)
    clothes = looks / _MAX_NEARBY_COLOUR_DIFFERENCE if np.isfinite(looks) else 0.5
    worst = max(place, clothes, growth)
    return float(0.5 * place + 0.5 * clothes) if worst < 1 else np.inf


def _cost_to_go_on(a: Tracklet, b: Tracklet) -> float:
    """Returns the cost of joining two successive pieces of one tracklet, whose
    positions and sizes agree: others may explain them better, but a change of light
    also changes colours."""
    looks = difference(mean_look(np.stack(a.looks)), mean_look(np.stack(b.looks)))
    return 0.5 * looks / _MAX_NEARBY_COLOUR_DIFFERENCE


def _apart(a: Tracklet, b: Tracklet) -> float:
    """Returns the distance of the first keypoints of `b` from those that `a` predicts,
    relative to the person's size."""
    first, least = b.points[0], a.kind.min_confidence
    return float(displacement(a.expected(b.frames[0])[None], first[None], least)[0, 0])


def _size(tracklet: Tracklet, *, last: bool) -> float:
    points = tracklet.points[-_END_FRAMES:] if last else tracklet.points[:_END_FRAMES]
    return float(np.median([height(p) for p in points]))
