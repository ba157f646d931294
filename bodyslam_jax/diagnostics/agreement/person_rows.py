"""Merges rows of keypoints and rows of bodies into one row of each per person."""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax.types import Bodies, Keypoints, Sequence


@dataclasses.dataclass(frozen=True)
class Person:
    """The rows of keypoints and the rows of bodies that belong to one person."""

    keypoints: tuple[int, ...]
    bodies: tuple[int, ...]


def have_any(
    sequence: Sequence,
) -> tuple[Bool[np.ndarray, "k t"], Bool[np.ndarray, "b t"]]:
    """Returns for each row of keypoints, and for each row of bodies, the frames in
    which it is present."""
    nobody = np.zeros((0, sequence.num_frames), bool)
    keypoints, bodies = sequence.keypoints, sequence.bodies
    return (
        nobody if keypoints is None else np.any(keypoints.confidence > 0, axis=-1),
        nobody if bodies is None else bodies.present,
    )


def in_words(present: Bool[np.ndarray, "h t"], rows) -> str:
    """Returns the first and last frame of each of `rows` as text for warnings."""
    ends = sorted(tuple(np.flatnonzero(present[row])[[0, -1]].tolist()) for row in rows)
    spans = ", ".join(f"{first}-{last}" for first, last in ends[:6])
    more = f" and {len(ends) - 6} more" if len(ends) > 6 else ""
    return f"frames {spans}{more}"


def gathered(
    sequence: Sequence, persons: list[Person], apart: Float[np.ndarray, "t k b"]
) -> Sequence:
    """Returns the sequence with one row of keypoints and one of bodies for each of
    `persons`.

    If this changes nothing, the sequence itself is returned.

    Args:
        apart: distance in the image between each row of keypoints and each row of
            projected bodies, in each frame, in sizes of a person; NaN or infinite where
            they cannot be compared.
    """
    keypoints, bodies = sequence.keypoints, sequence.bodies
    rows = [len(x.confidence) for x in (keypoints,) if x is not None]
    rows += [len(x.present) for x in (bodies,) if x is not None]
    as_is = all(
        p.keypoints in ((), (i,)) and p.bodies in ((), (i,))
        for i, p in enumerate(persons)
    )
    if as_is and all(n == len(persons) for n in rows):
        return sequence
    if keypoints is not None:
        keypoints = _keypoints(keypoints, persons)
    if bodies is not None:
        bodies = _bodies(bodies, persons, apart)
    return dataclasses.replace(sequence, keypoints=keypoints, bodies=bodies)


def _keypoints(keypoints: Keypoints, persons: list[Person]) -> Keypoints:
    """Merges the keypoint rows of each person into one.

    Where several rows have keypoints in the same frame, those of the row with the
    largest sum of confidences over the video are used.
    """
    shape = (len(persons), *keypoints.confidence.shape[1:])
    uv, confidence = np.zeros((*shape, 2)), np.zeros(shape)
    sure = keypoints.confidence.sum((1, 2))
    for i, person in enumerate(persons):
        for k in sorted(person.keypoints, key=lambda k: float(sure[k])):
            at = (keypoints.confidence[k] > 0).any(-1)
            uv[i, at] = keypoints.uv[k, at]
            confidence[i, at] = keypoints.confidence[k, at]
    return dataclasses.replace(keypoints, uv=uv, confidence=confidence)


def _bodies(bodies: Bodies, persons: list[Person], apart) -> Bodies:
    """Merges the body rows of each person into one.

    Where several rows have a body in the same frame, the row with the smallest mean
    distance from the person's keypoints over the video is used; for a person without
    keypoints, the row that is present in most frames.
    """
    names = ("present", "poses", "shapes", "trans")
    arrays = {name: getattr(bodies, name) for name in names}
    out = {
        name: np.zeros((len(persons), *a.shape[1:]), a.dtype)
        for name, a in arrays.items()
    }
    t = bodies.present.shape[1]
    for i, person in enumerate(persons):
        if not person.bodies:
            continue
        rows = list(person.bodies)
        count = bodies.present[rows].sum(1)
        cost = np.broadcast_to(-1e-3 * count / t, (t, len(rows)))
        if person.keypoints:
            near = apart[:, list(person.keypoints)][:, :, rows]
            near = np.where(np.isfinite(near), near, np.inf).min(1)
            present = np.isfinite(near).sum(0)
            total = np.where(np.isfinite(near), near, 0.0).sum(0)
            cost = cost + np.where(present > 0, total / np.maximum(present, 1), 1e3)
        best = np.where(bodies.present[rows].T, cost, np.inf).argmin(1)
        row = np.array(rows)[best]
        for name, array in arrays.items():
            out[name][i] = array[row, np.arange(t)]
    return dataclasses.replace(bodies, **out)
