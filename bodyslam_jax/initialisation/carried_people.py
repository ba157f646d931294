"""Who does not move as they step: on wheels, on a treadmill, carried, in water.

The motion model predicts from postures how far a person gets. Where something else
carries the person, or nothing does although they step, that is no error of the model
but another cause of motion, and must not decide the size of the scene. Both are known
where the camera stands still, or where the ground or a metric path tells the scale.
"""

import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax import graph, motion

_SECOND = 1.0
"""Windows over which displacements are compared, s: noise of depth is less than they
are."""
_MOVES = 0.5
"""m/s: whoever neither steps nor moves as fast is not judged."""
_APART = 0.75
"""Difference of the displacements, as a share of the greater: 1 on a treadmill and of
who sits and rolls, below 0.3 of who walks; a scale that is off by 2 makes 0.5 of it."""


def carried(
    state: graph.State,
    seen: motion.Prediction,
    there: Bool[np.ndarray, "h t"],
    scale: float,
    fps: float,
) -> dict[int, tuple[float, float]]:
    """People whom their steps do not carry: how fast they move, and how fast their
    posture says, m/s (medians over windows of a second).

    Args:
        there: frames in which people are, and cameras are located.
        scale: m per unit of the map, by other cues than people's motion; of no effect
            where the camera stands still.
    """
    C_WC = np.asarray(state.cameras[:, :3, :3])
    roots = np.asarray(state.roots)
    turn = np.einsum("tij,htjk->htik", C_WC, roots[..., :3, :3])
    place = scale * np.asarray(state.cameras[:, :3, 3])
    place = place + np.einsum("tij,htj->hti", C_WC, roots[..., :3, 3])
    before = np.concatenate([turn[:, :1], turn[:, :-1]], axis=1)
    step = np.einsum("htab,htb->hta", before, np.asarray(seen.translation, float))
    known = np.asarray(seen.valid) & there
    found = {}
    for h in range(len(step)):
        figures = _compare(step[h], place[h], known[h], max(2, round(_SECOND * fps)))
        if figures is None:
            continue
        moves, says, apart = (float(x) * fps for x in figures)
        greater = max(moves, says)
        if greater > _MOVES and apart > _APART * greater:
            found[h] = (moves, says)
    return found


def _compare(
    step: Float[np.ndarray, "t 3"],
    place: Float[np.ndarray, "t 3"],
    known: Bool[np.ndarray, " t"],
    n: int,
) -> Float[np.ndarray, " 3"] | None:
    """Medians over windows of `n` frames, m per frame: how far a person moves, how far
    the steps go, and how far apart the two are; `None` without a window."""
    if len(step) <= n:
        return None
    walked = np.cumsum(np.where(known[:, None], step, 0.0), axis=0)
    gaps = np.cumsum(~known)
    whole = gaps[n:] == gaps[:-n]
    if whole.sum() < 3:
        return None
    says = (walked[n:] - walked[:-n])[whole]
    moves = (place[n:] - place[:-n])[whole]
    each = np.linalg.norm([moves, says, moves - says], axis=-1)
    return np.median(each, axis=-1) / n


def lines_of_carried(found: dict[int, tuple[float, float]]) -> tuple[str, ...]:
    """A line for each of those people, for the report."""
    lines = []
    for h, (moves, says) in found.items():
        line = (
            f"person {h} moves at {moves:.1f} m/s where the posture says {says:.1f}: "
            "on a treadmill, on wheels or carried, or sizes are off by as much; the "
            "person's steps have no part in the estimate."
        )
        if moves > says:
            line += (
                " Feet that are above the ground, as on a bicycle, make all lengths "
                "too small."
            )
        lines.append(line)
    return tuple(lines)
