"""Tracklets -> people: re-identification after an occlusion or absence.

Offline, tracklets are cut where their colours change (`crossings`), and a piece that
ends and a later one that begins are joined if position, size and colours of clothes
agree. Of all ways to join them, the one of least total cost is taken.
"""

from itertools import pairwise

import numpy as np
from scipy.optimize import linear_sum_assignment

from bodyslam_jax.people.appearance import difference, mean_look
from bodyslam_jax.people.crossings import chosen, cut, part
from bodyslam_jax.people.regions import behind
from bodyslam_jax.people.tracking import (
    AWHILE,
    GROWTH,
    Tracklet,
    displacement,
    height,
)

_NEAR = 1.0
"""s: gaps up to which the position in the image is compared."""
_REACH = 0.2
"""Gate on the distance from the predicted position, of the person's height."""
_REACH_PER_SECOND = 1.2
_SAME_CLOTHES = 14.0
"""Difference of colours up to which a person after a long gap is the same."""
_CLOTHES_NEARBY = 22.0
"""The same after a short gap, where the position agrees too."""
_JUMP = 3.0
"""Distance, of the height, over which a detector may go from one person to another;
beyond it somebody left, and somebody came."""
_GROWTH = 2.0
"""Ratio of sizes before and after from which it is somebody else."""
_ENDS = 20
"""Frames at the end of a piece over which size is averaged."""


def link(tracklets: list[Tracklet], fps: float) -> list[list[Tracklet]]:
    """People, each as the pieces of them in order of time.

    Pieces of one tracklet that are one person's again are that tracklet, or the part of
    it from the first of them to the last.
    """
    tracklets = without_fragments(tracklets, fps)
    pieces = [piece for t in tracklets for piece in cut(t, fps)]
    if not pieces:
        return []
    gain = np.array([[join_cost(a, b, fps) for b in pieces] for a in pieces]) - 1
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
                person[-1] = part(all_of_it, start, stop, fps)
            else:
                person.append(pieces[j])
            i = j
        people.append(person)
    return people


def without_fragments(tracklets: list[Tracklet], fps: float) -> list[Tracklet]:
    """The tracklets without detections that only a part of somebody else explains.

    After a gap a track goes on with whoever is found near the expected place; that may
    be the limbs of a person who is found whole only afterwards, when a new track is
    followed backwards. Such detections, mostly covered by a surer one of another track,
    would be two people at one place at one time.
    """
    at: dict[int, list[tuple[int, np.ndarray]]] = {}
    for t in tracklets:
        for frame, points in zip(t.frames, t.points, strict=True):
            at.setdefault(frame, []).append((t.number, points))
    return [_without_fragments(t, at, fps) for t in tracklets]


def _without_fragments(
    tracklet: Tracklet, at: dict[int, list[tuple[int, np.ndarray]]], fps: float
) -> Tracklet:
    kept = list(range(len(tracklet.frames)))
    ends = [i for i, (a, b) in enumerate(pairwise(tracklet.frames)) if b - a > AWHILE]
    for i in ends:
        for j in range(i + 1, len(tracklet.frames)):
            if j > i + 1 and tracklet.frames[j] - tracklet.frames[j - 1] > AWHILE:
                break
            others = [
                points
                for number, points in at[tracklet.frames[j]]
                if number != tracklet.number
            ]
            if not _is_part(tracklet.points[j], others):
                break
            kept.remove(j)
    return chosen(tracklet, kept, fps)


def _is_part(points: np.ndarray, others: list[np.ndarray]) -> bool:
    """Whether a detection is mostly covered by a surer one."""
    if not others:
        return False
    every = np.stack([points, *others])
    return bool(behind(every, every[:, :, 2].mean(axis=1))[0])


def remarks(people: list[list[Tracklet]], fps: float, max_gap: float) -> list[str]:
    """Warnings: people re-identified after a gap of more than `max_gap` seconds, and
    people who are not, although another was lost nearby just before."""
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
            away = displacement(others[-1].expected(frame, fps), first.points[0])
            if away > _JUMP:
                continue
            where = f"{away:.1f} of their height away"
            found.append(
                f"person {number} begins in frame {frame}, {gap:.2g} s after person "
                f"{other} was lost, {where}: taken for somebody else."
            )
    return found


def join_cost(a: Tracklet, b: Tracklet, fps: float) -> float:
    """0 where `b` certainly continues `a`, 1 and more where it does not."""
    gap = b.frames[0] - a.frames[-1]
    if gap <= 0:
        return np.inf
    looks = difference(mean_look(np.stack(a.looks)), mean_look(np.stack(b.looks)))
    growth = abs(np.log(_size(a, last=True) / _size(b, last=False)))
    seconds = gap / fps
    growth /= np.log(_GROWTH if seconds > _NEAR else GROWTH)
    if seconds > _NEAR:
        clothes = looks / _SAME_CLOTHES if np.isfinite(looks) else np.inf
        return float(max(clothes, growth)) if max(clothes, growth) < 1 else np.inf
    place = displacement(a.expected(b.frames[0], fps), b.points[0])
    place /= _REACH + _REACH_PER_SECOND * seconds
    clothes = looks / _CLOTHES_NEARBY if np.isfinite(looks) else 0.5
    worst = max(place, clothes, growth)
    return float(0.5 * place + 0.5 * clothes) if worst < 1 else np.inf


def _cost_to_go_on(a: Tracklet, b: Tracklet) -> float:
    """Cost of joining two successive pieces of one tracklet, whose positions and sizes
    agree: others may explain them better, but a change of light also changes colours.
    """
    looks = difference(mean_look(np.stack(a.looks)), mean_look(np.stack(b.looks)))
    return 0.5 * looks / _CLOTHES_NEARBY


def _size(tracklet: Tracklet, *, last: bool) -> float:
    points = tracklet.points[-_ENDS:] if last else tracklet.points[:_ENDS]
    return float(np.median([height(p) for p in points]))
