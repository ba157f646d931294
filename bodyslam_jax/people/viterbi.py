"""The smoothest sequence among several fits of each frame, by dynamic programming.

The Viterbi algorithm minimises the sum of each fit's keypoint cost and of the motion
between frames. Both are whitened by their estimated noise: keypoint costs by the
variance of the residuals, motion by the median motion of the path itself, in
iterations.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int

_INDEPENDENT_JOINTS = 8
"""Effective number of independent joints among 24, which are correlated."""
_MEDIAN_OF_THREE = 1.538
"""Median length of a vector with three normal components of deviation 1."""
_ROUNDS = 3
"""Iterations of the path, each with the noise estimated from the previous one."""


@dataclasses.dataclass(frozen=True)
class _Scales:
    """Standard deviations of the motion between frames."""

    joint_speed: float = 1.2
    """m/s: how fast joints move about the pelvis, roughly."""
    joint_acceleration: float = 6.0
    """m/s^2: how fast that changes, roughly."""
    turn_speed: float = 2.0
    """rad/s: how fast people turn round."""


def best_path(
    costs: Float[np.ndarray, "f s"],
    joints: Float[np.ndarray, "f s 24 3"],
    orientation: Float[np.ndarray, "f s 3 3"],
    time: Float[np.ndarray, " f"],
    noise: float = 1.0,
) -> Int[np.ndarray, " f"]:
    """The fit of each frame that lies on the cheapest path (Viterbi, second order).

    Second order, as when legs cross only the change of velocity discriminates between
    a leg that continues and one that turns back.

    Args:
        costs: -log likelihood of each fit under the assumed keypoint errors.
        joints: relative to the pelvis, in C, m.
        time: of each frame, s, increasing.
        noise: standard deviation of keypoint errors over the assumed one.
    """
    costs = (costs - costs.min(axis=1, keepdims=True)) / noise**2
    scales = _Scales()
    path = _cheapest(costs, joints, orientation, time, scales)
    if len(path) < 3:
        return path
    for _ in range(_ROUNDS - 1):
        row = np.arange(len(path))
        measured = _measured(joints[row, path], orientation[row, path], time)
        if measured == scales:
            break
        scales = measured
        path = _cheapest(costs, joints, orientation, time, scales)
    return path


def _measured(
    joints: Float[np.ndarray, "f 24 3"],
    orientation: Float[np.ndarray, "f 3 3"],
    time: Float[np.ndarray, " f"],
) -> _Scales:
    """Median motion of a path, jitter included."""
    gap = np.maximum(np.diff(time), 1e-3)
    length = lambda v: float(np.sqrt(np.median(np.mean(np.sum(v**2, -1), -1))))
    velocity = np.diff(joints, axis=0) / gap[:, None, None]
    between = (gap[1:] + gap[:-1])[:, None, None] / 2
    turn = np.einsum("fij,fij->f", orientation[:-1], orientation[1:])
    turn = np.arccos(np.clip((turn - 1) / 2, -1, 1)) / gap
    least = _Scales()
    return _Scales(
        max(least.joint_speed, length(velocity)),
        max(least.joint_acceleration, length(np.diff(velocity, axis=0) / between)),
        max(least.turn_speed, float(np.median(turn)) / _MEDIAN_OF_THREE),
    )


def _cheapest(
    costs: Float[np.ndarray, "f s"],
    joints: Float[np.ndarray, "f s 24 3"],
    orientation: Float[np.ndarray, "f s 3 3"],
    time: Float[np.ndarray, " f"],
    scales: _Scales,
) -> Int[np.ndarray, " f"]:
    frames, starts = costs.shape
    if frames == 1:
        return np.array([np.argmin(costs[0])])
    gap = np.maximum(np.diff(time), 1e-3)
    # A state is a pair of fits [previous, current]: their difference is a velocity.
    jump = lambda k: _jump(joints, orientation, float(gap[k - 1]), k, scales)
    total = costs[0][:, None] + costs[1] + jump(1)
    came_from = np.zeros((frames, starts, starts), int)
    for k in range(2, frames):
        velocity, before = (
            (joints[j][None] - joints[j - 1][:, None]) / gap[j - 1] for j in (k, k - 1)
        )
        change = velocity[None] - before[:, :, None]  # [two before, before, now]
        step = scales.joint_acceleration * (gap[k - 1] + gap[k - 2]) / 2
        squared = np.mean(np.sum(change**2, -1), -1) / step**2
        through = total[..., None] + 0.5 * _INDEPENDENT_JOINTS * squared
        came_from[k] = np.argmin(through, axis=0)
        total = np.min(through, axis=0) + jump(k) + costs[k]
    path = np.empty(frames, int)
    path[-2:] = np.unravel_index(np.argmin(total), total.shape)
    for k in range(frames - 1, 1, -1):
        path[k - 2] = came_from[k, path[k - 1], path[k]]
    return path


def _jump(
    joints: Float[np.ndarray, "f s 24 3"],
    orientation: Float[np.ndarray, "f s 3 3"],
    gap: float,
    k: int,
    scales: _Scales,
) -> Float[np.ndarray, "s s"]:
    """Cost of moving from each fit of frame k - 1 to each of frame k."""
    moved = joints[k][None] - joints[k - 1][:, None]
    squared = np.mean(np.sum(moved**2, -1), -1) / (scales.joint_speed * gap) ** 2
    cosine = np.einsum("aij,bij->ab", orientation[k - 1], orientation[k])
    turn = np.arccos(np.clip((cosine - 1) / 2, -1, 1)) / (scales.turn_speed * gap)
    return 0.5 * (_INDEPENDENT_JOINTS * squared + turn**2)


def cheapest_states(
    turned: Float[np.ndarray, " f"], changes: Float[np.ndarray, " g"]
) -> Bool[np.ndarray, " f"]:
    """Binary states (f,) of least cost: the sum of `turned` where they are true and of
    `changes` between frames where they change (Viterbi)."""
    total = np.array([0.0, turned[0]])
    came_from = np.zeros((len(turned), 2), int)
    for k in range(1, len(turned)):
        through = total[:, None] + changes[k - 1] * (1 - np.eye(2))
        came_from[k] = np.argmin(through, axis=0)
        total = through.min(axis=0) + [0.0, turned[k]]
    state = np.empty(len(turned), int)
    state[-1] = np.argmin(total)
    for k in range(len(turned) - 1, 0, -1):
        state[k - 1] = came_from[k, state[k]]
    return state.astype(bool)
