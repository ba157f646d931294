"""Of several fits of each frame, those that make one motion.

A path through the frames (Viterbi) weighs how well each fit explains its keypoints
against how far the joints would have to jump between frames. Both are compared with the
noise that they have: keypoints that are off by twice what is said of them say a quarter
as much, and where the best fits themselves jitter, a jump is no more than their usual.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int

_INDEPENDENT_JOINTS = 8
"""Joints of a body move together: 24 of them say as much as about this many."""
_MEDIAN_OF_THREE = 1.538
"""Median length of a vector with three normal components of deviation 1."""
_ROUNDS = 3
"""Paths that are found, each with the noise of the one before."""


@dataclasses.dataclass(frozen=True)
class _Scales:
    """What jumps between frames are compared with."""

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
    """The end of each frame that lies on the cheapest path (Viterbi, second order).

    When legs cross, a leg that goes on and one that turns back move equally far; only
    the change of velocity tells them apart.

    Args:
        costs: -log likelihood of each end if keypoints err as is said of them.
        joints: relative to the pelvis, in C, m.
        time: of each frame, s, increasing.
        noise: errors of keypoints in units of what is said of them.
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
    """How a path that was found moves, in the median: motion and jitter together."""
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
    # A state is the ends of two frames, [before, now]: their difference is a velocity.
    jump = lambda k: _jump(joints, orientation, gap[k - 1], k, scales)
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
    """Cost of moving from each end of frame k - 1 to each of frame k."""
    moved = joints[k][None] - joints[k - 1][:, None]
    squared = np.mean(np.sum(moved**2, -1), -1) / (scales.joint_speed * gap) ** 2
    cosine = np.einsum("aij,bij->ab", orientation[k - 1], orientation[k])
    turn = np.arccos(np.clip((cosine - 1) / 2, -1, 1)) / (scales.turn_speed * gap)
    return 0.5 * (_INDEPENDENT_JOINTS * squared + turn**2)


def cheapest_states(
    turned: Float[np.ndarray, " f"], changes: Float[np.ndarray, " g"]
) -> Bool[np.ndarray, " f"]:
    """States (f,) that minimise the sum of `turned` where they are true and of
    `changes` where they change."""
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
