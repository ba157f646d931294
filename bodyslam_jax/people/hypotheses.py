"""Frames in which the other of two readings is true: a hidden Markov model.

- A detector processes single images, and may exchange left and right limbs: of people
  seen from behind, and where legs cross in a view from the side (`correct_left_right`).
- A regressor may take front for back (`find_turned`).

A reading is a state of the model. Each puts points (joints, limbs about the middle of
both sides) somewhere; these move at nearly constant velocity, so that where legs cross,
each goes on and none turns back. A Kalman filter follows them under several hypotheses
of the last readings; of those that agree in the last frames the most likely one is kept
(a Viterbi algorithm whose states are the last `_REMEMBERED` readings).
"""

import dataclasses
import math

import numpy as np
from jaxtyping import Bool, Float, Int

from bodyslam_jax.people.keypoint_errors import BOX_DIAGONAL
from bodyslam_jax.types import Keypoints

ARMS = ((2, 5), (3, 6), (4, 7))
"""Shoulders, elbows, wrists of BODY_25: right and left."""
LEGS = ((9, 12), (10, 13), (11, 14), (22, 19), (23, 20), (24, 21))
"""Hips, knees, ankles, big toes, small toes, heels."""
_LIMBS = (1, 2, 4, 5, 7, 8, *range(16, 22))
"""SMPL's hips, knees, ankles, shoulders, elbows and wrists, which a turned body has
elsewhere."""
_RARE, _LASTS = 13.5, 1.0
"""-log odds of an error a second (frames closer than 1/30 s are alike), and of a change
between error and none from frame to frame."""
_INDEPENDENT = 0.5
"""Weight of each point's evidence, as points of a limb move together."""
_NOISE = 0.045
"""m: standard deviation of a coordinate of a keypoint, or of a joint of a regressor: as
of gross errors, since those of successive frames are alike."""
_ACCELERATION = 3.5
"""Square root of the spectral density of the points' acceleration, m/s^1.5. In eleven
rendered sequences 18 of 69 frames keep exchanged legs and 14 of 34 arms, in twenty of
simulated keypoints 2 of 11 and 10 of 6; with 5 it is 20 and 23, 2 and 6."""
_FORGOTTEN = 0.5
"""Time constant with which velocities decay, s: so they stay bounded across gaps."""
_GATE = 5.0
"""Standard deviations beyond which an innovation is an outlier: it costs as much as one
at this bound, and the filter is not updated with it."""
_REMEMBERED = 5
"""Hypotheses with the same readings in this number of last frames are merged: the most
likely one is kept."""
_LASTING = 1 / 3
"""s: correlation time of errors of keypoints against a posture: frames within it count
once."""
_ALL_WRONG = 8.0
"""-log odds that all keypoints of a frame are wrong: bounds a frame's evidence."""
_MEDIAN_OF_TWO = 1.386
"""Median squared length of a vector with two normal components of deviation 1."""


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
    if not renamed.any():
        return keypoints, renamed
    changed = dataclasses.replace(keypoints, uv=uv, confidence=confidence)
    return changed, renamed


def find_turned(
    joints: Float[np.ndarray, "f 2 24 3"],
    time: Float[np.ndarray, " f"],
    predicted: Float[np.ndarray, "f 2 25 2"],
    uv: Float[np.ndarray, "f 25 2"],
    sigma: Float[np.ndarray, "f 25"],
    robust_scale: float,
) -> Bool[np.ndarray, " f"]:
    """Frames whose body is to be rotated by π about its own vertical axis.

    Args:
        joints: of the body as given, and turned, about the pelvis in C, m.
        time: of each frame, s, increasing.
        predicted: keypoints of both, px.
        uv: the detector's keypoints, px.
        sigma: assumed standard deviation, px; `inf` for missing keypoints.
        robust_scale: of Geman and McClure's loss on keypoints, in deviations.
    """
    seconds = float(np.median(np.diff(time))) if len(time) > 1 else _LASTING
    robust = lambda squared: squared / (1 + squared / robust_scale**2)
    detected = np.isfinite(sigma)
    squared = np.sum((predicted - uv[:, None]) ** 2, -1) / sigma[:, None] ** 2
    costs = np.zeros(squared.shape[:2])
    if detected.any():
        better = np.argmin(robust(squared).sum(-1), axis=1)
        residual = squared[np.arange(len(uv)), better][detected]
        noise = max(1.0, float(np.median(residual)) / _MEDIAN_OF_TWO)
        costs = 0.5 * robust(squared / noise).sum(-1)
        costs = np.minimum(costs - costs.min(axis=1, keepdims=True), _ALL_WRONG)
    costs *= min(1.0, seconds / _LASTING)
    return are_errors(costs, joints[:, :, _LIMBS], time, _NOISE)


def _exchanged(
    uv: Float[np.ndarray, "t 25 2"],
    detected: Bool[np.ndarray, "t 25"],
    pairs: tuple[tuple[int, int], ...],
    fps: float,
) -> Bool[np.ndarray, " t"]:
    """Frames in which the labels of these pairs of one person are exchanged: limbs are
    on the other side of the middle between left and right."""
    metre = _size(uv, detected) / BOX_DIAGONAL
    # Hips and shoulders are close together in a view from the side: no further than
    # the error of a keypoint.
    first, second = np.array(pairs[1:]).T
    seen = detected[:, first] & detected[:, second]
    if metre == 0 or not seen.any():
        return np.zeros(len(uv), bool)
    across = np.where(seen[..., None], uv[:, first] - uv[:, second], 0.0)
    places = np.stack([across, -across], axis=1) / (2 * metre)
    time = np.arange(len(uv)) / fps
    # 1 px is the error of a vector assumed of any detector in images of any size.
    noise = math.hypot(_NOISE, 1 / (2 * metre))
    return are_errors(np.zeros((len(uv), 2)), places, time, noise, seen)


def are_errors(
    costs: Float[np.ndarray, "f 2"],
    places: Float[np.ndarray, "f 2 n d"],
    time: Float[np.ndarray, " f"],
    noise: float,
    seen: Bool[np.ndarray, "f n"] | None = None,
) -> Bool[np.ndarray, " f"]:
    """Frames whose second reading is true, so that what was given is an error.

    Args:
        costs: -log likelihood of both readings by the frame itself.
        places: of the `n` points in both, m.
        time: of each frame, s, increasing.
        noise: standard deviation of the points' coordinates, m.
        seen: points that are known; all of them without it.
    """
    frames, _, points, axes = places.shape
    seen = np.ones((frames, points), bool) if seen is None else seen
    # Axes: hypotheses, points, (place, velocity), coordinates.
    mean = np.zeros((1, points, 2, axes))
    usual = _ACCELERATION**2 * _FORGOTTEN / 2
    covariance = np.tile(np.diag([1.0, usual]), (1, points, 1, 1))
    cost, labels, steps = np.zeros(1), np.zeros(1, int), []
    for k, dt in enumerate(np.diff(time, prepend=time[0])):
        move = np.array([[1.0, dt], [0.0, np.exp(-dt / _FORGOTTEN)]])
        spread = np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        mean = move @ mean
        covariance = move @ covariance @ move.T + _ACCELERATION**2 * spread
        variance = covariance[..., 0, 0] + noise**2
        # Each hypothesis is continued with both readings: axes are hypotheses,
        # readings, points, coordinates.
        innovation = places[k] - mean[:, None, :, 0]
        away = (innovation**2).sum(-1) / variance[:, None]
        near = seen[k] & (away < _GATE**2)
        paid = (seen[k] * np.minimum(away, _GATE**2)).sum(-1) * _INDEPENDENT / 2
        prior = np.array([0.0, _RARE * min(dt, 1 / 30) if k else _RARE / 30])
        changed = ((labels[:, None] & 1) != np.arange(2)) & (k > 0)
        total = cost[:, None] + paid + costs[k] + prior + _LASTS * changed
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
    found, last = np.zeros(frames, bool), int(cost.argmin())
    for k in range(frames - 1, -1, -1):
        parents, readings = steps[k]
        found[k], last = readings[last], parents[last]
    return found


def _cheapest_of_each(
    group: Int[np.ndarray, " n"], cost: Float[np.ndarray, " n"]
) -> Int[np.ndarray, " g"]:
    """The index of the cheapest member of each group."""
    order = np.lexsort((cost, group))
    return order[np.unique(group[order], return_index=True)[1]]


def _size(uv: Float[np.ndarray, "t 25 2"], detected: Bool[np.ndarray, "t 25"]) -> float:
    """Of the person in the image, px: the usual box of the keypoints."""
    valid = detected[..., None]
    low = np.where(valid, uv, np.inf).min(axis=1)
    high = np.where(valid, uv, -np.inf).max(axis=1)
    some = detected.sum(axis=1) > 1
    extent = np.linalg.norm((high - low)[some], axis=-1)
    return float(np.median(extent)) if some.any() else 0.0
