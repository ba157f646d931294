"""Detects people whose displacement is not caused by their steps.

On wheels or in a boat people move without stepping; on a treadmill they step without
moving. The motion model predicts displacement from postures, so its prediction must not
determine the scale for such people. They are recognised by comparing predicted with
observed displacements, which needs a scale from another source: a static camera, the
ground, or a camera path in metres.
"""

import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax import graph, motion

_WINDOW_S = 1.0
"""Interval over which displacements are compared, s: they exceed the noise of depth."""
_MIN_SPEED_MPS = 0.5
"""Least of the larger of both speeds at which a person is classified, m/s."""
_MAX_DIFFERENCE = 0.75
"""Largest difference between both displacements, as a share of the larger one: it is 1
on a treadmill or on wheels, below 0.3 for people who walk, and 0.5 if the scale is
wrong by a factor of 2."""


def carried(
    state: graph.State,
    prediction: motion.Prediction,
    present: Bool[np.ndarray, "h t"],
    scale: float,
    fps: float,
) -> dict[int, tuple[float, float]]:
    """Returns the people whose displacement contradicts their steps, each with observed
    and predicted speed, m/s (medians over windows of a second).

    Args:
        present: frames in which people are present and cameras are registered.
        prediction: displacements by the motion model, m.
        scale: m per unit of the map, from other cues than people's motion; it has no
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
        window = max(2, round(_WINDOW_S * fps))
        speeds = _compare(step[h], position[h], valid[h], window)
        if speeds is None:
            continue
        observed, expected, difference = (float(x) * fps for x in speeds)
        larger = max(observed, expected)
        if larger > _MIN_SPEED_MPS and difference > _MAX_DIFFERENCE * larger:
            found[h] = (observed, expected)
    return found


def _compare(
    step: Float[np.ndarray, "t 3"],
    position: Float[np.ndarray, "t 3"],
    valid: Bool[np.ndarray, " t"],
    n: int,
) -> Float[np.ndarray, " 3"] | None:
    """Returns the lengths of the observed displacement, the predicted one and their
    difference, m per frame, as medians over windows of `n` frames; `None` without a
    complete window."""
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
    """Returns a warning for each person that `carried` found, for the report."""
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
