"""Frames in which a regressor confuses front and back, corrected by a Markov model.

A hidden Markov model with two states: the body as given, and rotated by π about its own
vertical axis.

- Transitions: continuity of the orientation is evidence only of a *change* of state
  between two frames. The rotation between frames is whitened by the jitter around it,
  so that a noisy regressor does not cause changes.
- Emissions: the reprojection error of the keypoints in either state, whitened by its
  own median. The detector may exchange left and right, and the evidence of a single
  frame is bounded, as all its keypoints may be wrong.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import median_filter

from bodyslam_jax.people.sides import ARMS, LEGS
from bodyslam_jax.people.viterbi import cheapest_states

HALF_TURN = np.diag([-1.0, 1.0, -1.0])
"""About H's y axis."""
_PRIOR = 3.0
"""-log odds of front-back confusion, per correlation time of the errors."""
_EXCHANGED = 4.0
"""-log odds that a detector exchanged left and right of the arms, or of the legs."""
_ALL_WRONG = 8.0
"""-log odds that all keypoints of a frame are wrong: bounds a frame's evidence."""
_LASTING = 1 / 3
"""s: correlation time of errors of keypoints and postures; frames within it count
once."""
_TURN_SPEED = 2.0
"""rad/s, per axis: how fast people turn."""
_JUMP_SCALE = 5.0
"""Scale of the robust loss on rotations between frames, in standard deviations: bounds
their evidence at half its square."""
_WINDOW = 5
"""Frames within which the jitter of orientations is measured."""
_MEDIAN_OF_THREE = 1.538
"""Median length of a vector with three normal components of deviation 1."""
_MEDIAN_OF_TWO = 1.386
"""Median squared length of one with two."""


@dataclasses.dataclass(frozen=True)
class Facing:
    """The decoded states and the noise level they were decoded with."""

    turned: Bool[np.ndarray, " f"]
    """Frames whose body is to be rotated by π."""
    keypoint_noise: float
    """Standard deviation of keypoint residuals over the assumed `sigma`, at least 1."""


def find_turned(
    orientation: Float[np.ndarray, "f 3 3"],
    time: Float[np.ndarray, " f"],
    predicted: Float[np.ndarray, "f 2 25 2"],
    uv: Float[np.ndarray, "f 25 2"],
    sigma: Float[np.ndarray, "f 25"],
    robust_scale: float,
) -> Facing:
    """The most probable states of all frames (Viterbi).

    Args:
        orientation: `R_CH` as given.
        time: of each frame, s, increasing.
        predicted: keypoints of the body as given, and turned, px.
        uv: the detector's keypoints, px.
        sigma: assumed standard deviation, px; `inf` for missing keypoints.
        robust_scale: of Geman and McClure's loss on keypoints, in deviations.
    """
    gap = np.maximum(np.diff(time), 1e-3)
    independent = 1.0 if len(gap) == 0 else min(1.0, float(np.median(gap)) / _LASTING)
    evidence, noise = _keypoint_evidence(predicted, uv, sigma, robust_scale)
    begins = _continuity(orientation, gap)
    # Costs of being turned, less those of being as given.
    turned = independent * (_PRIOR + evidence)
    return Facing(cheapest_states(turned, begins), noise)


def _continuity(
    orientation: Float[np.ndarray, "f 3 3"], gap: Float[np.ndarray, " g"]
) -> Float[np.ndarray, " g"]:
    """-log likelihood ratio of a change of state against none, between frames.

    Negative where the given bodies rotate by about π between two frames.
    """
    turn = np.swapaxes(orientation[:-1], -1, -2) @ orientation[1:]
    on, off = _angle(turn), _angle(turn @ HALF_TURN)
    if not len(gap):
        return on
    # Of the smaller one: a jump by half a turn is an error's beginning, no jitter.
    usual = median_filter(np.minimum(on, off), min(_WINDOW, len(gap)), mode="nearest")
    sigma = np.hypot(_TURN_SPEED * gap, usual / _MEDIAN_OF_THREE)
    return 0.5 * (_robust(off / sigma) - _robust(on / sigma))


def _robust(
    whitened: Float[np.ndarray, "*b"], scale: float = _JUMP_SCALE
) -> Float[np.ndarray, "*b"]:
    """Geman and McClure's ρ."""
    squared = whitened**2
    return squared / (1 + squared / scale**2)


def _angle(rotation: Float[np.ndarray, "*b 3 3"]) -> Float[np.ndarray, "*b"]:
    trace = np.trace(rotation, axis1=-2, axis2=-1)
    return np.arccos(np.clip((trace - 1) / 2, -1, 1))


def _keypoint_evidence(
    predicted: Float[np.ndarray, "f 2 25 2"],
    uv: Float[np.ndarray, "f 25 2"],
    sigma: Float[np.ndarray, "f 25"],
    scale: float,
) -> tuple[Float[np.ndarray, " f"], float]:
    """Evidence of the keypoints for the given body, and their noise level.

    **Returns:** for each frame `-log p(keypoints | body rotated by π) + log p(keypoints
    | body as given)`, and the standard deviation of the residuals over the assumed
    `sigma`, at least 1. In either case detections of left and right arm, and of left
    and right leg, may be exchanged, with the prior `_EXCHANGED`.
    """
    detected = np.isfinite(sigma)
    if not detected.any():
        return np.zeros(len(uv)), 1.0
    plain = np.linalg.norm(predicted - uv[:, None], axis=-1) / sigma[:, None]
    better = np.argmin(np.sum(_robust(plain, scale), axis=-1), axis=1)
    residual = plain[np.arange(len(uv)), better][detected]
    noise = max(1.0, float(np.sqrt(np.median(residual**2) / _MEDIAN_OF_TWO)))
    cost = 0.5 * _robust(plain / noise, scale)
    total = np.sum(cost, axis=-1)
    for half in (ARMS, LEGS):
        named = np.array(half)
        mirrored = named[:, ::-1]
        error = predicted[:, :, mirrored] - uv[:, None, named]
        wide = sigma[:, None, named] * noise
        crossed = 0.5 * _robust(np.linalg.norm(error, axis=-1) / wide, scale)
        gain = np.sum(crossed - cost[:, :, named], axis=(-1, -2)) + _EXCHANGED
        total = total + np.minimum(gain, 0.0)
    least = total.min(axis=1, keepdims=True)
    likelihood = np.logaddexp(-total, -(least + _ALL_WRONG))
    return likelihood[:, 0] - likelihood[:, 1], noise
