"""Correction of left-right exchanges in detected keypoints.

Detectors process single images, and may exchange the left and right limbs for some
frames, mostly of people seen from behind. A hidden Markov model with two states
(correct and exchanged) for the arms, and one for the legs: between two frames the
vector from each right joint to the left one changes little, or changes sign if the
labels were exchanged in between. Changes are whitened by the usual changes around them.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import median_filter

from bodyslam_jax.people.viterbi import cheapest_states
from bodyslam_jax.types import Keypoints

ARMS = ((2, 5), (3, 6), (4, 7))
"""Shoulders, elbows, wrists of BODY_25: right and left."""
LEGS = ((9, 12), (10, 13), (11, 14), (22, 19), (23, 20), (24, 21))
"""Hips, knees, ankles, big toes, small toes, heels."""
_CHANGE = 4.0
"""-log odds of a change of state at a frame."""
_EXCHANGED = 3.0
"""-log odds of exchanged labels, per correlation time of the errors."""
_LASTING = 1 / 3
"""s: correlation time of the errors."""
_INDEPENDENT = 0.5
"""Weight of each joint's evidence, as the joints of a limb are correlated."""
_SCALE = 5.0
"""Scale of the robust loss on changes, in their standard deviations."""
_WINDOW = 7
"""Frames within which the usual change is measured."""
_MEDIAN_OF_TWO = 1.177
"""Median length of a vector with two normal components of deviation 1."""
_FLOOR = 0.01
"""Least standard deviation of a change, of the person's size; combined with 1 px, the
noise assumed of any detector in images of any size."""
_LONGEST = 5
"""Longest gap, frames, over which labels are compared."""


def correct_left_right(
    keypoints: Keypoints, fps: float
) -> tuple[Keypoints, Bool[np.ndarray, "h t 2"]]:
    """Keypoints with exchanges undone; where arms (0) and legs (1) were exchanged."""
    uv, confidence = keypoints.uv.copy(), keypoints.confidence.copy()
    renamed = np.zeros((*confidence.shape[:2], 2), bool)
    for h in range(len(uv)):
        for half, pairs in enumerate((ARMS, LEGS)):
            found = _exchanged(uv[h], confidence[h] > 0, pairs, fps)
            renamed[h, :, half] = found
            at = np.flatnonzero(found)[:, None]
            for i, j in pairs:
                uv[h, at, [i, j]] = uv[h, at, [j, i]]
                confidence[h, at, [i, j]] = confidence[h, at, [j, i]]
    changed = dataclasses.replace(keypoints, uv=uv, confidence=confidence)
    return changed, renamed


def _exchanged(
    uv: Float[np.ndarray, "t 25 2"],
    detected: Bool[np.ndarray, "t 25"],
    pairs: tuple[tuple[int, int], ...],
    fps: float,
) -> Bool[np.ndarray, " t"]:
    """Frames in which the labels of these pairs of one person are exchanged."""
    size = _size(uv, detected)
    changes = np.full(max(len(uv) - 1, 0), _CHANGE)
    for i, j in pairs:
        where = np.flatnonzero(detected[:, i] & detected[:, j])
        gap = np.diff(where)
        if len(where) < 3:
            continue
        across = uv[where, i] - uv[where, j]
        on = np.linalg.norm(across[1:] - across[:-1], axis=-1)
        off = np.linalg.norm(across[1:] + across[:-1], axis=-1)
        smaller = np.minimum(on, off) / gap
        usual = median_filter(smaller, min(_WINDOW, len(gap)), mode="nearest")
        floor = np.hypot(_FLOOR * size, 1.0)
        sigma = np.hypot(usual * gap / _MEDIAN_OF_TWO, floor)
        evidence = 0.5 * (_robust(off / sigma) - _robust(on / sigma))
        near = gap <= _LONGEST
        changes[where[1:][near] - 1] += _INDEPENDENT * evidence[near]
    cost = _EXCHANGED * min(1.0, 1 / (fps * _LASTING))
    return cheapest_states(np.full(len(uv), cost), changes)


def _size(uv: Float[np.ndarray, "t 25 2"], detected: Bool[np.ndarray, "t 25"]) -> float:
    """Of the person in the image, px: the usual box of the keypoints."""
    valid = detected[..., None]
    low = np.where(valid, uv, np.inf).min(axis=1)
    high = np.where(valid, uv, -np.inf).max(axis=1)
    some = detected.sum(axis=1) > 1
    extent = np.linalg.norm((high - low)[some], axis=-1)
    return float(np.median(extent)) if some.any() else 0.0


def _robust(whitened: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Geman and McClure's ρ."""
    squared = whitened**2
    return squared / (1 + squared / _SCALE**2)
