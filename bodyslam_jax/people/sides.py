"""Correction of left-right exchanges in detected keypoints.

Detectors process single images, and may exchange the left and right limbs for some
frames: of people seen from behind, and where legs cross in a view from the side. The
vector from each left joint to the right one moves at nearly constant velocity, so that
it passes through zero where legs cross; with exchanged labels it changes sign, or turns
back at a crossing. A Kalman filter of constant velocity follows these vectors, arms and
legs apart, under several hypotheses of which frames are exchanged; of those that agree
in the last frames the most likely one is kept (a Viterbi algorithm over the last
`_REMEMBERED` labels).
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int

from bodyslam_jax.types import Keypoints

ARMS = ((2, 5), (3, 6), (4, 7))
"""Shoulders, elbows, wrists of BODY_25: right and left."""
LEGS = ((9, 12), (10, 13), (11, 14), (22, 19), (23, 20), (24, 21))
"""Hips, knees, ankles, big toes, small toes, heels."""
_CHANGE = 1.0
"""-log odds of a change of state at a frame."""
_EXCHANGED = 0.45
"""-log odds of exchanged labels, per frame at 30 fps; less at higher rates, as errors
are correlated from frame to frame."""
_INDEPENDENT = 0.5
"""Weight of each joint's evidence, as the joints of a limb are correlated."""
_NOISE = 0.05
"""Standard deviation of a vector's components, of the person's size in the image;
combined with 1 px, the noise assumed of any detector in images of any size."""
_ACCELERATION = 6.0
"""Square root of the spectral density of the vectors' acceleration, sizes/s^1.5."""
_FORGOTTEN = 0.5
"""Time constant with which velocities decay, s: so they stay bounded across gaps."""
_GATE = 5.0
"""Standard deviations beyond which an innovation is an outlier: it costs as much as one
at this bound, and the filter is not updated with it."""
_REMEMBERED = 5
"""Hypotheses with the same labels in this number of last frames are merged: the most
likely one is kept."""


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
    """Frames in which the labels of these pairs of one person are exchanged.

    The state of a pair is its vector and the vector's velocity, in units of the
    person's size; exchanged labels measure the vector with the opposite sign.
    """
    size = _size(uv, detected)
    # Hips and shoulders are close together in a view from the side: their vectors are
    # no longer than the error of a keypoint.
    first, second = np.array(pairs[1:]).T
    seen = detected[:, first] & detected[:, second]
    if size == 0 or not seen.any():
        return np.zeros(len(uv), bool)
    across = np.where(seen[..., None], uv[:, first] - uv[:, second], 0.0) / size
    dt = 1 / fps
    move = np.array([[1.0, dt], [0.0, np.exp(-dt / _FORGOTTEN)]])
    spread = np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]) * _ACCELERATION**2
    noise = _NOISE**2 + size**-2.0
    sign, prior = np.array([1.0, -1.0]), np.array([0.0, _EXCHANGED * min(1.0, 30 * dt)])

    # Axes: hypotheses, pairs, (place, velocity), image coordinates.
    mean = np.zeros((1, len(first), 2, 2))
    usual = _ACCELERATION**2 * _FORGOTTEN / 2
    covariance = np.tile(np.diag([1.0, usual]), (1, len(first), 1, 1))
    cost, labels, steps = np.zeros(1), np.zeros(1, int), []
    for k in range(len(uv)):
        mean = move @ mean
        covariance = move @ covariance @ move.T + spread
        variance = covariance[..., 0, 0] + noise
        # Each hypothesis is continued with both labels: axes are hypotheses, labels,
        # pairs, image coordinates.
        innovation = sign[:, None, None] * across[k] - mean[:, None, :, 0]
        away = (innovation**2).sum(-1) / variance[:, None]
        near = seen[k] & (away < _GATE**2)
        paid = (seen[k] * np.minimum(away, _GATE**2)).sum(-1) * _INDEPENDENT / 2
        changed = (labels[:, None] & 1) != np.arange(2)
        total = cost[:, None] + paid + prior + _CHANGE * (changed & (k > 0))
        gain = (covariance[..., 0] / variance[..., None])[:, None] * near[..., None]
        means = mean[:, None] + gain[..., None] * innovation[..., None, :]
        covariances = (
            covariance[:, None]
            - gain[..., None] * covariance[:, None, :, 0][..., None, :]
        )
        longer = (labels[:, None] << 1 | np.arange(2)) % 2**_REMEMBERED
        kept = _cheapest_of_each(longer.ravel(), total.ravel())
        flat = lambda x: x.reshape(-1, *x.shape[2:])[kept]
        mean, covariance, cost, labels = map(flat, (means, covariances, total, longer))
        steps.append((kept // 2, labels & 1))
    return _traced_back(steps, int(cost.argmin()))


def _cheapest_of_each(
    group: Int[np.ndarray, " n"], cost: Float[np.ndarray, " n"]
) -> Int[np.ndarray, " g"]:
    """The index of the cheapest member of each group."""
    order = np.lexsort((cost, group))
    return order[np.unique(group[order], return_index=True)[1]]


def _traced_back(
    steps: list[tuple[Int[np.ndarray, " _"], Int[np.ndarray, " _"]]], last: int
) -> Bool[np.ndarray, " t"]:
    """The labels that led to a hypothesis; `steps` are parents and labels."""
    found = np.zeros(len(steps), bool)
    for k in range(len(steps) - 1, -1, -1):
        parents, labels = steps[k]
        found[k], last = labels[last], int(parents[last])
    return found


def _size(uv: Float[np.ndarray, "t 25 2"], detected: Bool[np.ndarray, "t 25"]) -> float:
    """Of the person in the image, px: the usual box of the keypoints."""
    valid = detected[..., None]
    low = np.where(valid, uv, np.inf).min(axis=1)
    high = np.where(valid, uv, -np.inf).max(axis=1)
    some = detected.sum(axis=1) > 1
    extent = np.linalg.norm((high - low)[some], axis=-1)
    return float(np.median(extent)) if some.any() else 0.0
