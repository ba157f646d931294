"""Tracklets -> people: re-identification after an occlusion or absence.

Offline, a tracklet that ends and a later one that begins are joined if position, size
and colours of clothes agree. Pairs of least cost are joined first.
"""

import dataclasses
from itertools import pairwise

import numpy as np

from bodyslam_jax.people.appearance import difference, mean_look
from bodyslam_jax.people.tracking import GROWTH, Tracklet, displacement, height

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


@dataclasses.dataclass(frozen=True)
class _Joint:
    first: int
    second: int
    cost: float


def link(tracklets: list[Tracklet], fps: float) -> list[list[Tracklet]]:
    """People, each as the pieces of them in order of time."""
    joints = []
    for i, a in enumerate(tracklets):
        for j, b in enumerate(tracklets):
            cost = join_cost(a, b, fps)
            if cost < 1:
                joints.append(_Joint(i, j, cost))
    chains = [[i] for i in range(len(tracklets))]
    chain_of = list(range(len(tracklets)))
    for joint in sorted(joints, key=lambda q: (q.cost, q.first, q.second)):
        a, b = chain_of[joint.first], chain_of[joint.second]
        # Both ends must still be free: one piece follows one.
        if a == b or chains[a][-1] != joint.first or chains[b][0] != joint.second:
            continue
        for piece in chains[b]:
            chain_of[piece] = a
        chains[a], chains[b] = chains[a] + chains[b], []
    return [[tracklets[i] for i in chain] for chain in chains if chain]


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


def _size(tracklet: Tracklet, *, last: bool) -> float:
    points = tracklet.points[-_ENDS:] if last else tracklet.points[:_ENDS]
    return float(np.median([height(p) for p in points]))
