"""Assigns rows of keypoints and bodies to people: one row per person.

Trackers lose people and find them again under another number, or follow one person
twice. As keypoints and bodies usually come from different programs, each kind shows
which rows of the other belong together.
"""

import functools
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from bodyslam_jax.body import BodyModel
from bodyslam_jax.diagnostics.agreement.image_points import (
    centred,
    distances,
    people_of,
    project,
)
from bodyslam_jax.diagnostics.agreement.person_rows import (
    Person,
    gathered,
    have_any,
    in_words,
)
from bodyslam_jax.types import Sequence

_MAX_PAIR_DISTANCE = 0.3
"""Distance, in sizes of a person, up to which keypoints and bodies belong to one
person."""
_MAX_DUPLICATE_DISTANCE = 0.15
"""Distance, in sizes of a person, below which two rows of one kind follow the same
person."""
_MAX_OVERLAP_SHARE = 0.15
"""Share of the frames that two rows of one person may have in common."""
_MIN_COINCIDENT_SHARE = 0.8
"""Share of the frames that two rows share in which they must be that near."""
_MIN_SHARED_FRAMES = 3
_MAX_GAP_FRAMES = 5
"""Gap, in frames, up to which a person without keypoints is recognised by position."""
_SAME_ROW_BONUS = 0.05
"""Distance, in sizes of a person, by which other keypoints must be nearer than those of
the same row."""

Warn = Callable[[str], None]


def settle_identities(sequence: Sequence, body: BodyModel, warn: Warn) -> Sequence:
    """Returns the sequence with one row per person; unchanged if it has that
    already."""
    people = people_of(sequence, body)
    projected = project(people.camera, people.bodies)
    present = have_any(sequence)
    apart = distances(people.keypoints, projected)
    persons = _pair(apart, present)
    persons = _joined(persons, apart, (people.keypoints, projected), present)
    persons = _attached(persons, apart, projected, present[1])
    _say_who_is_one(persons, present, warn)
    persons = _worth_keeping(persons, sequence, projected, apart, present, warn)
    return gathered(sequence, persons, apart)


def _pair(apart, present) -> list[Person]:
    """Returns the people with keypoints, with the bodies that fit them best, then those
    with bodies only.

    Rows of the same number stay together unless other keypoints fit clearly better.
    """
    seen_at, posed_at = present
    middle, count = _medians(apart)
    persons = [Person((int(k),), ()) for k in np.flatnonzero(seen_at.any(1))]
    free = set(np.flatnonzero(posed_at.any(1)).tolist())
    own = np.eye(*middle.shape, dtype=bool)
    cost = np.where(count >= _MIN_SHARED_FRAMES, middle, np.inf) - _SAME_ROW_BONUS * own
    # Rows that share no frame do not contradict each other.
    cost = np.where(own & (count == 0), _MAX_PAIR_DISTANCE - 0.01, cost)
    paired: dict[int, int] = {}
    for at in np.argsort(cost, axis=None, kind="stable"):
        k, b = (int(i) for i in np.unravel_index(at, cost.shape))
        if (
            cost[k, b] < _MAX_PAIR_DISTANCE
            and b in free
            and k not in paired
            and seen_at[k].any()
        ):
            paired[k] = b
            free.remove(b)
    persons = [
        Person(p.keypoints, (paired[p.keypoints[0]],))
        if p.keypoints[0] in paired
        else p
        for p in persons
    ]
    return [*persons, *(Person((), (b,)) for b in sorted(free))]


def _joined(persons, apart, points, present) -> list[Person]:
    """Merges people whose keypoints or bodies coincide, unless they are at two places
    at once."""
    middle, count = _medians(apart)
    # Rows of a frame or two count with all their frames.
    detected, projected = (at.sum(1) for at in present)
    enough = np.minimum(_MIN_SHARED_FRAMES, np.minimum(detected[:, None], projected))
    fits = (count >= np.maximum(enough, 1)) & (middle < _MAX_PAIR_DISTANCE)

    @functools.cache
    def same_place(kind: int, rows_a, rows_b) -> bool:
        return _same_place(points[kind], rows_a, rows_b, present[kind])

    def linked(a: Person, b: Person) -> bool:
        crossed = [fits[np.ix_(x.keypoints, y.bodies)] for x, y in ((a, b), (b, a))]
        return any(bool(c.any()) for c in crossed)

    def at_two_places(kind: int, rows_a, rows_b) -> bool:
        if not rows_a or not rows_b:
            return False
        a, b = (present[kind][list(rows)].any(0) for rows in (rows_a, rows_b))
        if (a & b).sum() <= _MAX_OVERLAP_SHARE * min(a.sum(), b.sum()):
            return False
        return not same_place(kind, rows_a, rows_b)

    def one(a: Person, b: Person) -> bool:
        kinds = ((0, a.keypoints, b.keypoints), (1, a.bodies, b.bodies))
        measured = linked(a, b) or any(
            x and y and same_place(kind, x, y) for kind, x, y in kinds
        )
        return measured and not any(at_two_places(*kind) for kind in kinds)

    done: list[Person] = []
    waiting = list(persons)
    while waiting:
        person = waiting.pop(0)
        other = next((p for p in (*done, *waiting) if one(person, p)), None)
        if other is None:
            done.append(person)
            continue
        (done if other in done else waiting).remove(other)
        joined = Person(
            tuple(sorted((*person.keypoints, *other.keypoints))),
            tuple(sorted((*person.bodies, *other.bodies))),
        )
        waiting.insert(0, joined)
    return done


def _attached(persons, apart, projected, posed_at) -> list[Person]:
    """Merges bodies in frames without keypoints into the rows that they continue."""
    shape = centred(projected)
    lone = [
        p
        for p in persons
        if not p.keypoints and not np.isfinite(apart[:, :, list(p.bodies)]).any()
    ]
    kept = [p for p in persons if p not in lone]
    for person in sorted(lone, key=lambda p: int(_frames(posed_at, p)[0])):
        own = _frames(posed_at, person)
        for other in [p for p in kept if p.bodies]:
            theirs = _frames(posed_at, other)
            before, after = theirs[theirs < own[0]], theirs[theirs > own[-1]]
            links = []
            if len(before):
                links.append(((before[-1], other.bodies), (own[0], person.bodies)))
            if len(after):
                links.append(((own[-1], person.bodies), (after[0], other.bodies)))
            apart_in_time = not np.isin(own, theirs).any()
            if apart_in_time and any(
                start[0] - end[0] <= _MAX_GAP_FRAMES and _goes_on(*shape, end, start)
                for end, start in links
            ):
                kept.remove(other)
                both = tuple(sorted((*other.bodies, *person.bodies)))
                kept.append(Person(other.keypoints, both))
                break
        else:
            kept.append(person)
    return kept


def _frames(posed_at, person: Person) -> np.ndarray:
    return np.flatnonzero(posed_at[list(person.bodies)].any(0))


def _goes_on(middle, radius, end, start) -> bool:
    """Returns whether the start of one row fits the end of another in position and
    size."""
    (last, before), (first, after) = end, start
    a = next((r for r in before if np.isfinite(radius[last, r])), None)
    b = next((r for r in after if np.isfinite(radius[first, r])), None)
    if a is None or b is None:
        return False
    moved = np.linalg.norm(middle[first, b] - middle[last, a]) / radius[last, a]
    ratio = radius[first, b] / radius[last, a]
    return bool(moved < 0.3 + 0.1 * (first - last) and 0.8 < ratio < 1.25)


def _same_place(points, rows_a, rows_b, present) -> bool:
    """Returns whether two people coincide in most of the frames that they share."""
    shared = present[list(rows_a)].any(0) & present[list(rows_b)].any(0)
    fewest = min(present[list(rows)].any(0).sum() for rows in (rows_a, rows_b))
    if shared.sum() <= max(_MIN_SHARED_FRAMES, _MAX_OVERLAP_SHARE * fewest):
        return False
    both = points[shared]
    gap = distances(both[:, list(rows_a)], both[:, list(rows_b)])
    near = (np.where(np.isfinite(gap), gap, np.inf) < _MAX_DUPLICATE_DISTANCE).any(
        (1, 2)
    )
    return bool(near.mean() >= _MIN_COINCIDENT_SHARE)


def _say_who_is_one(persons, present, warn: Warn) -> None:
    """Warns of people whose keypoints or bodies are distributed over several rows."""
    for person in persons:
        kinds = ("keypoints", person.keypoints), ("bodies", person.bodies)
        for (what, rows), at in zip(kinds, present, strict=True):
            if len(rows) < 2:
                continue
            twice = int((at[list(rows)].sum(0) > 1).sum())
            also = f", in {twice} frames twice" if twice else ""
            warn(
                f"{what} of {len(rows)} numbers are of one person{also}: "
                f"{in_words(at, rows)}; taken together, by where they are in the image."
            )


def _worth_keeping(persons, sequence, projected, apart, present, warn) -> list[Person]:
    """Removes people who have no data or are outside the image, with a warning."""
    width, height = sequence.intrinsics.width, sequence.intrinsics.height
    seen_at, posed_at = present
    for row in range(max(len(seen_at), len(posed_at))):
        if not seen_at[row : row + 1].any() and not posed_at[row : row + 1].any():
            warn(f"person {row} has neither keypoints nor bodies: left out.")
    kept = []
    for person in persons:
        rows = list(person.bodies)
        if person.keypoints or not seen_at.any():
            kept.append(person)
            continue
        u, v = np.moveaxis(projected[:, rows], -1, 0)
        inside = ((u >= 0) & (u < width) & (v >= 0) & (v < height)).any((1, 2))
        share = float((~inside[posed_at[rows].any(0)]).mean())
        who = f"bodies of {in_words(posed_at, rows)}"
        if share > 0.5:
            warn(
                f"{who} are outside the image in {100 * share:.0f} % of their frames, "
                "and without keypoints: left out."
            )
            continue
        near = apart[:, :, rows]
        near = near[np.isfinite(near)]
        far = (
            f"the nearest keypoints are {np.median(near):.1f} of a person's size away"
            if len(near)
            else "there are none in their frames"
        )
        warn(
            f"{who} have no keypoints: {far} (median); taken as a person whom the "
            "detector of keypoints did not find."
        )
        kept.append(person)
    first = lambda p: ((p.keypoints or p.bodies)[0], not p.keypoints)
    return sorted(kept, key=first)


def _medians(apart: Float[np.ndarray, "t k b"]):
    """Returns the median distance of each pair of rows over frames, and the number of
    frames in which they can be compared."""
    count = np.isfinite(apart).sum(0)
    if not len(apart):
        return np.full(count.shape, np.inf), count
    ordered = np.sort(apart, axis=0)  # NaN last
    at = np.maximum((count - 1) // 2, 0)
    middle = np.take_along_axis(ordered, at[None], axis=0)[0]
    return np.where(count > 0, middle, np.inf), count
