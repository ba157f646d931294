"""People whose displacement has another cause than their steps.

On wheels or in a boat people move without stepping; on a treadmill they step without
moving. The motion model predicts displacement from postures, so its prediction must not
determine the scale for such people. They are recognised by comparing predicted with
observed displacements, which needs a scale from elsewhere: a static camera, the ground,
or a camera path in metres.
"""

import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax import graph, motion

_WINDOW = 1.0
"""s: displacements over this time are larger than the noise of depth."""
_MIN_SPEED = 0.5
"""m/s: below it, in both displacements, nothing is concluded."""
_MAX_DIFFERENCE = 0.75
"""Difference of the displacements as a share of the larger one: 1 on a treadmill or on
wheels, below 0.3 of people who walk, 0.5 if the scale is wrong by a factor of 2."""


def carried(
    state: graph.State,
    prediction: motion.Prediction,
    present: Bool[np.ndarray, "h t"],
    scale: float,
    fps: float,
) -> dict[int, tuple[float, float]]:
    """People whose displacement is not that of their steps: observed and predicted
    speed of each, m/s (medians over windows of a second).

    Args:
        present: frames in which people are present and cameras are registered.
        scale: m per unit of the map, from other cues than people's motion; without
            effect for a static camera.
    """
    C_WC = np.asarray(state.cameras[:, :3, :3])
    roots = np.asarray(state.roots)
    C_WH = np.einsum("tij,htjk->htik", C_WC, roots[..., :3, :3])
    position = scale * np.asarray(state.cameras[:, :3, 3])
    position = position + np.einsum("tij,htj->hti", C_WC, roots[..., :3, 3])
    previous = np.concatenate([C_WH[:, :1], C_WH[:, :-1]], axis=1)
    predicted = np.asarray(prediction.translation, float)
    step = np.einsum("htab,htb->hta", previous, predicted)
    valid = np.asarray(prediction.valid) & present
    found = {}
    for h in range(len(step)):
        window = max(2, round(_WINDOW * fps))
        speeds = _compare(step[h], position[h], valid[h], window)
        if speeds is None:
            continue
        observed, expected, difference = (float(x) * fps for x in speeds)
        larger = max(observed, expected)
        if larger > _MIN_SPEED and difference > _MAX_DIFFERENCE * larger:
            found[h] = (observed, expected)
    return found


def _compare(
    step: Float[np.ndarray, "t 3"],
    position: Float[np.ndarray, "t 3"],
    valid: Bool[np.ndarray, " t"],
    n: int,
) -> Float[np.ndarray, " 3"] | None:
    """Medians over windows of `n` frames, m per frame: of the observed displacement, of
    the predicted one, and of their difference; `None` without a complete window."""
    if len(step) <= n:
        return None
    walked = np.cumsum(np.where(valid[:, None], step, 0.0), axis=0)
    gaps = np.cumsum(~valid)
    whole = gaps[n:] == gaps[:-n]
    if whole.sum() < 3:
        return None
    expected = (walked[n:] - walked[:-n])[whole]
    observed = (position[n:] - position[:-n])[whole]
    each = np.linalg.norm([observed, expected, observed - expected], axis=-1)
    return np.median(each, axis=-1) / n


def lines_of_carried(found: dict[int, tuple[float, float]]) -> tuple[str, ...]:
    """A warning for each of these people, for the report."""
    lines = []
    for h, (observed, expected) in found.items():
        line = (
            f"person {h} moves at {observed:.1f} m/s where their posture predicts "
            f"{expected:.1f}: on a treadmill, on wheels or carried, or sizes are wrong "
            "by as much; the person's steps are not used."
        )
        if observed > expected:
            line += (
                " Feet above the ground, as on a bicycle, make all lengths too small."
            )
        lines.append(line)
    return tuple(lines)
