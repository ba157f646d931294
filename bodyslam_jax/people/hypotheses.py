"""Detects frames in which the second of two hypotheses is true, by a hidden Markov
model.

- A detector processes single images, and may exchange left and right limbs: of people
  seen from behind, and where legs cross in a view from the side (`correct_left_right`).
- A regressor may confuse front and back (`find_turned`).

A hypothesis on one frame is a state of the model. Each determines positions of points
(joints, or limbs relative to the middle of both sides) that move at nearly constant
velocity, so that legs which cross continue their motion instead of turning back. A
Kalman filter follows the points for several sequences of recent states; among sequences
with the same states in the last frames the most likely one is kept (a Viterbi algorithm
whose states are the last `_HYPOTHESIS_FRAMES` states).
"""

import dataclasses
import math

import numpy as np
from jaxtyping import Bool, Float, Int

from bodyslam_jax.people.keypoint_errors import BOX_DIAGONAL_M
from bodyslam_jax.types import Keypoints

ARMS = ((2, 5), (3, 6), (4, 7))
"""Shoulders, elbows, wrists of BODY_25: right and left."""
LEGS = ((9, 12), (10, 13), (11, 14), (22, 19), (23, 20), (24, 21))
"""Hips, knees, ankles, big toes, small toes, heels of BODY_25: right and left."""
_LIMB_JOINTS = (1, 2, 4, 5, 7, 8, *range(16, 22))
"""SMPL's hips, knees, ankles, shoulders, elbows and wrists, whose positions change if a
body is rotated by π."""
_ERROR_COST, _CHANGE_COST = 13.5, 1.0
"""Negative log odds of an error per second (frames closer than 1/30 s count alike), and
of a change between error and no error from frame to frame."""
_POINT_WEIGHT = 0.5
"""Weight of each point's evidence, below 1 because points of a limb move together."""
_POSITION_SIGMA_M = 0.045
"""Standard deviation of a coordinate of a keypoint, or of a regressor's joint. It is
that of gross errors, since errors of successive frames are correlated."""
_ACCELERATION_DENSITY = 3.5
"""Square root of the spectral density of the points' acceleration, m/s^1.5. In eleven
rendered sequences 18 of 69 frames keep exchanged legs and 14 of 34 arms, in twenty of
simulated keypoints 2 of 11 and 10 of 6; with 5 it is 20 and 23, 2 and 6."""
_VELOCITY_DECAY_S = 0.5
"""Time constant with which velocities decay, which bounds them across gaps."""
_GATE_SIGMAS = 5.0
"""Standard deviations beyond which an innovation is an outlier: its cost is that at
this bound, and it does not update the filter."""
_HYPOTHESIS_FRAMES = 5
"""Hypotheses with the same states in this number of last frames are merged: the most
likely one is kept."""
_MAX_FRAME_COST = 8.0
"""Negative log odds that all keypoints of a frame are wrong, which bounds a frame's
evidence. With the evidence also divided by the keypoints' noise and by the number of
frames within 1/3 s, twice as many frames were read wrongly (`benchmarks/keypoints.md`).
"""


def correct_left_right(
    keypoints: Keypoints, fps: float
) -> tuple[Keypoints, Bool[np.ndarray, "h t 2"]]:
    """Returns the keypoints with exchanges undone, and where arms (0) and legs (1) were
    exchanged."""
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
    """Returns the frames whose body must be rotated by π about its own vertical axis.

    Args:
        joints: joints of the body as given, and rotated, relative to the pelvis in C,
            m.
        time: time of each frame, s, increasing.
        predicted: keypoints of both bodies, px.
        uv: the detector's keypoints, px.
        sigma: assumed standard deviation, px; `inf` for missing keypoints.
        robust_scale: scale of Geman and McClure's loss on keypoints, in standard
            deviations.
    """
    squared = np.sum((predicted - uv[:, None]) ** 2, -1) / sigma[:, None] ** 2
    costs = 0.5 * np.sum(squared / (1 + squared / robust_scale**2), axis=-1)
    costs = np.minimum(costs - costs.min(axis=1, keepdims=True), _MAX_FRAME_COST)
    return are_errors(costs, joints[:, :, _LIMB_JOINTS], time, _POSITION_SIGMA_M)


def _exchanged(
    uv: Float[np.ndarray, "t 25 2"],
    detected: Bool[np.ndarray, "t 25"],
    pairs: tuple[tuple[int, int], ...],
    fps: float,
) -> Bool[np.ndarray, " t"]:
    """Returns the frames in which the labels of these pairs of one person are
    exchanged, that is, in which limbs are on the other side of the middle between left
    and right."""
    metre = _size(uv, detected) / BOX_DIAGONAL_M
    # Hips and shoulders are left out: from the side they are no further apart than the
    # error of a keypoint.
    first, second = np.array(pairs[1:]).T
    seen = detected[:, first] & detected[:, second]
    if metre == 0 or not seen.any():
        return np.zeros(len(uv), bool)
    across = np.where(seen[..., None], uv[:, first] - uv[:, second], 0.0)
    places = np.stack([across, -across], axis=1) / (2 * metre)
    time = np.arange(len(uv)) / fps
    # 1 px is the least error of a vector between keypoints that is assumed.
    noise = math.hypot(_POSITION_SIGMA_M, 1 / (2 * metre))
    return are_errors(np.zeros((len(uv), 2)), places, time, noise, seen)


def are_errors(
    costs: Float[np.ndarray, "f 2"],
    places: Float[np.ndarray, "f 2 n d"],
    time: Float[np.ndarray, " f"],
    noise: float,
    seen: Bool[np.ndarray, "f n"] | None = None,
) -> Bool[np.ndarray, " f"]:
    """Returns the frames in which the second hypothesis is true, so that the input is
    an error.

    Args:
        costs: negative log likelihood of both hypotheses by the frame itself.
        places: positions of the `n` points under both, m.
        time: time of each frame, s, increasing.
        noise: standard deviation of the points' coordinates, m.
        seen: points that are known; by default all.
    """
    frames, _, points, axes = places.shape
    seen = np.ones((frames, points), bool) if seen is None else seen
    # Axes: sequences, points, (position, velocity), coordinates.
    mean = np.zeros((1, points, 2, axes))
    usual = _ACCELERATION_DENSITY**2 * _VELOCITY_DECAY_S / 2
    covariance = np.tile(np.diag([1.0, usual]), (1, points, 1, 1))
    cost, labels, steps = np.zeros(1), np.zeros(1, int), []
    for k, dt in enumerate(np.diff(time, prepend=time[0])):
        move = np.array([[1.0, dt], [0.0, np.exp(-dt / _VELOCITY_DECAY_S)]])
        spread = np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        mean = move @ mean
        covariance = move @ covariance @ move.T + _ACCELERATION_DENSITY**2 * spread
        variance = covariance[..., 0, 0] + noise**2
        # Each sequence is continued with both states: axes are sequences, states,
        # points, coordinates.
        innovation = places[k] - mean[:, None, :, 0]
        away = (innovation**2).sum(-1) / variance[:, None]
        near = seen[k] & (away < _GATE_SIGMAS**2)
        paid = (seen[k] * np.minimum(away, _GATE_SIGMAS**2)).sum(-1) * _POINT_WEIGHT / 2
        # Frames closer than 1/30 s count alike.
        prior = np.array([0.0, _ERROR_COST * (min(dt, 1 / 30) if k else 1 / 30)])
        changed = ((labels[:, None] & 1) != np.arange(2)) & (k > 0)
        total = cost[:, None] + paid + costs[k] + prior + _CHANGE_COST * changed
        gain = (covariance[..., 0] / variance[..., None])[:, None] * near[..., None]
        means = mean[:, None] + gain[..., None] * innovation[..., None, :]
        covariances = (
            covariance[:, None]
            - gain[..., None] * covariance[:, None, :, 0][..., None, :]
        )
        longer = (labels[:, None] << 1 | np.arange(2)) % 2**_HYPOTHESIS_FRAMES
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
    """Returns the index of the cheapest member of each group."""
    order = np.lexsort((cost, group))
    return order[np.unique(group[order], return_index=True)[1]]


def _size(uv: Float[np.ndarray, "t 25 2"], detected: Bool[np.ndarray, "t 25"]) -> float:
    """Returns the size of the person in the image, px: the median diagonal of the box
    around the keypoints."""
    valid = detected[..., None]
    low = np.where(valid, uv, np.inf).min(axis=1)
    high = np.where(valid, uv, -np.inf).max(axis=1)
    some = detected.sum(axis=1) > 1
    extent = np.linalg.norm((high - low)[some], axis=-1)
    return float(np.median(extent)) if some.any() else 0.0
