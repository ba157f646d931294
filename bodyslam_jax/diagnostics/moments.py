"""Frames in which a figure is worst, so that a reason can say where to look.

Frames are first and last frame by the name of the check, for figures that one moment
decides. A figure of the whole video refers to all frames in which the person is seen.
"""

import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax.body.skeleton import PELVIS
from bodyslam_jax.diagnostics import posture
from bodyslam_jax.geometry.arrays import runs

Frames = tuple[int, int]
"""First and last frame."""

MOMENT_S = 0.2
"""Interval within which nobody turns round or reverses a run."""
_HORIZONTAL_AXES = [0, 2]


def of_person(
    joints: Float[np.ndarray, "t 24 3"],
    present: Bool[np.ndarray, " t"],
    inferred: Bool[np.ndarray, " t"],
    fps: float,
) -> dict[str, Frames]:
    """Returns the frames of one person's fastest turn and change of speed, first
    appearance, fastest gap, longest stretch of inferred legs, and shortest piece.

    `inferred` marks the frames whose legs were mostly inferred.
    """
    stretches = _runs(present)
    found: dict[str, Frames] = {}
    if not stretches:
        return found
    n = max(1, round(MOMENT_S * fps))
    turn = _worst(
        stretches, lambda x: posture.turning_rate(x, fps, MOMENT_S), joints, n
    )
    jump = _worst(
        stretches, lambda x: posture.speed_change(x, fps, MOMENT_S), joints, 2 * n
    )
    if turn is not None:
        found |= {"turn": turn, "turn_of_walker": turn}
    if jump is not None:
        found |= {"velocity_jump": jump, "velocity_jump_of_walker": jump}
    first = stretches[0].start
    found["appears_within"] = (first, min(first + n, stretches[0].stop - 1))
    gaps = list(zip(stretches[:-1], stretches[1:], strict=True))
    if gaps:
        place = joints[:, PELVIS][:, _HORIZONTAL_AXES]
        rate = [
            np.linalg.norm(place[b.start] - place[a.stop - 1]) / (b.start - a.stop + 1)
            for a, b in gaps
        ]
        a, b = gaps[int(np.argmax(rate))]
        found["speed_across_gap"] = (a.stop - 1, b.start)
        shortest = min(stretches, key=lambda run: run.stop - run.start)
        found["seen_in_pieces"] = (shortest.start, shortest.stop - 1)
    hidden = _runs(inferred)
    if hidden:
        longest = max(hidden, key=lambda run: run.stop - run.start)
        found["legs_inferred"] = (longest.start, longest.stop - 1)
    return found


def of_camera(
    T_WC: Float[np.ndarray, "t 4 4"], within: Bool[np.ndarray, " t"], fps: float
) -> dict[str, Frames]:
    """Returns the frames of the camera's greatest speed, acceleration and rotation
    rate."""
    frames = np.flatnonzero(within)
    n = max(1, round(0.1 * fps))
    if len(frames) <= 2 * n:
        return {}
    T_WC = T_WC[within]
    place, turn = T_WC[:, :3, 3], T_WC[:, :3, :3]
    moved = np.linalg.norm(place[n:] - place[:-n], axis=1)
    bent = np.linalg.norm(place[2 * n :] - 2 * place[n:-n] + place[: -2 * n], axis=1)
    trace = np.einsum("tij,tij->t", turn[:-n], turn[n:])
    at = lambda k, long: (int(frames[k]), int(frames[k + long]))
    return {
        "camera_speed": at(int(moved.argmax()), n),
        "camera_acceleration": at(int(bent.argmax()), 2 * n),
        "camera_turning": at(int(trace.argmin()), n),
    }


def seen(present: Bool[np.ndarray, " t"]) -> Frames | None:
    """Returns the first and the last frame that `present` marks; `None` if there is
    none."""
    where = np.flatnonzero(present)
    return (int(where[0]), int(where[-1])) if len(where) else None


def _runs(where: Bool[np.ndarray, " t"]) -> list[slice]:
    """Returns the runs of frames as slices of Python integers, which JSON can
    represent."""
    return [slice(int(run.start), int(run.stop)) for run in runs(where)]


def _worst(stretches, figure, joints, length) -> Frames | None:
    """Returns the frames over which a figure of consecutive joints is greatest."""
    best, where = -np.inf, None
    for run in stretches:
        values = figure(joints[run])
        if len(values) and values.max() > best:
            best = float(values.max())
            k = run.start + int(values.argmax())
            where = (k, min(k + length, run.stop - 1))
    return where
