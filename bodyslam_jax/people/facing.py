"""Which way round a regressor's bodies are: front taken for back, frame by frame.

A hidden Markov chain of two states, as given and turned by half a turn about the body's
own axis. What changes from frame to frame is compared with the noise that it has:

- Continuity says only *whether the error begins or ends* between two frames: if it does
  neither, both states go on alike, and however much a regressor jitters counts for
  nothing. The turn between two frames is measured in units of the turns around it.
- Keypoints say which state it is. Their residuals are measured in units of their own
  median, left and right may be exchanged in the detector, and a single frame says no
  more than that all its keypoints may be wrong.
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
"""-log odds that a regressor took front for back, for as long as errors last."""
_EXCHANGED = 4.0
"""-log odds that a detector exchanged left and right of the arms, or of the legs."""
_ALL_WRONG = 8.0
"""-log odds that the keypoints of a frame are all wrong: the most that a frame says."""
_LASTING = 1 / 3
"""s: errors of keypoints and of postures stay the same for about this long, so that
frames within it count once."""
_TURN_SPEED = 2.0
"""rad/s, per axis: how fast people turn."""
_JUMP_SCALE = 5.0
"""Scale of the robust loss on turns between frames, in their standard deviations: two
frames say at most half its square, as much as some 25 frames of keypoints."""
_WINDOW = 5
"""Frames within which the jitter of orientations is measured."""
_MEDIAN_OF_THREE = 1.538
"""Median length of a vector with three normal components of deviation 1."""
_MEDIAN_OF_TWO = 1.386
"""Median squared length of one with two."""


@dataclasses.dataclass(frozen=True)
class Facing:
    """What was decided, and from what noise."""

    turned: Bool[np.ndarray, " f"]
    """Frames whose body is to be turned by half a turn."""
    keypoint_noise: float
    """Residuals of keypoints in units of what was said of them, at least 1."""


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
        sigma: what their errors are said to be, px; `inf` where there is none.
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
    """How much less probable the next orientation is if the error begins or ends.

    Negative where the given bodies turn by about half a turn between two frames.
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
    """-log likelihood ratio of bodies that are turned to those as given, and the noise.

    Each frame's are those of the most probable exchange of left and right.
    """
    seen = np.isfinite(sigma)
    if not seen.any():
        return np.zeros(len(uv)), 1.0
    plain = np.linalg.norm(predicted - uv[:, None], axis=-1) / sigma[:, None]
    better = np.argmin(np.sum(_robust(plain, scale), axis=-1), axis=1)
    residual = plain[np.arange(len(uv)), better][seen]
    noise = max(1.0, float(np.sqrt(np.median(residual**2) / _MEDIAN_OF_TWO)))
    cost = 0.5 * _robust(plain / noise, scale)
    total = np.sum(cost, axis=-1)
    for half in (ARMS, LEGS):
        here = np.array(half)
        other = here[:, ::-1]
        there = predicted[:, :, other] - uv[:, None, here]
        wide = sigma[:, None, here] * noise
        crossed = 0.5 * _robust(np.linalg.norm(there, axis=-1) / wide, scale)
        gain = np.sum(crossed - cost[:, :, here], axis=(-1, -2)) + _EXCHANGED
        total = total + np.minimum(gain, 0.0)
    least = total.min(axis=1, keepdims=True)
    likelihood = np.logaddexp(-total, -(least + _ALL_WRONG))
    return likelihood[:, 0] - likelihood[:, 1], noise
